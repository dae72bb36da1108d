"""Episodes of people and other movers in simulated worlds, as true boxes over time: no image is rendered.

Each world is drawn from a separate seed and driven through; `operators.recognition.activity.tracked_people` derives
from it what a tracker would see.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operators.recognition.activity.episodes import Episode
from operators.simulator.drive import Drive
from operators.simulator.scene import Thing
from operators.simulator.sensors.frames import BODY_TO_OPTICAL, mounted
from operators.simulator.worlds.make import make_world
from operators.training.made_worlds import Chosen, file_of, write_lacking

TRAINING, VALIDATION, HELD_OUT = 40_000, 45_000, 50_000
"""First seeds of the worlds to train on, to choose by, and to report on."""
RATE, SECONDS = 8.0, 45.0
_SPEED = 0.5  # m/s, of the robot; as SimulatedRobot drives
_GOAL = re.compile(r"(?:sit down (?:at|on)|drink from) \w+ (\d+)$")


def watched(kind: str, seed: int, people: int, *, rate: float = RATE, seconds: float = SECONDS) -> Episode:
    """Returns what happens in a world: boxes of all objects, activities, goals, and where the robot's camera is."""
    world = make_world(kind, seed, speed=_SPEED, hold=0.0, movers=True, people=people, tour=True)
    times = np.arange(round(seconds * rate)) / rate
    things = list(world.objects())
    boxes = np.array([[_row(thing, t) for thing in things] for t in times])
    doings = [world.doings(float(t)) for t in times]
    agents = [d.thing for d in doings[0]]
    camera = Drive(world.path).poses(times) @ mounted(world.camera_mount) @ BODY_TO_OPTICAL
    return Episode(
        name=f"{kind} {seed}",
        times=times,
        ids=np.array([thing.id for thing in things]),
        labels=tuple(thing.label for thing in things),
        boxes=boxes.astype(np.float32),
        camera=camera,
        agents=np.array(agents),
        activities=tuple(tuple(d.activity for d in now) for now in doings),
        goals=np.array([[_goal(d.goal) for d in now] for now in doings]),
    )


def write_episodes(folder: Path, chosen: Sequence[Chosen], processes: int) -> Iterator[int]:
    """Writes an episode of each world that the folder lacks; yields how many are made after each."""
    return write_lacking(folder, chosen, processes, watched)


def read_episodes(folder: Path, chosen: Sequence[Chosen]) -> list[Episode]:
    """Returns the episodes of these worlds. Raises FileNotFoundError for one that is not there."""
    return [Episode.read(file_of(folder, world)) for world in chosen]


def _row(thing: Thing, t: float) -> NDArray[np.float64]:
    """Centre, full size and heading (7,) of a thing's box."""
    T, size = thing.box(float(t))
    return np.array([*T[:3, 3], *size, np.arctan2(T[1, 0], T[0, 0])])


def _goal(text: str) -> int:
    found = _GOAL.match(text)
    return -1 if found is None else int(found[1])
