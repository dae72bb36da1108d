"""Sets of transforms that belong together: joined, and compared place by place."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dataflow.messages import Transforms


def places_of(message: Transforms) -> Iterator[tuple[str, bytes]]:
    """(child frame, its parent and place as bytes) of each transform."""
    for i, child in enumerate(message.child_frames):
        place = message.translations[i].tobytes() + message.rotations[i].tobytes()
        yield child, message.frames[i].encode() + b"\0" + place


def other_parents(a: Transforms, b: Transforms) -> list[str]:
    """Names frames for which two sets have different parents, of which `joined` keeps the later one."""
    parents = dict(zip(a.child_frames, a.frames, strict=True))
    return [
        f"a parent of {child}: {parents[child]} beside {parent}"
        for child, parent in zip(b.child_frames, b.frames, strict=True)
        if parents.get(child, parent) != parent
    ]


def joined(a: Transforms, b: Transforms) -> Transforms:
    """The transforms of two sets, stamped like the first; of those that place one frame the later counts."""
    rows = {child: (a, i) for i, child in enumerate(a.child_frames)}
    rows |= {child: (b, i) for i, child in enumerate(b.child_frames)}
    return Transforms(
        stamp=a.stamp,
        frames=tuple(m.frames[i] for m, i in rows.values()),
        child_frames=tuple(rows),
        translations=np.array([m.translations[i] for m, i in rows.values()]).reshape(-1, 3),
        rotations=np.array([m.rotations[i] for m, i in rows.values()]).reshape(-1, 4),
    )
