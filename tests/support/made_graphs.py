"""Scene graphs by hand: things by id, class, centre and full size, and relations between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dataflow.messages import SceneGraph

Thing = tuple[int, str, Sequence[float], Sequence[float]]
"""Id, class, centre, full size."""


def scene_graph(
    things: Sequence[Thing], relations: Sequence[tuple[Any, ...]] = (), *, stamp: int = 0, **more: Any
) -> SceneGraph:
    """A graph in the world; `relations` are (subject, predicate, object) by id, and perhaps a score."""
    ids, names = [thing[0] for thing in things], tuple(dict.fromkeys(thing[1] for thing in things))
    scored = [row[3] for row in relations if len(row) > 3]
    return SceneGraph(
        **{
            "stamp": stamp,
            "frame": "world",
            "class_names": names,
            "ids": np.array(ids, np.int64),
            "class_ids": np.array([names.index(thing[1]) for thing in things], np.int32),
            "positions": np.array([thing[2] for thing in things], np.float64).reshape(-1, 3),
            "sizes": np.array([thing[3] for thing in things], np.float64).reshape(-1, 3),
            "predicates": tuple(row[1] for row in relations),
            "subjects": np.array([ids.index(row[0]) for row in relations], np.int32),
            "objects": np.array([ids.index(row[2]) for row in relations], np.int32),
            "relation_scores": np.array(scored, np.float32) if scored else None,
        }
        | more
    )
