"""Training shown in the terminal: a bar for the epoch, the losses, the last score."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class TrainingBar:
    """A progress bar over all steps; a line for each epoch stays on the screen. Use it as a context manager."""

    def __init__(self, console: Console) -> None:
        self._bar = Progress(
            TextColumn("epoch {task.fields[epoch]}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[losses]}"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
        )
        self._mean: dict[str, float] = {}

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def begin(self, epochs: int, steps: int, done: int) -> None:
        self._epochs = epochs
        self._task = self._bar.add_task("", total=epochs * steps, completed=done * steps, epoch=done + 1, losses="")

    def step(self, epoch: int, losses: Mapping[str, float]) -> None:
        for name, value in losses.items():
            self._mean[name] = 0.95 * self._mean.get(name, value) + 0.05 * value
        text = " ".join(f"{name} {value:.3f}" for name, value in self._mean.items())
        self._bar.update(self._task, advance=1, epoch=f"{epoch + 1}/{self._epochs}", losses=text)

    def epoch(self, epoch: int, losses: Mapping[str, float], scores: Mapping[str, float] | None) -> None:
        words = [f"{name} {value:.4f}" for name, value in losses.items()]
        words += [f"[bold]{name} {value:.3f}[/bold]" for name, value in (scores or {}).items() if name != "score"]
        self._bar.console.print(f"epoch {epoch + 1}/{self._epochs}  " + "  ".join(words), highlight=False)
