"""Sequences of feature vectors with what agents really did, of episodes: to train on and to score by."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.recognition.activity.episodes import Episode
from operators.recognition.activity.features import AgentWindow, Surroundings
from operators.recognition.activity.tracked_people import Moment, tracked_moments, true_moments
from operators.scene.graph.agents import UNKNOWN

LAG = 0.25
"""Delay of the answers in seconds: the moments after a change separate a beginning activity from a passing look."""

STEP = 0.15
"""Seconds that a step of the network takes at least, however often agents are seen."""


@dataclass(frozen=True, eq=False)
class Track:
    """One agent while it was known: features (T, F), times (T,), rows of the episode, whether it was seen just then."""

    agent: int
    features: NDArray[np.float32]
    times: NDArray[np.float64]
    rows: NDArray[np.int64]
    seen: NDArray[np.bool_]


def sequences(moments: Iterator[Moment], agents: Sequence[int]) -> list[Track]:
    """Returns what is known of each agent from when it appears until it is lost; then it begins anew."""
    around = Surroundings()
    windows: dict[int, AgentWindow] = {}
    open_: dict[int, list[tuple[NDArray[np.float32], float, int, bool]]] = {}
    found: list[Track] = []
    for moment in moments:
        around.update(moment.time, moment.bodies)
        there = {b.id: b for b in moment.bodies if b.id in moment.unseen and b.id in set(agents)}
        for i in [i for i in open_ if i not in there]:
            found.append(_closed(i, open_.pop(i)))
            del windows[i]
        for i, body in there.items():
            window = windows.setdefault(i, AgentWindow())
            window.add(moment.time, body)
            vector = window.vector(body, moment.unseen[i], around, moment.robot)
            open_.setdefault(i, []).append((vector, moment.time, moment.row, moment.unseen[i] <= 0))
    found += [_closed(i, rows) for i, rows in open_.items()]
    return [s for s in found if len(s.times) >= 3]


def true_sequences(episode: Episode, stride: int) -> list[Track]:
    """Returns the agents of an episode as they are."""
    return sequences(true_moments(episode, stride), episode.agents.tolist())


def tracked_sequences(episode: Episode, stride: int, rng: np.random.Generator) -> list[Track]:
    """Returns the agents of an episode as a tracker would have them."""
    return sequences(tracked_moments(episode, stride, rng), episode.agents.tolist())


def labels_of(episode: Episode, sequence: Track, classes: Sequence[str]) -> NDArray[np.int64]:
    """Returns what the agent did `LAG` before each time."""
    column = episode.agents.tolist().index(sequence.agent)
    rows = np.searchsorted(episode.times, sequence.times - LAG)
    return np.array([classes.index(episode.activities[int(r)][column]) for r in rows])


def right_within(episode: Episode, sequence: Track, classes: Sequence[str], seconds: float) -> NDArray[np.bool_]:
    """Returns (T, C): which answers are right at each time, transitions so many seconds away allowed for."""
    column = episode.agents.tolist().index(sequence.agent)
    right = np.zeros((len(sequence.times), len(classes)), bool)
    for k, time in enumerate(sequence.times):
        near = np.flatnonzero(np.abs(episode.times - time) <= seconds + 1e-9)
        for r in near:
            right[k, classes.index(episode.activities[int(r)][column])] = True
    return right


def macro_f1(true: Sequence[str], said: Sequence[str]) -> float:
    """Returns the mean of F1 over all classes that are true or said at any time; 0 where there are none.

    A class that is said and never true counts 0, as in scikit-learn. `unknown` is an answer and no class: a miss of the
    true class, and false for none.
    """
    pairs = Counter(zip(true, said, strict=True))
    scores = []
    for name in sorted({*true, *said} - {UNKNOWN}):
        hit = pairs[name, name]
        false = sum(n for (t, s), n in pairs.items() if s == name != t)
        miss = sum(n for (t, s), n in pairs.items() if t == name != s)
        scores.append(2 * hit / (2 * hit + false + miss))
    return sum(scores) / len(scores) if scores else 0.0


def _closed(agent: int, rows: list[tuple[NDArray[np.float32], float, int, bool]]) -> Track:
    return Track(
        agent,
        np.array([row[0] for row in rows], np.float32),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        np.array([row[3] for row in rows]),
    )
