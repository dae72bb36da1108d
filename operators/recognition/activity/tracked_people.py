"""Tracks as a tracker in space makes them of true boxes: seeded jitter, misses, cut views and lost objects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operators.labels import LabelSpace, labels_file
from operators.recognition.activity.episodes import Episode
from operators.recognition.activity.features import MATTERING
from operators.scene.bodies import Body

Array = NDArray[np.float64]
Rng = np.random.Generator

_MEMORY = 6.0  # seconds for which a mover out of sight is kept where it was
_RANGE = 6.5  # metres
_FOCAL, _HALF_WIDTH, _HALF_HEIGHT = 0.85 * 640, 320.0, 240.0
_USUAL = np.array([0.5, 0.59])  # sides of a person of whom one side was seen, metres
_STILL = np.zeros(3)
_LOST = {"drink": 0.6, "seat": 0.3, "support": 0.25}  # shares of things of these roles that maps lack at worst
_LOST_ELSE = 0.2


@lru_cache(maxsize=1)
def simulated_labels() -> LabelSpace:
    """Returns the label space of the simulated worlds, which episodes are of."""
    return LabelSpace.read(Path(labels_file("simulator")))


@dataclass(frozen=True)
class Moment:
    """A scene at one time as a map would give it: bodies, seconds since each agent was seen, and the robot's place."""

    time: float
    bodies: tuple[Body, ...]
    unseen: dict[int, float]
    robot: Array | None
    row: int
    """Of the episode."""


def true_moments(episode: Episode, stride: int) -> Iterator[Moment]:
    """Yields every so many rows as they are."""
    agents = set(episode.agents.tolist())
    mattering = [k for k, label in enumerate(episode.labels) if simulated_labels().roles(label) & MATTERING]
    for row in range(0, len(episode.times), stride):
        bodies = tuple(_body(episode, row, k) for k in mattering)
        unseen = dict.fromkeys(sorted(agents), 0.0)
        yield Moment(float(episode.times[row]), bodies, unseen, episode.camera[row, :2, 3].copy(), row)


def tracked_moments(episode: Episode, stride: int, rng: Rng) -> Iterator[Moment]:
    """Yields every so many rows as a tracker on the robot would have them; the strength of its errors is drawn.

    Agents are seen where the camera looks, up to 6.5 m; images cut what is near. Out of sight they stay for 6 s where
    they were. Some objects are not in the map; what a hand takes stays where it lay, or moves with it.
    """
    agents = set(episode.agents.tolist())
    noise = _Noise(rng)
    roles = [simulated_labels().roles(label) for label in episode.labels]
    things = [k for k, own in enumerate(roles) if own & MATTERING and int(episode.ids[k]) not in agents]
    mapped = [k for k in things if rng.uniform() > noise.lost(roles[k])]
    offsets = {k: _thing_error(rng, noise, episode.boxes[0, k]) for k in mapped}
    resting = [k for k in mapped if rng.uniform() < 0.6 or not np.ptp(episode.boxes[:, k], axis=0).any()]
    still = {k: _shifted(_body(episode, 0, k), offsets[k]) for k in resting}
    everywhere = rng.uniform() < 0.35
    known: dict[int, tuple[Body, float]] = {}
    hidden = dict.fromkeys(range(len(episode.ids)), False)
    told = rng.uniform() < 0.9
    for row in range(int(rng.integers(stride)), len(episode.times), stride):
        time = float(episode.times[row])
        for k, id in enumerate(episode.ids.tolist()):
            if id not in agents:
                continue
            hidden[k] = rng.uniform() < (0.8 if hidden[k] else noise.hides)
            body = None if hidden[k] else noise.seen(_body(episode, row, k), episode.camera[row], everywhere)
            if body is not None:
                known[id] = body, time
            elif id in known and time - known[id][1] > _MEMORY:
                del known[id]
        bodies = [still[k] if k in still else _shifted(_body(episode, row, k), offsets[k]) for k in mapped]
        bodies += [body for body, _ in known.values()]
        unseen = {i: time - at for i, (_, at) in known.items()}
        yield Moment(time, tuple(bodies), unseen, episode.camera[row, :2, 3].copy() if told else None, row)


class _Noise:
    """Errors of one tracker, whose strength is drawn."""

    def __init__(self, rng: Rng) -> None:
        self._rng = rng
        self.place = rng.uniform(0.005, 0.09)
        self.extent = rng.uniform(0.005, 0.08)
        self.one_sided = rng.uniform(0, 0.8)
        self.cut = rng.uniform(0, 0.25)
        self.hides = rng.uniform(0, 0.12)
        self.loses = rng.uniform(0, 1)
        self.top = -rng.uniform(0, 0.03)

    def lost(self, roles: frozenset[str]) -> float:
        """Returns the probability that a thing is not in the map."""
        return self.loses * max((share for role, share in _LOST.items() if role in roles), default=_LOST_ELSE)

    def seen(self, body: Body, camera: Array, everywhere: bool) -> Body | None:
        """Returns an agent as it is seen, None where it is not."""
        rng = self._rng
        shown = (0.0, 1.0) if everywhere else _shown(body, camera)
        if shown is None:
            return None
        bottom, height = body.bottom + shown[0] * body.size[2], (shown[1] - shown[0]) * body.size[2]
        if rng.uniform() < self.cut:  # a table or a shelf hides its foot
            raised = rng.uniform(0.1, 0.5) * height
            bottom, height = bottom + raised, height - raised
        sides = np.sort(body.size[:2])
        if body.person and rng.uniform() < self.one_sided:
            keep = rng.uniform(0, 1)
            sides = keep * sides + (1 - keep) * _USUAL
        sides = np.maximum(sides + rng.normal(0, self.extent, 2), 0.05)
        center = np.array([body.center[0], body.center[1], bottom + height / 2])
        center += rng.normal(0, 1, 3) * np.array([self.place, self.place, 0.3 * self.place])
        size = np.array([sides[1], sides[0], max(height + self.top + rng.normal(0, 0.4 * self.extent), 0.05)])
        yaw = body.yaw + rng.normal(0, 0.3)
        return Body(body.id, body.label, center, size, float(yaw), _STILL, body.roles)


def _shown(body: Body, camera: Array) -> tuple[float, float] | None:
    """Returns which part of an agent's height an image shows, (0, 1) for all; None where that is too little."""
    R, eye = camera[:3, :3], camera[:3, 3]
    middle = R.T @ (body.center - eye)
    if not 0.5 < middle[2] < _RANGE or abs(middle[0] / middle[2] * _FOCAL) > _HALF_WIDTH - 20:
        return None
    shares = np.linspace(0, 1, 17)
    column = body.center + (shares[:, None] - 0.5) * np.array([0, 0, body.size[2]])
    own = (column - eye) @ R
    inside = np.abs(own[:, 1] / np.maximum(own[:, 2], 0.1) * _FOCAL) < _HALF_HEIGHT
    if inside.mean() < 0.45:
        return None
    return float(shares[inside][0]), float(shares[inside][-1])


def _thing_error(rng: Rng, noise: _Noise, box: NDArray[np.float32]) -> Array:
    """Returns how far a mapped thing is from where it is and how much larger, (6,) metres."""
    size = np.abs(box[3:6]).astype(np.float64)
    return np.concatenate([rng.normal(0, 0.5 * noise.place, 3), rng.normal(0, 1, 3) * 0.15 * noise.loses * size])


def _shifted(body: Body, error: Array) -> Body:
    return replace(body, center=body.center + error[:3], size=np.maximum(body.size + error[3:], 0.03))


def _body(episode: Episode, row: int, k: int) -> Body:
    box = episode.boxes[row, k].astype(np.float64)
    label = episode.labels[k]
    return Body(int(episode.ids[k]), label, box[:3], box[3:6], float(box[6]), _STILL, simulated_labels().roles(label))
