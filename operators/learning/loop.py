"""The training loop of all networks: AdamW with a cosine schedule, averaged weights, checkpoints that resume exactly.

Everything random follows from (seed, epoch, sample), so on a CPU a run that was interrupted and resumed ends with the
same weights, bit for bit, as one that was not.
"""

from __future__ import annotations

import copy
import math
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from operators.learning.files import TrainingFileError, load_safely, save_atomically

_AHEAD = 3  # batches prepared ahead of the one in training


class Task(Protocol):
    """A trainable task: a network with its data, its loss, its score and the form in which it is put to use."""

    @property
    def kind(self) -> str: ...
    @property
    def network(self) -> nn.Module: ...
    @property
    def samples(self) -> int: ...
    def description(self) -> dict[str, Any]:
        """Plain values that must be the same for a checkpoint to be resumed (classes, sizes, anchors)."""

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> Any:
        """The training batch of these samples; called from several threads."""

    def loss(self, batch: Any, device: torch.device) -> dict[str, Tensor]:
        """The parts of the loss of a batch; their sum is minimised."""

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        """Scores on the validation images; `score` is the one that decides which epoch is best."""

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        """Writes the network file."""


@dataclass(frozen=True)
class Settings:
    """Settings of a training. `threads` None means as torch chooses; `device` None means a GPU where there is one.

    `bfloat16` computes convolutions in half the bits: about twice as fast on processors that have it (avx512_bf16, amx,
    most GPUs), and much slower on others.
    """

    epochs: int = 100
    batch: int = 16
    learning_rate: float = 1e-3
    weight_decay: float = 0.02
    warmup: float = 0.03
    ema_decay: float = 0.998
    seed: int = 0
    evaluate_every: int = 1
    workers: int = 2
    threads: int | None = None
    device: str | None = None
    bfloat16: bool = False


class Progress(Protocol):
    """Is told how training goes."""

    def begin(self, epochs: int, steps: int, done: int) -> None: ...
    def step(self, epoch: int, losses: Mapping[str, float]) -> None: ...
    def epoch(self, epoch: int, losses: Mapping[str, float], scores: Mapping[str, float] | None) -> None: ...


class NoProgress:
    """Shows nothing."""

    def begin(self, epochs: int, steps: int, done: int) -> None:
        """Nothing to show."""

    def step(self, epoch: int, losses: Mapping[str, float]) -> None:
        """Nothing to show."""

    def epoch(self, epoch: int, losses: Mapping[str, float], scores: Mapping[str, float] | None) -> None:
        """Nothing to show."""


@dataclass
class Outcome:
    """Outcome of a training: the best epoch's scores, each epoch's record, the seconds spent (resumed parts
    included)."""

    file: Path
    checkpoint: Path
    best: dict[str, float] = field(default_factory=dict)
    best_epoch: int = 0
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0


def train(
    task: Task, settings: Settings, out: Path, *, resume: bool = False, progress: Progress | None = None
) -> Outcome:
    """Trains and writes `out` (the best epoch's network) and, beside it, a checkpoint `.pt` after every epoch.

    With `resume`, goes on from that checkpoint. Raises TrainingFileError where the checkpoint is of other data or
    settings, and FloatingPointError where the loss is no longer a number.
    """
    return _Run(task, settings, out, progress or NoProgress()).run(resume)


class _Run:
    def __init__(self, task: Task, settings: Settings, out: Path, progress: Progress) -> None:
        if settings.threads is not None:
            torch.set_num_threads(settings.threads)
        self.task, self.settings, self.progress = task, settings, progress
        self.device = torch.device(settings.device or ("cuda" if torch.cuda.is_available() else "cpu"))
        self.network = task.network.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).eval().requires_grad_(False)
        self.optimizer = torch.optim.AdamW(_groups(self.network, settings.weight_decay), lr=settings.learning_rate)
        self.steps = len(batches(range(task.samples), settings.batch))
        self.outcome = Outcome(out, out.with_suffix(".pt"))

    def run(self, resume: bool) -> Outcome:
        start = self._restore() if resume else 0
        self.progress.begin(self.settings.epochs, self.steps, start)
        for epoch in range(start, self.settings.epochs):
            began = time.monotonic()
            losses = self._epoch(epoch)
            last = epoch + 1 == self.settings.epochs
            scores = None
            if last or (epoch + 1) % self.settings.evaluate_every == 0:
                scores = self.task.evaluate(self.average)
            self.outcome.seconds += time.monotonic() - began
            self._keep(epoch, losses, scores)
            self.progress.epoch(epoch, losses, scores)
        return self.outcome

    def _epoch(self, epoch: int) -> dict[str, float]:
        self.network.train()
        sums: dict[str, float] = {}
        for step, batch in enumerate(self._batches(epoch)):
            done = epoch * self.steps + step
            rate = self.settings.learning_rate * schedule(done, self.settings.epochs * self.steps, self.settings.warmup)
            for group in self.optimizer.param_groups:
                group["lr"] = rate
            parts = self._loss(batch)
            total = torch.stack(list(parts.values())).sum()
            values = {name: float(part.detach()) for name, part in parts.items()}
            if not math.isfinite(sum(values.values())):
                raise FloatingPointError(
                    f"the loss became {values} in epoch {epoch + 1}, step {step + 1}; lower the learning rate "
                    f"({self.settings.learning_rate})"
                )
            self.optimizer.zero_grad(set_to_none=True)
            total.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
            self.optimizer.step()
            self._follow(done)
            for name, value in values.items():
                sums[name] = sums.get(name, 0.0) + value
            self.progress.step(epoch, values)
        return {name: value / self.steps for name, value in sums.items()}

    def _loss(self, batch: Any) -> dict[str, Tensor]:
        try:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.bfloat16):
                return self.task.loss(batch, self.device)
        except ValueError as error:
            if "more than 1 value per channel" not in str(error):
                raise
            raise ValueError(
                "at so small an input, normalisation needs more than one image a step; give a larger input, or at "
                f"least 2 images a step (now {min(self.settings.batch, self.task.samples)})"
            ) from error

    @torch.no_grad()
    def _follow(self, step: int) -> None:
        """Moves the averaged weights towards the trained ones; faster in the first steps."""
        decay = min(self.settings.ema_decay, (1 + step) / (10 + step))
        for mean, value in zip(self.average.state_dict().values(), self.network.state_dict().values(), strict=True):
            if mean.dtype.is_floating_point:
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)

    def _batches(self, epoch: int) -> Iterator[Any]:
        """The epoch's batches in order, prepared by a few threads ahead of time."""
        settings = self.settings
        order = np.random.default_rng((settings.seed, epoch)).permutation(self.task.samples).tolist()
        with ThreadPoolExecutor(max(1, settings.workers)) as pool:
            pending: deque[Future[Any]] = deque()
            for chunk in batches(order, settings.batch):
                rngs = [np.random.default_rng((settings.seed, epoch, sample)) for sample in chunk]
                pending.append(pool.submit(self.task.batch, chunk, rngs))
                if len(pending) > _AHEAD:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()

    def _keep(self, epoch: int, losses: Mapping[str, float], scores: Mapping[str, float] | None) -> None:
        outcome = self.outcome
        outcome.history.append({"epoch": float(epoch + 1), **losses, **(scores or {})})
        if scores is not None and (not outcome.best or scores["score"] >= outcome.best["score"]):
            outcome.best, outcome.best_epoch = dict(scores), epoch + 1
            facts = {
                "scores": outcome.best,
                "epoch": epoch + 1,
                "epochs": self.settings.epochs,
                "seed": self.settings.seed,
                "hours": round(outcome.seconds / 3600, 3),
            }
            self.task.export(self.average, facts, outcome.file)
        state = {
            "kind": self.task.kind,
            "description": self.task.description(),
            "settings": asdict(self.settings),
            "epoch": epoch + 1,
            "network": self.network.state_dict(),
            "ema": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "best": outcome.best,
            "best_epoch": outcome.best_epoch,
            "history": outcome.history,
            "seconds": outcome.seconds,
        }
        save_atomically(state, outcome.checkpoint)

    def _restore(self) -> int:
        """Takes over the state of the checkpoint; the number of epochs done."""
        file = self.outcome.checkpoint
        state = load_safely(file)
        for key, mine in (("kind", self.task.kind), ("description", self.task.description())):
            if state.get(key) != mine:
                raise TrainingFileError(f"{file} cannot be resumed: {_difference(key, state.get(key), mine)}")
        mine, saved = asdict(self.settings), dict(state["settings"])
        decisive = ("epochs", "batch", "learning_rate", "weight_decay", "warmup", "ema_decay", "seed", "bfloat16")
        different = [f"{k} was {saved.get(k)} and is {mine[k]}" for k in decisive if saved.get(k) != mine[k]]
        if different:
            longer = f"; to train longer, start anew from its weights: --from {file}"
            hint = longer if saved.get("epochs", 0) < mine["epochs"] else ""
            raise TrainingFileError(f"{file} cannot be resumed with other settings: {', '.join(different)}{hint}")
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["ema"])
        try:
            self.optimizer.load_state_dict(state["optimizer"])
        except ValueError:
            raise TrainingFileError(
                f"{file} cannot be resumed: other layers were frozen; give --from, --backbone-weights and "
                "--frozen-stride as when it was begun, or --overwrite"
            ) from None
        self.outcome.best, self.outcome.best_epoch = dict(state["best"]), int(state["best_epoch"])
        self.outcome.history, self.outcome.seconds = list(state["history"]), float(state["seconds"])
        return int(state["epoch"])


def batches(order: Sequence[int], size: int) -> list[list[int]]:
    """The samples by `size`. A single one that is left over joins the batch before: alone it has no statistics."""
    chunks = [list(order[i : i + size]) for i in range(0, len(order), size)]
    if size > 1 and len(chunks) > 1 and len(chunks[-1]) == 1:
        chunks[-2:] = [chunks[-2] + chunks[-1]]
    return chunks


def schedule(step: int, steps: int, warmup: float) -> float:
    """The learning rate's factor: a linear rise over the share `warmup` of the steps, then half a cosine to 2 %."""
    rise = max(1, int(steps * warmup))
    if step < rise:
        return (step + 1) / rise
    return 0.02 + 0.98 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise))) / 2


def _groups(network: nn.Module, decay: float) -> list[dict[str, Any]]:
    """Weight decay for weights, none for biases and normalisation."""
    parameters = [p for p in network.parameters() if p.requires_grad]
    return [
        {"params": [p for p in parameters if p.ndim > 1], "weight_decay": decay},
        {"params": [p for p in parameters if p.ndim <= 1], "weight_decay": 0.0},
    ]


def _difference(key: str, theirs: Any, mine: Any) -> str:
    if isinstance(theirs, dict) and isinstance(mine, dict):
        name = next(k for k in {**theirs, **mine} if theirs.get(k) != mine.get(k))
        return f"its {name} is {theirs.get(name)!r}, this run's is {mine.get(name)!r}"
    return f"its {key} is {theirs!r}, this run's is {mine!r}"
