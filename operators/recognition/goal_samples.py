"""Ways of people with where they were going, made of episodes: data to train goal inference and to score it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.recognition.episodes import Episode
from operators.recognition.tracked_people import Moment
from operators.scene.goals import CARRIERS, KINDS, NOWHERE, REACH, SEATS, GoalPath, Places

ARRIVALS = ("sitting_down", "sitting", "reaching")
"""Activities that begin where a way ends."""
UNDER_WAY = ("standing", "walking")
_LAST = 12.0  # seconds before an arrival from which on the goal counts


@dataclass(frozen=True, eq=False)
class Wayside:
    """One moment of a way: candidates as described (N + 1, F), their ids, the goal's row, seconds to the arrival."""

    rows: NDArray[np.float32]
    ids: tuple[int, ...]
    goal: int
    ahead: float


def ways(episode: Episode, moments: Iterator[Moment], agents: Sequence[int]) -> list[list[Wayside]]:
    """Returns each way of each person that ends at a candidate, and those that end nowhere, moment by moment.

    `ahead` is infinite on ways that end nowhere.
    """
    arrivals = {agent: _arrivals(episode, agent) for agent in agents}
    paths: dict[int, GoalPath] = {}
    found: dict[tuple[int, int], list[Wayside]] = {}
    for moment in moments:
        wanted = [b for b in moment.bodies if b.label in KINDS]
        places = Places.of(wanted, [b for b in moment.bodies if b.label in (*CARRIERS, *SEATS)])
        there = {b.id: b for b in moment.bodies}
        paths = {i: path for i, path in paths.items() if i in there}
        for agent in agents:
            if agent not in there or there[agent].label != "person":
                continue
            path = paths.setdefault(agent, GoalPath())
            path.add(moment.time, there[agent])
            column = episode.agents.tolist().index(agent)
            if episode.activities[moment.row][column] not in UNDER_WAY:
                continue
            near = places.around(there[agent].center, REACH)
            goal = int(episode.goals[moment.row, column])
            coming = next((t for t, g in arrivals[agent] if t > moment.time), math.inf)
            if goal == NOWHERE or math.isinf(coming):
                if goal != NOWHERE:
                    continue
                row, ahead, key = len(near.ids), math.inf, -1
            elif goal in near.ids and coming - moment.time <= _LAST:
                row, ahead, key = near.ids.index(goal), coming - moment.time, round(coming * 1e3)
            else:
                continue
            found.setdefault((agent, key), []).append(Wayside(path.describe(near), near.ids, row, ahead))
    return list(found.values())


def _arrivals(episode: Episode, agent: int) -> list[tuple[float, int]]:
    """Returns when an agent arrived at what: seconds, id."""
    column = episode.agents.tolist().index(agent)
    said = [now[column] for now in episode.activities]
    return [
        (float(episode.times[k]), int(episode.goals[k, column]))
        for k in range(1, len(said))
        if said[k] in ARRIVALS and said[k - 1] in UNDER_WAY and episode.goals[k, column] >= 0
    ]
