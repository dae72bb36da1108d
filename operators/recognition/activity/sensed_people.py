"""Tracks of people as the sensors gave them, with what they did: the activity network is trained on them too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Boxes3D, Odometry, Pose, SceneGraph
from operators.recognition.activity.samples import LAG, STEP, sequences
from operators.recognition.activity.scene_agents import scene_moments
from operators.recognition.activity.tracked_people import simulated_labels
from operators.scene.scoring import boxes_of

_NEAR = 1.0  # metres on the ground between a node and the agent that it is of
_HALF = 0.5  # seconds


@dataclass(frozen=True, eq=False)
class SensedTrack:
    """One node while it was in the map: features (T, F), what its agent did `LAG` before (T,), -1 where it is of none.

    `now` (T,) is what it does, `right` (T, C) what is true within half a second, `plain` (T,) whether it is in view.
    """

    features: NDArray[np.float32]
    labels: NDArray[np.int64]
    now: NDArray[np.int64]
    right: NDArray[np.bool_]
    plain: NDArray[np.bool_]


def sensed_tracks(
    graphs: Sequence[SceneGraph],
    robots: Sequence[Pose | Odometry],
    truths: Sequence[SceneGraph],
    doings: Sequence[Mapping[int, str]],
    views: Sequence[set[int]],
    classes: Sequence[str],
    objects: Sequence[Boxes3D | None] = (),
) -> list[SensedTrack]:
    """Returns the agents of a map over time; `doings` and `views` give what true agents do, and which are in view.

    `objects` are what the recogniser takes besides. If graphs come n times as often as the network takes steps, each
    track is split into n, of every n-th moment.
    """
    of = [nearest_agents(graph, truth) for graph, truth in zip(graphs, truths, strict=True)]
    times = np.array([truth.stamp for truth in truths]) * 1e-9
    moments = list(scene_moments(graphs, robots, simulated_labels(), objects))
    agents = sorted({body for moment in moments for body in moment.unseen})
    found = []
    for track in sequences(iter(moments), agents):
        count = len(track.times)
        labels, now, plain = np.full(count, -1), np.full(count, -1), np.zeros(count, bool)
        right = np.zeros((count, len(classes)), bool)
        for k, row in enumerate(track.rows.tolist()):
            agent = of[row].get(track.agent)
            if agent is None or agent not in doings[row]:
                continue
            before = min(int(np.searchsorted(times, times[row] - LAG - 1e-6)), row)
            labels[k] = classes.index(doings[before].get(agent, doings[row][agent]))
            now[k], plain[k] = classes.index(doings[row][agent]), agent in views[row]
            for near in np.flatnonzero(np.abs(times - times[row]) <= _HALF + 1e-9).tolist():
                if agent in doings[near]:
                    right[k, classes.index(doings[near][agent])] = True
        apart = max(1, int(np.ceil(STEP / np.median(np.diff(track.times)) - 1e-6)))
        parts = [slice(begin, None, apart) for begin in range(apart)]
        found += [SensedTrack(track.features[p], labels[p], now[p], right[p], plain[p]) for p in parts]
    return [track for track in found if (track.labels >= 0).any()]


def nearest_agents(graph: SceneGraph, truth: SceneGraph) -> dict[int, int]:
    """Returns the true agent of each node that is one: the nearest of its class on the ground, nearest first."""
    mine, labels = boxes_of(graph)
    true, names = boxes_of(truth)
    rows = sorted(
        (float(np.hypot(*(mine[m][0] - true[t][0])[:2])), m, t)
        for m in mine
        for t in true
        if m > 0 and labels[m] == names[t] and "agent" in simulated_labels().roles(labels[m])
    )
    of: dict[int, int] = {}
    for away, m, t in rows:
        if away < _NEAR and m not in of and t not in of.values():
            of[m] = t
    return of


def write_tracks(file: Path, tracks: Sequence[SensedTrack]) -> None:
    """Writes the tracks of one world."""
    names = SensedTrack.__dataclass_fields__
    parts: dict[str, Any] = {name: np.concatenate([getattr(t, name) for t in tracks]) for name in names}
    np.savez_compressed(file, lengths=np.array([len(t.labels) for t in tracks]), **parts)


def read_tracks(folder: Path) -> list[SensedTrack]:
    """Returns the tracks of all worlds in a folder, by the names of the files. Raises FileNotFoundError without any."""
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise FileNotFoundError(f"{folder} has no tracks (*.npz); benchmarks/sensed_people.py makes them")
    found = []
    for file in files:
        with np.load(file) as kept:
            ends = np.cumsum(kept["lengths"])[:-1]
            rows = [np.split(kept[name], ends) for name in SensedTrack.__dataclass_fields__]
            found += [SensedTrack(*parts) for parts in zip(*rows, strict=True)]
    return found
