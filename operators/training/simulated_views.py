"""Views of small things in simulated worlds: parts of images in their own resolution, and what each pixel is of.

Each world is drawn from a seed of its own. Things that stand in it are looked at from anywhere around them, books most
often, since they stand in rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.detection.focus.views import CLASSES, MOST, NONE, Views
from operators.simulator import color
from operators.simulator.frames import BODY_TO_OPTICAL, mounted
from operators.simulator.noise import NoisePool
from operators.simulator.optics import Optics, View
from operators.simulator.renderer import Renderer
from operators.simulator.scene import Thing
from operators.simulator.settings import ColorCamera
from operators.simulator.worlds import make_world
from operators.training.made_worlds import Chosen, file_of, write_lacking

Array = NDArray[np.float64]
U8 = NDArray[np.uint8]
Rng = np.random.Generator

TRAINING, VALIDATION = 42_800, 45_700
"""First seeds of the worlds to train on, and of those to choose by."""
_SIDE = 128  # pixels
_VIEWS, _TRIES = 66, 5  # of a world, and places to look from for each
_BOOKS = 0.75  # share of the looks
_NEAR, _FAR = 0.6, 4.5  # metres
_CAMERA = ColorCamera()
_WIDTH, _HEIGHT, _FOCAL = 640, 480, 640 * _CAMERA.focal  # pixels
_ASIDE = 35  # pixels by which a thing is off the middle
_LEAST = 60  # pixels of the thing
_TURN = 0.8  # pixels by which images smear that are taken in a turn, standard deviation
_QUALITIES = (92, 85, 78)  # of images that were stored
_STORED = 0.6  # share of them


def seen_in(kind: str, seed: int, people: int) -> Views:
    """Returns what cameras see of the small things of a world."""
    rng = np.random.default_rng((seed, 8))
    world = make_world(kind, seed, speed=0.5, hold=0.0, movers=True, people=people, tour=True)
    renderer, pool = Renderer(world, seed), NoisePool(seed)
    things = [thing for thing in world.objects() if thing.label in CLASSES]
    labels = {thing.id: CLASSES.index(thing.label) for thing in things}
    t = float(rng.uniform(0, 60))
    renderer.at(t)
    books = [thing for thing in things if thing.label == "book"]
    others = [thing for thing in things if thing.label != "book"]
    images, owners, classes = [], [], []
    for _ in range(_VIEWS * _TRIES if things else 0):
        of = (books or others) if rng.random() < _BOOKS else (others or books)
        thing = of[int(rng.integers(len(of)))]
        look = _look(thing, t, world.camera_mount[2], rng)
        view = renderer.view(*look) if look is not None else None
        if view is None or (view.instances == thing.id).sum() < _LEAST:
            continue
        images.append(_developed(view, pool, rng))
        own, known = _owners(view, labels)
        owners.append(own)
        classes.append(known)
        if len(images) == _VIEWS:
            break
    shape = (-1, _SIDE, _SIDE)
    return Views(
        np.array(images, np.uint8).reshape(*shape, 3),
        np.array(owners, np.uint8).reshape(shape),
        np.array(classes, np.uint8).reshape(-1, MOST),
    )


def write_views(folder: Path, chosen: Sequence[Chosen], processes: int) -> Iterator[int]:
    """Writes the views of each world that the folder lacks; yields how many are made after each."""
    return write_lacking(folder, chosen, processes, seen_in)


def read_views(folder: Path, chosen: Sequence[Chosen]) -> Views:
    """Returns the views of these worlds together. Raises FileNotFoundError for one that is not there."""
    return Views.joined([Views.read(file_of(folder, world)) for world in chosen])


def _look(thing: Thing, t: float, height: float, rng: Rng) -> tuple[Array, Optics] | None:
    """Returns a camera's pose and the part of its image around a thing; None where that is not in its image."""
    T, _ = thing.box(t)
    middle = T[:3, 3]
    away, around = float(np.exp(rng.uniform(np.log(_NEAR), np.log(_FAR)))), rng.uniform(-np.pi, np.pi)
    eye = middle + np.array([away * np.cos(around), away * np.sin(around), 0])
    eye[2] = np.clip(height + rng.uniform(-0.25, 0.25), 0.3, 2.0)
    pitch, turn = rng.uniform(-0.1, 0.5), rng.uniform(-0.45, 0.45)
    T_world_camera = mounted((*eye.tolist(), 0.0, pitch, around + np.pi + turn)) @ BODY_TO_OPTICAL
    x, y, z = (invert(T_world_camera) @ [*middle, 1])[:3]
    if z < _NEAR / 2:
        return None
    u, v = _FOCAL * x / z, _FOCAL * y / z
    if abs(u) > _WIDTH / 2 or abs(v) > _HEIGHT / 2:
        return None
    u, v = np.array([u, v]) + rng.uniform(-_ASIDE, _ASIDE, 2)
    return T_world_camera, Optics(_SIDE, _SIDE, _FOCAL, _FOCAL, _SIDE / 2 - u, _SIDE / 2 - v)


def _developed(view: View, pool: NoisePool, rng: Rng) -> U8:
    """Returns what a camera makes of a view, in some light, at times in a turn, at times stored."""
    assert view.color is not None
    light = color.expose(view.color, float(rng.uniform(0.75, 1.3)))
    dx, dy = rng.normal(0, _TURN, 2).tolist()
    pixels = color.develop(color.blur(light, (dx, dy)), pool, rng, _CAMERA.read_noise, _CAMERA.shot_noise)
    if rng.random() >= _STORED:
        return pixels
    stored = cv2.imdecode(color.jpeg(pixels, int(rng.choice(_QUALITIES))), cv2.IMREAD_COLOR)
    assert stored is not None
    return np.asarray(stored[..., ::-1], np.uint8)


def _owners(view: View, labels: dict[int, int]) -> tuple[U8, U8]:
    """Returns which thing each pixel is of, the largest ones first, and their classes."""
    ids, counts = np.unique(view.instances, return_counts=True)
    known = [int(id) for id in ids[np.argsort(-counts, kind="stable")] if int(id) in labels][:MOST]
    owners, classes = np.zeros(view.instances.shape, np.uint8), np.full(MOST, NONE, np.uint8)
    for k, id in enumerate(known):
        owners[view.instances == id] = k + 1
        classes[k] = labels[id]
    return owners, classes
