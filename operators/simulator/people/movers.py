"""Things that move: balls that roll to and fro, robots that drive a loop, what a person carries.

Everything repeats with a period, is smooth, and depends on time alone.
"""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np

from operators.simulator.people.persons import Person
from operators.simulator.people.scripts import Act, Timeline, mix
from operators.simulator.scene import CurrentActivity
from operators.simulator.shapes import Array, pose
from operators.simulator.trajectory import Trajectory


class Rolling:
    """A ball of a radius that rolls from a to b (2,) on the plane z, rests, and rolls back."""

    def __init__(
        self, a: Array, b: Array, radius: float, *, z: float = 0.0, seconds: float = 4.0, phase: float = 0.0
    ) -> None:
        self._a, self._b, self.radius, self._z = np.asarray(a, float), np.asarray(b, float), radius, z
        way = float(np.linalg.norm(self._b - self._a))
        self.timeline = Timeline(
            [
                Act("rolling", seconds, "roll away", (0.0, way)),
                Act("resting", 1.0, "rest", (way, way)),
                Act("rolling", seconds, "roll back", (way, 0.0)),
                Act("resting", 1.5, "rest", (0.0, 0.0)),
            ],
            phase,
        )
        self._direction = (self._b - self._a) / way

    def frame(self, t: float) -> Array:
        """Below the ball's middle, on what it rolls on."""
        x, y = self._a + self._run(t) * self._direction
        return pose(float(x), float(y), self._z)

    def parts(self, t: float) -> Array:
        """The ball about its middle, turned as far as it rolled."""
        angle = self._run(t) / self.radius
        axis = np.array([-self._direction[1], self._direction[0], 0.0])
        K = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0.0]])
        T = self.frame(t)
        T[2, 3] += self.radius
        T[:3, :3] = np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K
        return T[None]

    def doing(self, thing: int, t: float) -> CurrentActivity:
        act, _, began = self.timeline.at(t)
        return CurrentActivity(thing, act.activity, began, act.goal)

    def _run(self, t: float) -> float:
        act, x, _ = self.timeline.at(t)
        return mix(act.along, x)


STANDING = 0.05
"""A robot that is slower than this, m/s, counts as standing."""


class Driving:
    """A robot that drives a closed path; in its narrow bends it all but stands."""

    def __init__(self, path: Trajectory, phase: float = 0.0) -> None:
        self._path, self._phase = path, phase
        times = np.linspace(0, path.period, 4000, endpoint=False)
        drives = path.at(times).speed() >= STANDING
        turns = np.flatnonzero(drives != np.roll(drives, 1))
        self._turns = [(float(times[k]), "driving" if drives[k] else "resting") for k in turns]

    def frame(self, t: float) -> Array:
        return np.asarray(self._path.at([t + self._phase]).T_world_base()[0])

    def parts(self, t: float) -> Array:
        return self.frame(t)[None]

    def doing(self, thing: int, t: float) -> CurrentActivity:
        if not self._turns:
            return CurrentActivity(thing, "driving", 0.0, "drive a loop")
        u = (t + self._phase) % self._path.period
        begin, activity = self._turns[bisect_right(self._turns, (u, "~")) - 1]
        return CurrentActivity(thing, activity, t - (u - begin) % self._path.period, "drive a loop")


class CarriedObject:
    """A thing that lies still except while a person's hand has it: then it moves with the hand, upright."""

    def __init__(self, thing: int, T_rest: Array, person: Person, grasped_at: float) -> None:
        """`grasped_at` is a time at which the hand is at the thing without having lifted it."""
        self._thing, self._rest, self._person = thing, T_rest, person
        self._grip = person.grip(grasped_at)

    def frame(self, t: float) -> Array:
        T = self._rest.copy()
        if self._person.held(t) == self._thing:
            T[:3, 3] += self._person.grip(t) - self._grip
        return T

    def parts(self, t: float) -> Array:
        return self.frame(t)[None]
