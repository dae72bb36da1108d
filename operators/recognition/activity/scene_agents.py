"""Scene graphs as the features of agents take them: bodies that matter, and when each node was seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Boxes3D, Odometry, Pose, SceneGraph
from dataflow.messages.geometry import yaw_of
from operators.labels import LabelSpace
from operators.recognition.activity.features import MATTERING
from operators.recognition.activity.tracked_people import Moment
from operators.scene.bodies import Body


def seen_times(nodes: SceneGraph) -> dict[int, int]:
    """Returns when each node was last seen, ns; the graph's own stamp where it does not say."""
    times = np.full(nodes.count, nodes.stamp) if nodes.last_seen is None else nodes.last_seen
    return dict(zip(nodes.ids.tolist(), times.tolist(), strict=True))


def mattering(nodes: SceneGraph, labels: LabelSpace, objects: Boxes3D | None = None) -> tuple[list[Body], int]:
    """Returns the nodes that features are made of as upright bodies, and how many of these are not usable.

    `objects` are boxes of the same ids, with the speeds of the nodes; without, all are taken to be still.
    """
    names = [nodes.class_names[c] if nodes.class_names else "" for c in nodes.class_ids.tolist()]
    roles = {name: labels.roles(name) for name in set(names)}
    rows = [k for k, name in enumerate(names) if roles[name] & MATTERING and nodes.ids[k] > 0]
    finite = np.isfinite(nodes.positions).all(axis=1) & np.isfinite(nodes.sizes).all(axis=1)
    usable = np.asarray(finite & (nodes.sizes >= 0).all(axis=1), bool)
    yaws = np.zeros(nodes.count) if nodes.orientations is None else yaw_of(nodes.orientations)
    velocities, still = _velocities(objects), np.zeros(3)
    bodies = [
        Body(i, name, nodes.positions[k], nodes.sizes[k], float(yaws[k]), velocities.get(i, still), roles[name])
        for k, i, name in ((k, int(nodes.ids[k]), names[k]) for k in rows)
        if usable[k]
    ]
    return bodies, len(rows) - len(bodies)


def _velocities(objects: Boxes3D | None) -> dict[int, NDArray[np.float64]]:
    """Returns the velocities (3,) of boxes by their ids; none where they are not finite."""
    if objects is None or objects.ids is None or objects.velocities is None:
        return {}
    rows = np.flatnonzero(np.isfinite(objects.velocities).all(axis=1)).tolist()
    return {int(objects.ids[k]): objects.velocities[k] for k in rows}


def scene_moments(
    graphs: Sequence[SceneGraph],
    robots: Sequence[Pose | Odometry],
    labels: LabelSpace,
    objects: Sequence[Boxes3D | None] = (),
) -> Iterator[Moment]:
    """Yields scene graphs, with the robot at each, as the recogniser takes them; a row is the number of the graph."""
    for row, (nodes, robot) in enumerate(zip(graphs, robots, strict=True)):
        bodies, _ = mattering(nodes, labels, objects[row] if len(objects) else None)
        seen = seen_times(nodes)
        unseen = {b.id: (nodes.stamp - seen[b.id]) * 1e-9 for b in bodies if b.agent}
        yield Moment(nodes.stamp * 1e-9, tuple(bodies), unseen, robot.matrix()[:2, 3], row)
