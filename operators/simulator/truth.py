"""Ground truth of the world, as messages: boxes in the image and in space, masks, poses, activities and relations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Activity, Boxes3D, Detections2D, Diagnostics, Level, Odometry, SceneGraph, SegmentationMap
from dataflow.messages.geometry import matrix_to_quaternion
from operators.simulator.classes import ACTIVITIES, ACTIVITY_IDS, CLASS_IDS, CLASSES, THINGS, VOID
from operators.simulator.drive import Drive
from operators.simulator.events import Change
from operators.simulator.maps import floor_of
from operators.simulator.relations import Nearness, spatial
from operators.simulator.rendering.optics import Optics, View
from operators.simulator.rendering.renderer import Renderer
from operators.simulator.scene import Thing, World
from operators.simulator.things.furnishing import FLOOR

Array = NDArray[np.float64]
_STEP = 1e-3  # seconds; velocities are differences over twice that


def visible_things(view: View, world: World, min_pixels: int) -> tuple[list[int], NDArray[np.int64], NDArray[np.int64]]:
    """Index, pixel count and box (x1, y1, x2, y2) of the things with an identity that a view shows, by rising id."""
    counts = np.bincount(view.instances.ravel())
    index_of = {thing.id: k for k, thing in enumerate(world.things) if thing.id}
    ids = [int(i) for i in np.flatnonzero(counts >= min_pixels) if i]
    boxes = np.zeros((len(ids), 4), np.int64)
    if ids:
        slot = np.full(len(counts), -1)
        slot[ids] = np.arange(len(ids))
        where = slot[view.instances]
        rows, columns = np.nonzero(where >= 0)
        of = where[rows, columns]
        boxes[:, :2] = max(view.instances.shape)
        np.minimum.at(boxes[:, 0], of, columns)
        np.minimum.at(boxes[:, 1], of, rows)
        np.maximum.at(boxes[:, 2], of, columns + 1)
        np.maximum.at(boxes[:, 3], of, rows + 1)
    return [index_of[i] for i in ids], counts[ids].astype(np.int64), boxes


def detections(
    view: View,
    renderer: Renderer,
    T_world_camera: Array,
    optics: Optics,
    t: float,
    *,
    min_pixels: int,
    shares: bool,
    stamp: int,
    camera_frame: str,
    world_frame: str,
) -> tuple[Detections2D, Boxes3D]:
    """The objects that a view shows, with their boxes in the image and, in the same order, in the world.

    The visible share of an object is its visible pixels over those it would have alone in an image without borders
    (`Renderer.silhouette`).
    """
    world = renderer.world
    things, counts, boxes = visible_things(view, world, min_pixels)
    visible = None
    if shares:
        alone = renderer.silhouette(things, T_world_camera, optics)
        visible = np.clip(counts / np.maximum(alone, counts), 0, 1).astype(np.float32)
    ids = np.array([world.things[k].id for k in things], np.int64)
    class_ids = np.array([CLASS_IDS[world.things[k].label] for k in things], np.int32)
    scores = np.ones(len(things), np.float32)
    flat = Detections2D(
        stamp=stamp,
        frame=camera_frame,
        width=optics.width,
        height=optics.height,
        class_names=THINGS,
        boxes=boxes.astype(np.float32),
        scores=scores,
        class_ids=class_ids,
        ids=ids,
        visible=visible,
        pixel_counts=counts,
    )
    oriented = [world.things[k].box(t) for k in things]
    solid = Boxes3D(
        stamp=stamp,
        frame=world_frame,
        class_names=THINGS,
        centers=_rows([T[:3, 3] for T, _ in oriented], 3),
        sizes=_rows([size for _, size in oriented], 3),
        orientations=_quaternions([T for T, _ in oriented]),
        scores=scores,
        class_ids=class_ids,
        ids=ids,
        velocities=_rows([velocity(world.things[k], t) for k in things], 3),
        visible=visible,
    )
    return flat, solid


def velocity(thing: Thing, t: float) -> Array:
    """Of the middle of a thing's box, m/s, in the world: a limb that swings moves it too."""
    if thing.still:
        return np.zeros(3)
    before, after = (thing.box(t + dt)[0][:3, 3] for dt in (-_STEP, _STEP))
    return np.asarray((after - before) / (2 * _STEP))


def masks(view: View, stamp: int, frame: str) -> SegmentationMap:
    """Class and instance of every pixel; surfaces (floor, walls, ceiling) have no instances, nothing is void."""
    return SegmentationMap(
        stamp=stamp, frame=frame, class_names=CLASSES, void=VOID, classes=view.classes, instances=view.instances
    )


def base_state(drive: Drive, t: float, stamp: int, world_frame: str, base_frame: str) -> Odometry:
    """The robot's true pose and velocity."""
    state = drive.state(t)
    return Odometry.from_matrix(
        state.T_world_base,
        stamp=stamp,
        frame=world_frame,
        child_frame=base_frame,
        linear=state.linear,
        angular=state.angular,
    )


def activities(world: World, t: float, first_stamp: int, stamp: int) -> Activity:
    """Returns what every mover does, on what, since when, and the goal it was given."""
    doings = world.doings(t)
    return Activity(
        stamp=stamp,
        class_names=ACTIVITIES,
        goals=tuple(d.goal for d in doings),
        subjects=np.array([d.thing for d in doings], np.int64),
        class_ids=np.array([ACTIVITY_IDS[d.activity] for d in doings], np.int32),
        scores=np.ones(len(doings), np.float32),
        objects=np.array([d.object for d in doings], np.int64),
        since=np.array([first_stamp + round(max(d.since, 0) * 1e9) for d in doings], np.int64),
    )


def events(now: Sequence[Change], stamp: int) -> Diagnostics:
    """Returns what begins (a warning) and what ends (ok) at one time."""
    return Diagnostics(
        stamp=stamp,
        names=tuple(change.name for change in now),
        messages=tuple(f"{change.text} {'begins' if change.begins else 'ends'}" for change in now),
        levels=np.array([Level.WARN if change.begins else Level.OK for change in now], np.uint8),
    )


class TrueGraph:
    """The true scene graph: all objects of the world and the floor, and the relations that hold."""

    def __init__(self, world: World, *, with_spatial: bool) -> None:
        self._world = world
        self._things = list(world.objects())
        self._nearness = Nearness(self._things) if with_spatial else None
        self._floor = floor_of(world)

    def at(self, t: float, T_world_base: Array, stamp: int, frame: str) -> SceneGraph:
        world = self._world
        boxes = [thing.box(t) for thing in self._things]
        low, high = self._floor
        ids = [FLOOR, *(thing.id for thing in self._things)]
        node = {id: k for k, id in enumerate(ids)}
        relations = world.relations(t)
        if self._nearness is not None:
            middles = {thing.id: T[:3, 3] for thing, (T, _) in zip(self._things, boxes, strict=True)}
            relations = relations + spatial(self._nearness.pairs(t), middles, T_world_base)
        return SceneGraph(
            stamp=stamp,
            frame=frame,
            class_names=CLASSES,
            labels=("floor", *(f"{thing.label} {thing.id}" for thing in self._things)),
            predicates=tuple(r.predicate for r in relations),
            ids=np.array(ids, np.int64),
            class_ids=np.array([CLASS_IDS["floor"], *(CLASS_IDS[t.label] for t in self._things)], np.int32),
            positions=_rows([(low + high) / 2, *(T[:3, 3] for T, _ in boxes)], 3),
            sizes=_rows([high - low, *(size for _, size in boxes)], 3),
            orientations=_quaternions([np.eye(4), *(T for T, _ in boxes)]),
            subjects=np.array([node[r.subject] for r in relations], np.int32),
            objects=np.array([node[r.object] for r in relations], np.int32),
        )


def _rows(vectors: list[Array], width: int) -> Array:
    return np.array(vectors, np.float64).reshape(-1, width)


def _quaternions(poses: list[Array]) -> Array:
    return matrix_to_quaternion(np.array(poses).reshape(-1, 4, 4))
