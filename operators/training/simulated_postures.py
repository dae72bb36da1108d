"""Silhouettes of simulated people with what they do: what a depth sensor sees of them from anywhere around.

Each world is drawn from a separate seed. Every person is looked at some times in each of its activities, from a place
that is drawn at random, with a sensor's noise and with masks that are wrong at their rims.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.recognition.posture.data import BODY, POSTURES, Postures
from operators.recognition.posture.silhouette import HALF, MIDDLE, silhouette
from operators.simulator.people.persons import Person
from operators.simulator.rendering.optics import Optics, View, camera_rays
from operators.simulator.rendering.renderer import Renderer
from operators.simulator.scene import Thing, World
from operators.simulator.sensors.frames import BODY_TO_OPTICAL, mounted
from operators.simulator.settings import ColorCamera, DepthCamera
from operators.simulator.worlds.make import make_world
from operators.training.made_worlds import Chosen, file_of, write_lacking

Array = NDArray[np.float64]
Rng = np.random.Generator

TRAINING, VALIDATION = 41_000, 45_500
"""First seeds of the worlds to train on, and of those to choose by."""
_SECONDS, _STEP = 60.0, 0.1
_LOOKS, _MORE = 24, 12  # at a person in each activity, and so many more at one who walks
_TRIES = 6  # places to look from
_SENSOR = DepthCamera()
_WIDTH, _HEIGHT, _FOCAL = 640, 480, 640 * ColorCamera().focal  # pixels
_STRIDE = 3  # every which pixel of the sensor gives a point
_SPECKS = 0.01  # share of the points that are lost
_LEAST_POINTS, _LEAST_SHARE = 15, 0.4  # of a person's image, in the sensor's view


@dataclass(frozen=True)
class _Look:
    """One look at a person: its place and the sensor's, what it gave, and the middle of the window in it."""

    T_world_camera: Array
    optics: Optics
    inside: NDArray[np.bool_]
    view: View
    own: NDArray[np.bool_]
    away: float


def looked_at(kind: str, seed: int, people: int) -> Postures:
    """Returns what sensors around them see of the people of a world, with what they do."""
    rng = np.random.default_rng((seed, 6))
    world = make_world(kind, seed, speed=0.5, hold=0.0, movers=True, people=people, tour=True)
    renderer = Renderer(world, seed)
    things = {thing.id: thing for thing in world.objects()}
    rows = []
    for t, id, activity in _moments(world, things, rng):
        renderer.at(t)
        made = _seen(renderer, things[id], t, world.camera_mount[2], rng)
        if made is not None:
            rows.append((*made, activity))
    return Postures(
        np.array([shape * 127 for shape, _, _ in rows], np.float32).astype(np.int8),
        np.array([body for _, body, _ in rows], np.float32),
        np.array([activity for _, _, activity in rows], np.int64),
    )


def write_postures(folder: Path, chosen: Sequence[Chosen], processes: int) -> Iterator[int]:
    """Writes the silhouettes of each world that the folder lacks; yields how many are made after each."""
    return write_lacking(folder, chosen, processes, looked_at)


def read_postures(folder: Path, chosen: Sequence[Chosen]) -> Postures:
    """Returns the silhouettes of these worlds together. Raises FileNotFoundError for one that is not there."""
    return Postures.joined([Postures.read(file_of(folder, world)) for world in chosen])


def _moments(world: World, things: dict[int, Thing], rng: Rng) -> list[tuple[float, int, int]]:
    """Times at which people are looked at, with their ids and activities, in order."""
    times = np.arange(0, _SECONDS, _STEP)
    doings = [{doing.thing: doing.activity for doing in world.doings(float(t))} for t in times]
    found = []
    for id in [id for id, thing in things.items() if thing.label == "person"]:
        said = np.array([doing.get(id, "") for doing in doings])
        for k, activity in enumerate(POSTURES):
            rows = np.flatnonzero(said == activity)
            if not len(rows):
                continue
            count = _LOOKS + _MORE if activity == "walking" else min(_LOOKS, max(4, len(rows)))
            for row in rng.choice(rows, count, replace=count > len(rows)):
                found.append((float(times[row]) + float(rng.uniform(-0.04, 0.04)), id, k))
    return sorted(found)


def _seen(
    renderer: Renderer, thing: Thing, t: float, height: float, rng: Rng
) -> tuple[NDArray[np.float32], Array] | None:
    """Returns a silhouette of a person and where its limbs are, from the first place from which it can be seen."""
    T, size = thing.box(t)
    middle, floor = T[:3, 3], T[2, 3] - size[2] / 2
    for _ in range(_TRIES):
        look = _look(renderer, thing.id, np.array([*middle[:2], floor]), height, rng)
        if look is None:
            continue
        points, own = _measured(look, rng)
        sensor = look.T_world_camera[:3, 3]
        ahead = (middle - sensor)[:2] / np.linalg.norm((middle - sensor)[:2])
        right = np.array([ahead[1], -ahead[0]])
        astray = ahead * rng.normal(0, 0.08) + right * rng.normal(0, 0.05)
        foot = np.array([*(middle[:2] + astray), floor + rng.normal(0, 0.02)])
        shape = silhouette(points, own, foot, sensor)
        if shape is not None:
            return shape, _body(thing, t, foot, right, ahead)
    return None


def _look(renderer: Renderer, id: int, foot: Array, height: float, rng: Rng) -> _Look | None:
    """Looks at a person from somewhere around it; None where too little of it is in view."""
    away = float(np.exp(rng.uniform(np.log(1.0), np.log(_SENSOR.max_range))))
    around = rng.uniform(-np.pi, np.pi)
    eye = foot + np.array([away * np.cos(around), away * np.sin(around), 0])
    eye[2] = np.clip(height + rng.uniform(-0.25, 0.25), 0.3, 2.0)
    pitch = rng.uniform(-0.1, 0.3)
    T = mounted((*eye.tolist(), 0.0, pitch, around + np.pi + rng.uniform(-0.42, 0.42))) @ BODY_TO_OPTICAL
    x, y, z = (invert(T) @ [*foot[:2], foot[2] + MIDDLE, 1])[:3]
    if z < 0.6:
        return None
    half, u, v = 1.15 * HALF * _FOCAL / z, _FOCAL * x / z, _FOCAL * y / z  # of the window, pixels
    side = int(np.clip(2 * half / _STRIDE * rng.uniform(0.6, 1.0), 36, 150))
    k = side / (2 * half)
    optics = Optics(side, side, _FOCAL * k, _FOCAL * k, (half - u) * k, (half - v) * k)
    view = renderer.view(T, optics, color=False)
    own = view.instances == id
    inside = np.zeros((side, side), bool)
    rows, columns = (_within(c, half, extent, k, side) for c, extent in ((v, _HEIGHT), (u, _WIDTH)))
    inside[rows, columns] = True
    whole, shown = int(own.sum()), int((own & inside).sum())
    if whole < 20 or shown < max(_LEAST_POINTS, 0.02 * side * side) or shown < _LEAST_SHARE * whole:
        return None
    return _Look(T, optics, inside, view, own, float(z))


def _within(middle: float, half: float, extent: int, k: float, side: int) -> slice:
    """The part of a window that lies in the sensor's image, along one axis."""
    first, last = int((-extent / 2 - (middle - half)) * k), int((extent / 2 - (middle - half)) * k)
    return slice(max(0, first), max(0, min(side, last)))


def _measured(look: _Look, rng: Rng) -> tuple[Array, NDArray[np.bool_]]:
    """Returns points (P, 3) in the world and which a segmenter calls the person's."""
    shape, side = look.own.shape, look.own.shape[0]
    grain = rng.normal(0, 1, (side // 2 + 1, side // 2 + 1))
    depth = look.view.depth.astype(np.float64)
    depth = depth + cv2.resize(grain, (side, side)) * _SENSOR.noise * np.minimum(depth, 9) ** 2
    there = look.inside & np.isfinite(depth) & (depth < _SENSOR.max_range) & (look.view.cosine > _SENSOR.grazing)
    there &= rng.random(shape) > _SPECKS
    mask = look.own.copy()
    if rng.random() < 0.6:
        rim = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~mask
        count = int(rng.integers(1, 6))
        mask |= rim & _blobs(shape, count, side * 0.12, rng) & (np.abs(depth - look.away) < 0.5)
    if rng.random() < 0.6:
        count = int(rng.integers(1, 4))
        mask &= ~_blobs(shape, count, side * 0.06, rng)
    if rng.random() < 0.4:
        thinner = cv2.erode(mask.astype(np.uint8), np.ones((2, 2), np.uint8)).astype(bool)
        mask = thinner if thinner.sum() > 20 else mask
    rays = camera_rays(look.T_world_camera, look.optics)
    points = rays[..., :3] + rays[..., 3:] * depth[..., None].astype(np.float32)
    return points[there].astype(np.float64), mask[there]


def _blobs(shape: tuple[int, ...], count: int, size: float, rng: Rng) -> NDArray[np.bool_]:
    """Ellipses anywhere, up to `size` pixels in radius."""
    found = np.zeros(shape, np.uint8)
    for _ in range(count):
        at = int(rng.integers(shape[1])), int(rng.integers(shape[0]))
        axes = int(rng.uniform(0.3, 1) * size) + 1, int(rng.uniform(0.3, 1) * size) + 1
        cv2.ellipse(found, at, axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
    return found.astype(bool)


def _body(thing: Thing, t: float, foot: Array, right: Array, ahead: Array) -> Array:
    """Returns hands, feet and pelvis from the window's middle (right, away, up), where the chest points, and the
    lean."""
    assert isinstance(thing.mover, Person)
    posture = thing.mover.posture(t)
    joints = np.vstack([posture.hands, posture.feet, posture.pelvis[None]]) - (foot + np.array([0, 0, MIDDLE]))
    facing = np.array([np.cos(posture.yaw), np.sin(posture.yaw)])
    placed = np.stack([joints[:, :2] @ right, joints[:, :2] @ ahead, joints[:, 2]], axis=1)
    found = np.array([*placed.ravel(), facing @ ahead, facing @ right, posture.lean])
    assert len(found) == BODY
    return found
