"""Options that the training commands share, and the run that they describe."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from operators.training.console import Json, err_console

if TYPE_CHECKING:
    from operators.learning.augmentation import Variation
    from operators.learning.loop import Outcome, Settings, Task

Epochs = Annotated[int, typer.Option(min=1, help="Passes through the training data.")]
Batch = Annotated[
    int, typer.Option(min=1, help="Samples a step; of second networks chunks, of 32 boxes or 64 blocks each.")
]
Rate = Annotated[float, typer.Option("--learning-rate", min=1e-7, help="Largest learning rate.")]
Seed = Annotated[int, typer.Option(min=0, help="Decides everything random.")]
Size = Annotated[
    str | None,
    typer.Option(metavar="WxH", help="Input size, multiples of 16. Default: by the images, longest side 384."),
]
Width = Annotated[float, typer.Option(min=0.1, max=2.0, help="Width of the backbone, as a factor on its channels.")]
Backbone = Annotated[
    Path | None,
    typer.Option(
        "--backbone-weights", help="Start from these: torchvision's MobileNetV2 weights, or a checkpoint (.pt)."
    ),
]
Frozen = Annotated[
    int | None,
    typer.Option(
        help="Keep the backbone down to this stride as it is. Default: 4 with given weights, else 0 for none."
    ),
]
Initial = Annotated[
    Path | None,
    typer.Option(
        "--from",
        help="Fine-tuning: start from all weights of this checkpoint (.pt) that fit, or from a network file (.onnx), "
        "in 8 bits too. For a pair it is detector.onnx, with segmenter.onnx beside it.",
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint beside --out.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the files of an earlier training.")]
Flip = Annotated[bool, typer.Option(help="Mirror images: not where left and right differ, as in text.")]
Strength = Annotated[
    float, typer.Option("--variation", min=0, max=2, help="Strength of the random changes of training images.")
]
Every = Annotated[int, typer.Option(min=1, help="Score after every so many epochs.")]
Workers = Annotated[int, typer.Option(min=1, help="Threads that prepare what is learned from.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Threads that compute. Default: one a core.")]
Device = Annotated[str | None, typer.Option(help="cpu, cuda, cuda:1 ... Default: a GPU where there is one.")]
Bfloat16 = Annotated[
    bool,
    typer.Option(help="Compute convolutions in bfloat16: twice as fast on processors that have it, slower on others."),
]


class TrainingBar:
    """Shows all steps in a progress bar; a line for each epoch stays on the screen."""

    def __init__(self, bar: Progress) -> None:
        self._bar, self._mean = bar, dict[str, float]()

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


@dataclass(frozen=True, kw_only=True)
class Training:
    """The options of every training command."""

    epochs: Epochs
    resume: Resume = False
    overwrite: Overwrite = False
    batch: Batch = 16
    learning_rate: Rate = 1e-3
    seed: Seed = 0
    evaluate_every: Every = 1
    workers: Workers = 2
    threads: Threads = None
    device: Device = None
    json: Json = False

    @property
    def settings(self) -> Settings:
        """The settings of the training loop."""
        from operators.learning.loop import Settings

        return Settings(**{f.name: getattr(self, f.name) for f in fields(Settings) if hasattr(self, f.name)})

    def keep_earlier(self, out: Path, suffix: str = ".onnx") -> None:
        """Raises FileExistsError where an earlier training would be lost, ValueError for a file of another suffix."""
        if out.suffix != suffix:
            raise ValueError(f"--out {str(out)!r} should end in {suffix}")
        self.keep_files((out, out.with_suffix(".pt")))

    def keep_files(self, files: Iterable[Path]) -> None:
        """Raises FileExistsError where files of an earlier training would be lost."""
        there = [str(file) for file in files if file.exists()]
        if there and not (self.resume or self.overwrite):
            raise FileExistsError(f"{' and '.join(there)} exist already: give --resume, --overwrite or another --out")

    def run(self, task: Task, out: Path) -> Outcome:
        """Trains with a progress bar, or without one where output is for programs; writes the network to `out`."""
        from operators.learning.loop import train

        if self.json:
            return train(task, self.settings, out, resume=self.resume)
        losses, left = TextColumn("{task.fields[losses]}"), TimeRemainingColumn()
        columns = TextColumn("epoch {task.fields[epoch]}"), BarColumn(), MofNCompleteColumn(), losses, left
        with Progress(*columns, console=err_console, transient=True) as bar:
            return train(task, self.settings, out, resume=self.resume, progress=TrainingBar(bar))


@dataclass(frozen=True, kw_only=True)
class ImageTraining(Training):
    """Also the options of what learns from images."""

    flip: Flip = True
    variation: Strength = 1.0
    bfloat16: Bfloat16 = False

    @property
    def changes(self) -> Variation:
        """The random changes of training images."""
        from operators.learning.augmentation import Variation

        return Variation(flip=0.5 if self.flip else 0.0).times(self.variation)


def takes(kind: type[Training], **defaults: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Makes a command of a function with an argument `options` of this kind, whose fields become options of the command
    line; `defaults` replace those of the kind."""

    def made(function: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(function, eval_str=True)
        hints = get_type_hints(kind, include_extras=True)
        shared = {
            f.name: inspect.Parameter(
                f.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=defaults.get(f.name, inspect.Parameter.empty if f.default is MISSING else f.default),
                annotation=hints[f.name],
            )
            for f in fields(kind)
        }

        @functools.wraps(function)
        def command(**given: Any) -> None:
            options = kind(**{name: given.pop(name) for name in shared})
            function(options=options, **given)

        others = [p.replace(kind=p.KEYWORD_ONLY) for name, p in own.parameters.items() if name != "options"]
        command.__signature__ = own.replace(parameters=[*others, *shared.values()])  # type: ignore[attr-defined]
        return command

    return made
