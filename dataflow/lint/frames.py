"""The tree of frames: every frame that a message is given in hangs together, and none has two parents."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from dataflow.lint.inputs import Finding
from dataflow.messages import Message, Odometry, Pose, Transforms


@dataclass(slots=True)
class FrameTree:
    """Keeps what streams say of frames. Only transforms make a tree; poses connect frames, each in its own estimate."""

    parents: dict[str, dict[str, str]] = field(default_factory=dict)
    """child → parent → the first stream with that transform."""
    connected: dict[str, set[str]] = field(default_factory=dict)
    used: dict[str, str] = field(default_factory=dict)
    """frame → the first stream whose messages are given in it."""
    bodies: dict[str, tuple[str, str]] = field(default_factory=dict)
    """stream of odometry → the frame that it is given in, and the one that it places."""

    def see(self, stream: str, message: Message) -> None:
        """Takes in a message."""
        if isinstance(message, Transforms):
            for parent, child in zip(message.frames, message.child_frames, strict=True):
                self.parents.setdefault(child, {}).setdefault(parent, stream)
                self._connect(parent, child)
            return
        if isinstance(message, (Pose, Odometry)) and message.child_frame:
            self._connect(message.frame, message.child_frame)
        if isinstance(message, Odometry):
            self.bodies.setdefault(stream, (message.frame, message.child_frame))
        frame = getattr(message, "frame", "")
        if isinstance(frame, str) and frame:
            self.used.setdefault(frame, stream)

    def _connect(self, a: str, b: str) -> None:
        self.connected.setdefault(a, set()).add(b)
        self.connected.setdefault(b, set()).add(a)

    def reached(self, root: str) -> set[str]:
        """Returns the frames connected to one."""
        found, waiting = {root}, [root]
        while waiting:
            fresh = self.connected.get(waiting.pop(), set()) - found
            found |= fresh
            waiting += fresh
        return found

    def roots(self) -> list[str]:
        """A frame of every part that hangs together, the part with most frames first."""
        left, parts = set(self.connected) | set(self.used), list[set[str]]()
        while left:
            part = self.reached(min(left)) & left | {min(left)}
            parts.append(part)
            left -= part
        parts.sort(key=lambda part: (-len(part), min(part)))
        return [min(part, key=lambda frame: (frame in self.parents, frame)) for part in parts]


def check_frames(tree: FrameTree, root: str | None = None, wanted: Iterable[str] = ()) -> Iterator[Finding]:
    """Frames with two parents, frames that are within themselves, and frames that hang on nothing.

    `root`: the frame that all others must be connected to, by default the root of the largest part. `wanted`:
    frames that must be there.
    """
    for child, parents in tree.parents.items():
        if len(parents) > 1:
            who = ", ".join(f"{parent!r} ({stream})" for parent, stream in parents.items())
            stream = list(parents.values())[-1]
            yield Finding("frames", stream, "error", f"frame {child!r} has {len(parents)} parents: {who}")
    if circle := _circle(tree):
        text = f"frames lie within each other: {' → '.join(circle)}"
        yield Finding("frames", tree.parents[circle[0]][circle[1]], "error", text)
    for stream, (frame, body) in tree.bodies.items():
        if not body or body == frame:
            text = f"it places {f'frame {body!r} in itself' if body else 'no frame'}: child_frame is that of the robot"
            yield Finding("frames", stream, "error" if body else "warning", text)
    known = set(tree.connected) | set(tree.used)
    for frame in wanted:
        if frame not in known:
            yield Finding("frames", "", "error", f"frame {frame!r} is in the contract and in no message")
    if not tree.parents and root is None:
        return  # no stream relates frames to each other
    if root is None:
        root = tree.roots()[0]
    elif root not in known:
        yield Finding("frames", "", "error", f"the root {root!r} is in no message")
        return
    reached = tree.reached(root)
    for frame, stream in tree.used.items():
        if frame not in reached:
            text = f"frame {frame!r} is not connected to {root!r}: no transform or pose places it"
            yield Finding("frames", stream, "warning", text)


def _circle(tree: FrameTree) -> list[str]:
    for start in tree.parents:
        way = [start]
        while (above := tree.parents.get(way[-1])) and (parent := next(iter(above))) not in way:
            way.append(parent)
        if above and (parent := next(iter(above))) in way:
            return [*way[way.index(parent) :], parent]
    return []
