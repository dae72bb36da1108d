"""Training of the activity network on what trackers make of simulated people."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from operators.learning.balance import class_weights
from operators.learning.export import export_steps
from operators.recognition.activity.episodes import Episode
from operators.recognition.activity.features import NAMES
from operators.recognition.activity.recognizer import KIND
from operators.recognition.activity.samples import (
    LAG,
    Track,
    labels_of,
    macro_f1,
    right_within,
    tracked_sequences,
    true_sequences,
)
from operators.recognition.activity.sensed_people import SensedTrack
from operators.simulator.classes import ACTIVITIES
from operators.weights.network_file import SIMULATOR, TRAINED_ON

LAYERS = 2
TOLERANCE = 0.5
_STEPS = 120  # longest part of a track in one step of training
_STRIDES = (1, 2, 2, 3, 4)
_UNSEEN = 0.15  # how much a moment out of sight counts
_LEAST = 0.35
_STILL = [ACTIVITIES.index(name) for name in ("standing", "sitting", "resting")]
_SPEED = NAMES.index("speed, short")
_MOVING = [
    NAMES.index(name)
    for name in (
        *("speed, short", "speed, long", "rise, short", "rise, long", "way gone", "growth of the longer side"),
        *("seat: closing", "seat: speed along", "table: closing", "drink: closing", "drink: speed"),
    )
]
_SIDES = [NAMES.index("longer side"), NAMES.index("shorter side")]
_GROWN = [NAMES.index("longer side over its least"), NAMES.index("shorter side over its least")]
Scored = list[tuple[Track | SensedTrack, NDArray[np.int64], NDArray[np.bool_]]]


class ActivityNetwork(nn.Module):
    """Feature vectors (B, T, F) → scores (B, T, C) of activities.

    Method: Hochreiter and Schmidhuber, "Long short-term memory", 1997.
    """

    def __init__(self, features: int, classes: int, width: int = 96) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("scale", torch.ones(features))
        self.mean: Tensor
        self.scale: Tensor
        self.width = width
        self.enter = nn.Sequential(nn.Linear(features, width), nn.ReLU(), nn.Dropout(0.1))
        self.lstm = nn.LSTM(width, width, LAYERS, batch_first=True, dropout=0.2)
        self.leave = nn.Sequential(nn.Dropout(0.2), nn.Linear(width, classes))

    def forward(self, features: Tensor) -> Tensor:
        entered = self.enter((features - self.mean) / self.scale)
        passed, _ = self.lstm(entered)
        return torch.as_tensor(self.leave(passed))


class ActivityStep(nn.Module):
    """One step of several agents: features (N, F) and states (L, N, W) → probabilities (N, C) and next states."""

    def __init__(self, network: ActivityNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        network = self.network
        entered = network.enter((features[:, None] - network.mean) / network.scale)
        passed, (hidden, cell) = network.lstm(entered, (hidden, cell))
        return network.leave(passed[:, 0]).softmax(dim=1), hidden, cell


def _columns(group: str) -> tuple[list[int], NDArray[np.float32]]:
    """Returns the features of what stands around, and what they are where there is nothing of the kind."""
    columns = [k for k, name in enumerate(NAMES) if name.startswith(group)]
    far = {"seat: away", "table: gap", "drink: gap", "drink: second gap"}
    return columns, np.array([float(NAMES[k] in far) for k in columns], np.float32)


_AROUND = [_columns(group) for group in ("seat", "table", "drink")]
_AROUND.append(([NAMES.index("distance of the robot")], np.array([0.5], np.float32)))


class ActivityTask:
    """Trains an ActivityNetwork on episodes: each as it is, and `variations` times as a tracker would have it.

    `sensed` tracks are trained on as they are, each `repeats` times.
    """

    kind = KIND

    def __init__(
        self,
        training: Sequence[Episode],
        validation: Sequence[Episode],
        *,
        sensed: Sequence[SensedTrack] = (),
        sensed_validation: Sequence[SensedTrack] = (),
        repeats: int = 4,
        seed: int = 0,
        variations: int = 6,
    ) -> None:
        torch.manual_seed(seed)
        self.classes = ACTIVITIES
        self._episodes, self._variations = len(training), variations
        self._training = [
            (track.features, labels_of(episode, track, ACTIVITIES), np.where(track.seen, 1.0, _UNSEEN))
            for k, episode in enumerate(training)
            for track in drawn(episode, np.random.default_rng((seed, k)), variations)
        ]
        self._training += [
            (track.features, track.labels, np.where(track.plain, 1.0, _UNSEEN))
            for track in sensed
            for _ in range(repeats)
        ]
        self._sensed, self.samples = len(sensed), len(self._training)
        self._validation = scored_tracks(validation, seed)
        if sensed_validation:
            self._validation["sensed"] = [(t, t.now, t.right) for t in sensed_validation]
        self.network = ActivityNetwork(len(NAMES), len(ACTIVITIES))
        every = np.concatenate([features for features, _, _ in self._training])
        self.network.mean.copy_(torch.from_numpy(every.mean(axis=0)))
        self.network.scale.copy_(torch.from_numpy(np.maximum(every.std(axis=0), 0.05)))
        known = np.concatenate([labels[labels >= 0] for _, labels, _ in self._training])
        self._weights = class_weights(known, len(ACTIVITIES))

    def description(self) -> dict[str, Any]:
        return {
            "classes": list(self.classes),
            "features": list(NAMES),
            "episodes": self._episodes,
            "variations": self._variations,
            "sensed": self._sensed,
            "width": self.network.width,
        }

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Tensor, Tensor]:
        rows = [self._part(k, rng) for k, rng in zip(samples, rngs, strict=True)]
        longest = max(len(labels) for _, labels, _ in rows)
        features = np.zeros((len(rows), longest, len(NAMES)), np.float32)
        labels = np.full((len(rows), longest), -1)
        weights = np.zeros((len(rows), longest), np.float32)
        for i, (own, said, weight) in enumerate(rows):
            features[i, : len(own)], labels[i, : len(own)], weights[i, : len(own)] = own, said, weight
        return torch.from_numpy(features), torch.from_numpy(labels), torch.from_numpy(weights)

    def loss(self, batch: tuple[Tensor, Tensor, Tensor], device: torch.device) -> dict[str, Tensor]:
        features, labels, weights = (part.to(device) for part in batch)
        scores = self.network(features).float().flatten(0, 1)
        each = functional.cross_entropy(
            scores, labels.flatten(), self._weights.to(device), reduction="none", ignore_index=-1, label_smoothing=0.05
        )
        return {"entropy": (each * weights.flatten()).sum() / weights.sum().clamp(min=1.0)}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        """Scores by the mean of the macro-F1 over true, tracked and sensed agents, of the worlds to choose by."""
        found = {fed: score_of(network, tracks, self.classes) for fed, tracks in self._validation.items()}
        return {"score": float(np.mean(list(found.values()))), **found}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        assert isinstance(network, ActivityNetwork)
        described = {
            "kind": KIND,
            "architecture": f"lstm {LAYERS}x{network.width}",
            "classes": list(self.classes),
            "features": list(NAMES),
            "layers": LAYERS,
            "width": network.width,
            "lag": LAG,
            "training_episodes": self._episodes,
            "sensed_tracks": self._sensed,
            TRAINED_ON: SIMULATOR,
            **facts,
        }
        step = ActivityStep(copy.deepcopy(network).cpu())
        state = torch.zeros(LAYERS, 2, network.width)
        export_steps(step, (torch.zeros(2, len(NAMES)), state, state.clone()), described, file)

    def _part(
        self, k: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float64]]:
        """A part of a track of `_STEPS` at most, from anywhere: tracks begin at any time."""
        features, labels, weights = self._training[k]
        begin = int(rng.integers(max(1, len(labels) - _STEPS // 2)))
        rows = np.arange(begin, min(begin + _STEPS, len(labels)))
        rows, held = lingered(features[rows], labels[rows], rng)
        rows = rows + begin
        return varied(features[rows], held, rng), labels[rows], weights[rows]


def lingered(
    features: NDArray[np.float32], labels: NDArray[np.int64], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Returns the rows of a track (T, F) with a pause at a still moment, at times, and which rows the pause added.

    Simulated people never stand for long; others do.
    """
    rows = np.arange(len(labels))
    still = np.flatnonzero(np.isin(labels, _STILL) & (features[:, _SPEED] < 0.15))
    if not len(still) or rng.uniform() < 0.4:
        return rows, np.zeros(len(rows), bool)
    at, count = int(rng.choice(still)), int(rng.integers(3, 25))
    held = np.zeros(len(rows) + count, bool)
    held[at + 1 : at + 1 + count] = True
    return np.concatenate([rows[: at + 1], np.full(count, at), rows[at + 1 :]]), held


def varied(features: NDArray[np.float32], held: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.float32]:
    """Returns a part of a track with the extents of the agent varied, at times without its surroundings.

    No activity must depend on a single group of features. Motion is zero, up to noise, in rows that are `held`.
    """
    found = features + rng.normal(0, 0.01, features.shape).astype(np.float32)
    resting = found[held]
    resting[:, _MOVING] = rng.normal(0, 0.01, (len(resting), len(_MOVING)))
    found[held] = resting
    found[:, _SIDES] += rng.normal(0, 0.08, len(_SIDES)).astype(np.float32)
    found[:, _GROWN] += np.abs(rng.normal(0, 0.05, len(_GROWN))).astype(np.float32)
    for columns, nothing in _AROUND:
        if rng.uniform() < 0.25:
            found[:, columns] = nothing
    return found


def drawn(episode: Episode, rng: np.random.Generator, variations: int) -> list[Track]:
    """Returns an episode's agents, as they are and as trackers would have them, at several rates."""
    tracks = true_sequences(episode, int(rng.choice(_STRIDES)))
    for _ in range(variations):
        tracks += tracked_sequences(episode, int(rng.choice(_STRIDES)), rng)
    return tracks


def scored_tracks(episodes: Sequence[Episode], seed: int) -> dict[str, Scored]:
    """Returns tracks with what is true and what counts as right at each time, by where they come from; 4 a second."""
    found: dict[str, Scored] = {"true": [], "tracked": []}
    for k, episode in enumerate(episodes):
        rng = np.random.default_rng((seed, 1, k))
        for fed, tracks in (("true", true_sequences(episode, 2)), ("tracked", tracked_sequences(episode, 2, rng))):
            for track in tracks:
                column = episode.agents.tolist().index(track.agent)
                now = np.array([ACTIVITIES.index(episode.activities[int(r)][column]) for r in track.rows])
                found[fed].append((track, now, right_within(episode, track, ACTIVITIES, TOLERANCE)))
    return found


def score_of(network: nn.Module, tracks: Scored, classes: Sequence[str]) -> float:
    """Returns the macro-F1 of a network over the moments at which agents were seen."""
    device = next(network.parameters()).device
    true: list[str] = []
    said: list[str] = []
    for track, now, right in tracks:
        with torch.inference_mode():
            scores = network(torch.from_numpy(track.features)[None].to(device))[0].softmax(dim=1).cpu().numpy()
        best = scores.argmax(axis=1)
        for k in np.flatnonzero(track.plain if isinstance(track, SensedTrack) else track.seen):
            answer = classes[best[k]] if scores[k, best[k]] >= _LEAST else "unknown"
            true.append(classes[now[k]])
            said.append(classes[now[k]] if answer != "unknown" and right[k, best[k]] else answer)
    return macro_f1(true, said)
