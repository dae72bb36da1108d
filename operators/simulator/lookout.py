"""A place at which the robot stands, with its camera towards the people who choose among drinks and seats."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from operators.simulator.maps import mesh
from operators.simulator.rendering.native import open3d
from operators.simulator.scene import World
from operators.simulator.settings import ColorCamera
from operators.simulator.shapes import Array
from operators.simulator.trajectory import Trajectory

_PLACES, _HEADINGS = 80, 72  # on the round, and of the camera, that are tried
_CHOICES = 3  # things that a person goes to, from which on it chooses
_HEIGHTS = (0.4, 0.9, 1.5, 1.75)  # metres above the floor at which a person is to be seen, the head too
_STOPS = 9  # places on a person's way at which it is to be seen
_SLACK = 0.35  # metres before a point from which on what is hit counts as the thing itself
_INSIDE = 0.95  # share of the half image within which a point counts as in view
_CLOSE, _FAR = 4.0, 6.0  # metres up to which nearness does not matter, and from which on nothing is seen
_CIRCLE = 0.5  # metres, radius of the round that is never driven


def watching(world: World, camera: ColorCamera) -> World:
    """Returns a world whose robot stands on its round where the camera sees most of the people who choose.

    That is known from the still things, the ways of those people and all that they choose from; what they choose, and
    when, has no part in it. Raises ValueError without persons who choose, ImportError without Open3D.
    """
    points = _to_see(world)
    if not len(points):
        raise ValueError("no person here chooses among things, so there is none to watch: give people: 3 or 4")
    mount = camera.mount or world.camera_mount
    places = world.path.outline(_PLACES)
    eyes = np.column_stack([places, np.full(len(places), mount[2])])
    offsets = points[None] - eyes[:, None]  # (P, M, 3)
    away = np.linalg.norm(offsets, axis=2)
    worth = np.where(_free(world, eyes, offsets), np.minimum(1.0, _CLOSE / away), 0.0) * (away < _FAR)
    headings = np.linspace(-math.pi, math.pi, _HEADINGS, endpoint=False)
    shown = np.array([_in_view(offsets, heading, mount[4], camera) for heading in headings])  # (H, P, M)
    k, p = np.unravel_index(int(np.argmax((shown * worth).sum(axis=2))), shown.shape[:2])
    return replace(world, path=_standing(places[p], float(headings[k]) - mount[5]))


def _to_see(world: World) -> Array:
    """Points (M, 3): places on the ways of those who choose, and tops of all that they choose from."""
    points: list[Array] = []
    for lane in world.lanes:
        chosen = {
            placement.relation.object
            for placement in world.placements
            if placement.relation.subject == lane.mover
            and placement.relation.predicate in ("reaching_for", "sitting_on")
        }
        if len(chosen) < _CHOICES:
            continue
        stops = lane.line[np.linspace(0, len(lane.line) - 1, _STOPS).round().astype(int)]
        points += [np.array([x, y, height]) for x, y in stops for height in _HEIGHTS]
        for id in sorted(chosen):
            T, size = world.thing(id).box(0.0)
            points.append(T[:3, 3] + [0.0, 0.0, size[2] / 2])
    return np.array(points).reshape(-1, 3)


def _in_view(offsets: Array, heading: float, pitch: float, camera: ColorCamera) -> NDArray[np.bool_]:
    """Returns which points (..., 3) from an eye are in the image of a camera of a heading that looks down by pitch."""
    c, s = math.cos(heading), math.sin(heading)
    ahead, left, up = offsets @ [c, s, 0.0], offsets @ [-s, c, 0.0], offsets[..., 2]
    depth = ahead * math.cos(pitch) - up * math.sin(pitch)
    down = -ahead * math.sin(pitch) - up * math.cos(pitch)
    half_x = _INSIDE * 0.5 / camera.focal
    half_y = half_x * camera.height / camera.width
    return np.asarray((depth > 0) & (np.abs(left) < half_x * depth) & (np.abs(down) < half_y * depth))


def _free(world: World, eyes: Array, offsets: Array) -> NDArray[np.bool_]:
    """Returns which points (P, M), given from each eye (P, 3), nothing that stands still hides."""
    native, still = open3d(), mesh(world, 0, "world")
    scene, core = native.t.geometry.RaycastingScene(nthreads=1), native.core
    scene.add_triangles(core.Tensor(still.vertices), core.Tensor(still.triangles))
    rays = np.empty((*offsets.shape[:2], 6), np.float32)
    rays[..., :3] = eyes[:, None]
    rays[..., 3:] = offsets
    hit = scene.cast_rays(core.Tensor.from_numpy(rays), nthreads=1)["t_hit"].numpy()  # in lengths of the offsets
    return np.asarray(hit * np.linalg.norm(offsets, axis=2) > np.linalg.norm(offsets, axis=2) - _SLACK)


def _standing(place: Array, heading: float) -> Trajectory:
    """A path that begins at a place (2,) with a heading, and is never driven."""
    turn = heading + np.linspace(0, 2 * math.pi, 12, endpoint=False)
    middle = place + _CIRCLE * np.array([-math.sin(heading), math.cos(heading)])
    around = middle + _CIRCLE * np.column_stack([np.sin(turn), -np.cos(turn)])
    return Trajectory(around, hold=math.inf)
