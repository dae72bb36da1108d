"""The second networks, trained on what a first one answers and put into its file: a detector's refiner, and a
segmenter's second look at borders."""

from __future__ import annotations

import json as jsonlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from operators.training.console import Data, Json, friendly, out_console, score_words
from operators.training.options import Device, Every, Overwrite, Resume, Seed, Strength, Threads, Workers
from operators.training.running import run_task, tell_data, told_of

if TYPE_CHECKING:
    from operators.detection.custom.dataset import DetectionData
    from operators.segmentation.dataset import SegmentationData
    from operators.training.augmentation import Variation
    from operators.training.loop import Outcome, Settings, Task

REFINER, BORDERS = "refiner", "borders"
RATE, BATCH = {REFINER: 1.5e-3, BORDERS: 2e-3}, {REFINER: 8, BORDERS: 16}
"""Largest learning rate; chunks of a step, of 32 boxes and of 64 blocks."""
First = Annotated[Path, typer.Argument(help="The first network's file (.onnx).", show_default=False)]
Out = Annotated[Path | None, typer.Option(help="The file to write. Default: WEIGHTS itself.")]
SecondRate = Annotated[float, typer.Option("--learning-rate", min=1e-7, help="Largest learning rate.")]
Flip = Annotated[bool, typer.Option(help="Mirror images: not where left and right differ, as in text.")]
RefinerEpochs = Annotated[
    int, typer.Option(min=0, help="Passes of the refiner, which looks at each found box once more; 0 leaves it away.")
]
BorderEpochs = Annotated[
    int, typer.Option(min=0, help="Passes of the second look at the borders of classes; 0 leaves it away.")
]


def refined(
    data: DetectionData,
    detector: Path,
    settings: Settings,
    epochs: int,
    variation: Variation,
    resume: bool,
    quiet: bool,
) -> Outcome | None:
    """The last step of a detector's training: its refiner, by so many passes; None without any."""
    if epochs == 0:
        return None
    from operators.detection.custom.refiner_training import RefinerTask

    task = RefinerTask(data, detector, seed=settings.seed, variation=variation)
    return add_second(task, detector, detector, _own(settings, epochs, REFINER), resume, quiet)


def bordered(
    data: SegmentationData,
    segmenter: Path,
    settings: Settings,
    epochs: int,
    variation: Variation,
    resume: bool,
    quiet: bool,
) -> Outcome | None:
    """The last step of a segmenter's training: the second look at borders, by so many passes; None without any."""
    from operators.segmentation.scores import MOST_CLASSES

    if epochs == 0 or len(data.classes) > MOST_CLASSES:
        return None
    from operators.segmentation.border_training import BorderTask

    task = BorderTask(data, segmenter, seed=settings.seed, variation=variation)
    return add_second(task, segmenter, segmenter, _own(settings, epochs, BORDERS), resume, quiet)


def add_second(task: Task, first: Path, out: Path, settings: Settings, resume: bool, quiet: bool) -> Outcome:
    """Trains a second network, and writes the file of the first with it to `out`, which may be the same.

    Beside `out` stays its checkpoint, `.refiner.pt` or `.borders.pt`, from which `resume` goes on where it is there.
    """
    from operators.training.export import attach_second

    alone = out.with_suffix(f".{task.kind}.onnx")
    outcome = run_task(task, settings, alone, resume and alone.with_suffix(".pt").exists(), quiet)
    attach_second(first, alone, out)
    alone.unlink()
    return outcome


def _own(settings: Settings, epochs: int, kind: str) -> Settings:
    return replace(settings, epochs=epochs, batch=BATCH[kind], learning_rate=RATE[kind], bfloat16=False)


def train_refiner(
    weights: First,
    data: Data,
    out: Out = None,
    epochs: Annotated[int, typer.Option(min=1, help="Passes through the boxes of the training images.")] = 8,
    resume: Resume = False,
    overwrite: Overwrite = False,
    batch: Annotated[int, typer.Option(min=1, help="Chunks of 32 boxes a step.")] = BATCH[REFINER],
    learning_rate: SecondRate = RATE[REFINER],
    seed: Seed = 0,
    flip: Flip = True,
    variation: Strength = 1.0,
    evaluate_every: Every = 1,
    workers: Workers = 2,
    threads: Threads = None,
    device: Device = None,
    json: Json = False,
) -> None:
    """Train the refiner of a detector anew, on boxes that the detector finds in images of a folder.

    Best on images that the detector was not trained on. `dataflow train detector` and `pair` do this at their end; the
    detector itself stays as it is.

    Examples:

      dataflow train refiner out/mine.onnx DATA --out out/better.onnx
    """
    with friendly():
        out = _place(weights, out, REFINER, resume, overwrite)
        from operators.detection.custom.folder import read_detection_data
        from operators.detection.custom.refiner_training import RefinerTask
        from operators.training.augmentation import Variation
        from operators.training.loop import Settings
        from operators.weights import open_network

        network = open_network(weights, "detector")
        read = read_detection_data(data, seed).only(network.classes)
        tell_data(read.notes, len(read.training), len(read.validation), read.classes, network.size, json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device,
        )  # fmt: skip
        changes = Variation(flip=0.5 if flip else 0.0).times(variation)
        task = RefinerTask(read, weights, seed=seed, variation=changes)
        outcome = add_second(task, weights, out, settings, resume, json)
    _report(outcome, out, REFINER, json)


def train_borders(
    weights: First,
    data: Data,
    out: Out = None,
    epochs: Annotated[int, typer.Option(min=1, help="Passes through the blocks of the training images.")] = 10,
    resume: Resume = False,
    overwrite: Overwrite = False,
    batch: Annotated[int, typer.Option(min=1, help="Chunks of 64 blocks a step.")] = BATCH[BORDERS],
    learning_rate: SecondRate = RATE[BORDERS],
    seed: Seed = 0,
    flip: Flip = True,
    variation: Strength = 1.0,
    evaluate_every: Every = 1,
    workers: Workers = 2,
    threads: Threads = None,
    device: Device = None,
    json: Json = False,
) -> None:
    """Train a segmenter's second look at borders anew, on what the segmenter answers to images of a folder.

    Best on images that the segmenter was not trained on. `dataflow train segmenter` and `pair` do this at their end;
    the segmenter itself stays as it is.

    Examples:

      dataflow train borders out/segmenter.onnx DATA --out out/finer.onnx
    """
    with friendly():
        out = _place(weights, out, BORDERS, resume, overwrite)
        from operators.segmentation.border_training import BorderTask
        from operators.segmentation.dataset import read_segmentation_data
        from operators.training.augmentation import Variation
        from operators.training.loop import Settings
        from operators.weights import open_network

        size = open_network(weights, "segmenter").size
        read = read_segmentation_data(data, seed)
        tell_data(read.notes, len(read.training), len(read.validation), read.classes, size, json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device,
        )  # fmt: skip
        changes = Variation(flip=0.5 if flip else 0.0).times(variation)
        task = BorderTask(read, weights, seed=seed, variation=changes)
        outcome = add_second(task, weights, out, settings, resume, json)
    _report(outcome, out, BORDERS, json)


def _place(weights: Path, out: Path | None, kind: str, resume: bool, overwrite: bool) -> Path:
    """Tells the file to write. Keeps an earlier training from being lost."""
    out = weights if out is None else out
    there = [str(file) for file in (out, out.with_suffix(f".{kind}.pt")) if file.exists() and file != weights]
    if there and not (resume or overwrite):
        raise FileExistsError(f"{' and '.join(there)} exist already: give --resume, --overwrite or another --out")
    return out


def _report(outcome: Outcome, out: Path, kind: str, json: bool) -> None:
    if json:
        typer.echo(jsonlib.dumps({"weights": str(out), kind: told_of(outcome)}))
        return
    scores = score_words(outcome.best, [name for name in outcome.best if name != "score"])
    told = f"[green]{escape(str(out))}[/green]: {scores} in epoch {outcome.best_epoch}"
    out_console.print(told, highlight=False, soft_wrap=True)
