"""Training of goal inference on the ways of simulated people."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from operators.recognition.episodes import Episode
from operators.recognition.goal_samples import Wayside, ways
from operators.recognition.tracked_people import tracked_moments, true_moments
from operators.scene.goals import NAMES
from operators.training.export import export_rows

KIND = "goals"
_STRIDES = (1, 2, 2, 3, 4)
_MOST = 40  # candidates, nowhere among them


class GoalNetwork(nn.Module):
    """Descriptions (N, F) of candidates → scores (N,); their softmax is a probability for each candidate."""

    def __init__(self, features: int, width: int = 48) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("scale", torch.ones(features))
        self.mean: Tensor
        self.scale: Tensor
        self.layers = nn.Sequential(
            nn.Linear(features, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 1)
        )

    def forward(self, described: Tensor) -> Tensor:
        return torch.as_tensor(self.layers((described - self.mean) / self.scale)[..., 0])


class GoalTask:
    """Trains a GoalNetwork on the ways of people in episodes, as they are and as trackers would have them."""

    kind = KIND

    def __init__(
        self, training: Sequence[Episode], validation: Sequence[Episode], *, seed: int = 0, variations: int = 3
    ) -> None:
        torch.manual_seed(seed)
        self._episodes, self._variations = len(training), variations
        self._training = [
            each
            for k, episode in enumerate(training)
            for way in drawn_ways(episode, np.random.default_rng((seed, 2, k)), variations)
            for each in way
        ]
        self._validation = {
            fed: [way for k, episode in enumerate(validation) for way in scored_ways(episode, fed, seed + k)]
            for fed in ("true", "tracked")
        }
        self.goals = GoalNetwork(len(NAMES))
        every = np.concatenate([each.rows for each in self._training])
        self.goals.mean.copy_(torch.from_numpy(every.mean(axis=0)))
        self.goals.scale.copy_(torch.from_numpy(np.maximum(every.std(axis=0), 0.05)))

    @property
    def network(self) -> nn.Module:
        return self.goals

    @property
    def samples(self) -> int:
        return len(self._training)

    def description(self) -> dict[str, Any]:
        return {"features": list(NAMES), "episodes": self._episodes, "variations": self._variations}

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        described = np.zeros((len(samples), _MOST, len(NAMES)), np.float32)
        there = np.zeros((len(samples), _MOST), bool)
        goals = np.zeros(len(samples), np.int64)
        for i, (k, rng) in enumerate(zip(samples, rngs, strict=True)):
            each = self._training[k]
            rows = _few(each, rng)
            described[i, : len(rows)] = each.rows[rows] + rng.normal(0, 0.01, (len(rows), len(NAMES)))
            there[i, : len(rows)] = True
            goals[i] = int(np.flatnonzero(rows == each.goal)[0])
        weights = np.array([_weight(self._training[k].ahead) for k in samples], np.float32)
        return torch.from_numpy(described), torch.from_numpy(there), torch.from_numpy(goals), torch.from_numpy(weights)

    def loss(self, batch: tuple[Tensor, Tensor, Tensor, Tensor], device: torch.device) -> dict[str, Tensor]:
        described, there, goals, weights = (part.to(device) for part in batch)
        scores = self.goals(described).masked_fill(~there, -30.0)
        each = nn.functional.cross_entropy(scores, goals, reduction="none")
        return {"entropy": (each * weights).sum() / weights.sum()}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        """Scores by the share of arrivals one second before which the true goal was first among the candidates."""
        found = {fed: first_share(network, tracks) for fed, tracks in self._validation.items()}
        return {"score": float(np.mean(list(found.values()))), **found}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        described = {
            "kind": KIND,
            "architecture": "three linear layers",
            "classes": [],
            "features": list(NAMES),
            "training_episodes": self._episodes,
            **facts,
        }
        export_rows(copy.deepcopy(network).cpu(), len(NAMES), described, file)


def drawn_ways(episode: Episode, rng: np.random.Generator, variations: int) -> list[list[Wayside]]:
    """Returns an episode's ways, as they are and as trackers would have them, at several rates."""
    agents = episode.agents.tolist()
    found = ways(episode, true_moments(episode, int(rng.choice(_STRIDES))), agents)
    for _ in range(variations):
        found += ways(episode, tracked_moments(episode, int(rng.choice(_STRIDES)), rng), agents)
    return found


def scored_ways(episode: Episode, fed: str, seed: int) -> list[list[Wayside]]:
    """Returns an episode's ways to candidates, 4 moments a second."""
    rng = np.random.default_rng((seed, 3))
    moments = true_moments(episode, 2) if fed == "true" else tracked_moments(episode, 2, rng)
    return [way for way in ways(episode, moments, episode.agents.tolist()) if way[0].ahead < np.inf]


def first_share(network: nn.Module, tracks: Sequence[Sequence[Wayside]]) -> float:
    """Returns the share of ways of which the goal was first at the last moment a second or more before arrival."""
    right = []
    for way in tracks:
        early = [each for each in way if each.ahead >= 1.0]
        if early:
            with torch.inference_mode():
                scores = network(torch.from_numpy(early[-1].rows)).numpy()
            right.append(int(scores[:-1].argmax()) == early[-1].goal)
    return float(np.mean(right)) if right else 0.0


def _weight(ahead: float) -> float:
    """Returns how much a moment counts: most in the last seconds before an arrival, when the way tells most."""
    return 0.3 if np.isinf(ahead) else 1.0 if ahead <= 3 else 0.4


def _few(each: Wayside, rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Returns the rows of at most `_MOST` candidates, the goal and nowhere among them."""
    last = len(each.rows) - 1
    if last < _MOST:
        return np.arange(last + 1)
    others = np.setdiff1d(np.arange(last), [each.goal])
    kept = rng.choice(others, _MOST - 2, replace=False)
    return np.sort(np.unique(np.concatenate([kept, [each.goal, last]])))
