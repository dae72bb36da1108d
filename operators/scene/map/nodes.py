"""Messages into the map of surfaces, and the nodes that come out of a map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Boxes3D, PointCloud, SceneGraph
from dataflow.messages.geometry import quaternion_from_yaw, quaternion_to_matrix, transform_points
from operators.scene.map.map_object import MapObject
from operators.scene.map.map_surface import CEILING, FLOOR, SURFACES, WALL, MapSurface
from operators.scene.map.surface_map import SeenSurface
from operators.scene.relations import FLOOR as FLOOR_ID
from operators.scene.relations import SURFACE, TABLETOP

Array = NDArray[np.float64]

_CALLED = {"floor": FLOOR, "wall": WALL, "table": TABLETOP, "ceiling": CEILING}
"""Our classes by those of PlaneSegmenter; others are not mapped."""

_NEAR = 0.02  # metres from the plane up to which a point is on it
_GROWTH = 0.004  # and this times its squared distance, 1/m


def seen_surfaces(surfaces: Boxes3D, cloud: PointCloud, T_map_cloud: Array, max_range: float) -> list[SeenSurface]:
    """Returns the mapped classes of surfaces, largest first, with the points of their cloud that lie in their boxes.

    Raises ValueError for surfaces in another frame than the cloud.
    """
    if surfaces.frame != cloud.frame:
        raise ValueError(f"the surfaces are in {surfaces.frame!r}, the cloud in {cloud.frame!r}")
    points = cloud.points.astype(np.float64)
    with np.errstate(invalid="ignore"):
        ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
        points, ranges = points[ranges <= max_range], ranges[ranges <= max_range]
    near = _NEAR + _GROWTH * ranges * ranges
    labels, seen = surfaces.labels(), []
    for k in np.argsort(-surfaces.sizes[:, 0] * surfaces.sizes[:, 1], kind="stable").tolist():
        if labels[k] not in _CALLED:
            continue
        axes = quaternion_to_matrix(surfaces.orientations[k])
        own = (points - surfaces.centers[k]) @ axes
        on = (np.abs(own[:, :2]) <= surfaces.sizes[k, :2] / 2).all(axis=1) & (np.abs(own[:, 2]) <= near)
        if on.any():
            facing = T_map_cloud[:3, :3] @ axes[:, 2]
            seen.append(SeenSurface(_CALLED[labels[k]], facing, transform_points(T_map_cloud, points[on])))
    return seen


def nodes_of(
    stamp: int,
    frame: str,
    classes: tuple[str, ...],
    objects: Sequence[MapObject],
    scores: Sequence[float],
    surfaces: Sequence[MapSurface],
) -> SceneGraph:
    """Returns objects, with their scores, and surfaces as nodes without relations.

    Surfaces have the ids that `surface_id` gives them.
    """
    names = (*classes, *(s for s in SURFACES if s not in classes)) if surfaces else classes
    entries: list[MapObject | MapSurface] = [*objects, *surfaces]
    boxes = [each.box for each in entries]
    class_ids = [o.class_id for o in objects] + [names.index(s.label) for s in surfaces]
    ids = [o.id for o in objects] + [surface_id(s) for s in surfaces]
    moving = np.array([*(o.moving for o in objects), *(np.nan for _ in surfaces)], np.float32)
    return SceneGraph(
        stamp=stamp,
        frame=frame,
        class_names=names,
        ids=np.array(ids, np.int64),
        class_ids=np.array(class_ids, np.int32),
        positions=np.array([center for center, _, _ in boxes]).reshape(-1, 3),
        sizes=np.array([size for _, size, _ in boxes]).reshape(-1, 3),
        orientations=quaternion_from_yaw(np.array([yaw for _, _, yaw in boxes])).reshape(-1, 4),
        scores=np.array([*scores, *(s.score for s in surfaces)], np.float32),
        last_seen=np.array([each.seen for each in entries], np.int64),
        subjects=np.zeros(0, np.int32),
        objects=np.zeros(0, np.int32),
        moving=None if np.isnan(moving).all() else moving,
        tracks=np.array([track for o in objects for track in o.tracks], np.int64),
        track_nodes=np.array([k for k, o in enumerate(objects) for _ in o.tracks], np.int32),
    )


def surface_id(surface: MapSurface) -> int:
    """Returns the id of a surface's node: that of the floor, or one from `SURFACE` down."""
    return FLOOR_ID if surface.label == FLOOR else SURFACE - surface.id
