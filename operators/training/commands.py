"""`dataflow train`. Heavy packages are imported when a command runs, so `--help` is quick."""

from __future__ import annotations

import json as jsonlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from operators.training.console import (
    Data,
    Json,
    SplitSeed,
    err_console,
    friendly,
    out_console,
    print_notes,
    score_words,
)
from operators.training.evaluation import evaluate

if TYPE_CHECKING:
    from torch import nn

    from operators.training.backbone import Backbone as Extractor
    from operators.training.loop import Outcome, Settings, Task

_LONGEST_SIDE, _MULTIPLE = 384, 32

__all__ = ["evaluate", "train"]

train = typer.Typer(
    name="train", help="Train the project's networks on your own data.", no_args_is_help=True, rich_markup_mode="rich"
)
Epochs = Annotated[int, typer.Option(min=1, help="Passes through the training images.")]
Batch = Annotated[int, typer.Option(min=1, help="Images a step.")]
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
    Path | None, typer.Option("--from", help="Start from all weights of this checkpoint (.pt) that fit: fine-tuning.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint beside --out.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the files of an earlier training.")]
Strength = Annotated[
    float, typer.Option("--variation", min=0, max=2, help="Strength of the random changes of training images.")
]
Every = Annotated[int, typer.Option(min=1, help="Score after every so many epochs.")]
Workers = Annotated[int, typer.Option(min=1, help="Threads that prepare images.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Threads that compute. Default: one a core.")]
Device = Annotated[str | None, typer.Option(help="cpu, cuda, cuda:1 ... Default: a GPU where there is one.")]
Bfloat16 = Annotated[
    bool,
    typer.Option(help="Compute convolutions in bfloat16: twice as fast on processors that have it, slower on others."),
]


@train.command("detector")
def train_detector(
    data: Data,
    classes: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Only these classes of the data, in this order.")
    ] = None,
    epochs: Epochs = 100,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("detector.onnx"),
    resume: Resume = False,
    overwrite: Overwrite = False,
    size: Size = None,
    batch: Batch = 16,
    learning_rate: Rate = 1e-3,
    seed: Seed = 0,
    width: Width = 1.0,
    backbone_weights: Backbone = None,
    frozen_stride: Frozen = None,
    initial: Initial = None,
    flip: Annotated[bool, typer.Option(help="Mirror images: not where left and right differ, as in text.")] = True,
    variation: Strength = 1.0,
    evaluate_every: Every = 1,
    workers: Workers = 2,
    threads: Threads = None,
    device: Device = None,
    bfloat16: Bfloat16 = False,
    json: Json = False,
) -> None:
    """Train a grid detector on a folder in COCO or YOLO format.

    Writes the best epoch's network (.onnx), which the operator `operators.detection:CustomDetector` takes as `weights`,
    and a checkpoint (.pt) to resume from.
    """
    with friendly():
        _free(out, resume, overwrite)
        from operators.detection.custom.dataset import read_detection_data
        from operators.detection.custom.training import DetectorTask
        from operators.training.augmentation import Variation
        from operators.training.loop import Settings

        read = read_detection_data(data, seed)
        read = read if classes is None else read.only([name.strip() for name in classes.split(",") if name.strip()])
        task = DetectorTask(
            read,
            _size(size, [image.file for image in read.training[:20]]),
            seed=seed,
            width=width,
            variation=Variation(flip=0.5 if flip else 0.0).times(variation),
            backbone=backbone_weights,
        )
        _prepare(task.network, task.backbone, backbone_weights, frozen_stride, initial)
        _tell(read.notes, len(read.training), len(read.validation), read.classes, task.size, json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device, bfloat16=bfloat16,
        )  # fmt: skip
        outcome = _run(task, settings, out, resume, json)
    _finish(outcome, "operators.detection:CustomDetector", json)


@train.command("segmenter")
def train_segmenter(
    data: Data,
    epochs: Epochs = 60,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("segmenter.onnx"),
    resume: Resume = False,
    overwrite: Overwrite = False,
    size: Size = None,
    batch: Batch = 16,
    learning_rate: Rate = 1e-3,
    seed: Seed = 0,
    width: Width = 1.0,
    backbone_weights: Backbone = None,
    frozen_stride: Frozen = None,
    initial: Initial = None,
    flip: Annotated[bool, typer.Option(help="Mirror images: not where left and right differ, as in text.")] = True,
    variation: Strength = 1.0,
    evaluate_every: Every = 1,
    workers: Workers = 2,
    threads: Threads = None,
    device: Device = None,
    bfloat16: Bfloat16 = False,
    json: Json = False,
) -> None:
    """Train a segmenter on a folder with images/, masks/ (PNGs of class ids, 255 void) and classes.txt."""
    with friendly():
        _free(out, resume, overwrite)
        from operators.segmentation.dataset import read_segmentation_data
        from operators.segmentation.training import SegmenterTask
        from operators.training.augmentation import Variation
        from operators.training.loop import Settings

        read = read_segmentation_data(data, seed)
        task = SegmenterTask(
            read,
            _size(size, [image.image for image in read.training[:20]]),
            seed=seed,
            width=width,
            variation=Variation(flip=0.5 if flip else 0.0).times(variation),
            backbone=backbone_weights,
        )
        _prepare(task.network, task.backbone, backbone_weights, frozen_stride, initial)
        _tell(read.notes, len(read.training), len(read.validation), read.classes, task.size, json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device, bfloat16=bfloat16,
        )  # fmt: skip
        outcome = _run(task, settings, out, resume, json)
    _finish(outcome, "operators.segmentation:Segmenter", json)


@train.command("pair")
def train_pair(
    data: Data,
    epochs: Epochs = 100,
    out: Annotated[Path, typer.Option(help="The folder to write to.")] = Path("networks"),
    resume: Resume = False,
    overwrite: Overwrite = False,
    size: Size = None,
    batch: Batch = 16,
    learning_rate: Rate = 1e-3,
    seed: Seed = 0,
    width: Width = 1.0,
    initial: Initial = None,
    flip: Annotated[bool, typer.Option(help="Mirror images: not where left and right differ, as in text.")] = True,
    variation: Strength = 1.0,
    evaluate_every: Every = 1,
    workers: Workers = 2,
    threads: Threads = None,
    device: Device = None,
    bfloat16: Bfloat16 = False,
    json: Json = False,
) -> None:
    """Train a detector and a segmenter that learn together, on a folder with both boxes (COCO) and masks.

    Writes detector.onnx and segmenter.onnx of the best epoch, and a checkpoint (pair.pt) to resume from.
    `python -m operators.training.simulated_worlds DATA` renders such a folder.
    """
    with friendly():
        file = out / "pair.onnx"
        _free(file, resume, overwrite)
        from operators.detection.custom.dataset import read_detection_data
        from operators.segmentation.dataset import read_segmentation_data
        from operators.training.augmentation import Variation
        from operators.training.loop import Settings
        from operators.training.pair import PairTask

        boxes, masks = read_detection_data(data, seed), read_segmentation_data(data, seed)
        task = PairTask(
            boxes,
            masks,
            _size(size, [image.file for image in boxes.training[:20]]),
            seed=seed,
            width=width,
            variation=Variation(flip=0.5 if flip else 0.0).times(variation),
        )
        _prepare(task.network, task.backbone, None, 0, initial)
        _tell(boxes.notes, len(boxes.training), len(boxes.validation), masks.classes, task.size, json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device, bfloat16=bfloat16,
        )  # fmt: skip
        outcome = _run(task, settings, file, resume, json)
    _finish(outcome, "operators.detection:CustomDetector and operators.segmentation:Segmenter", json)


@train.command("quantize")
def quantize(
    weights: Annotated[Path, typer.Argument(help="The network file that training wrote (.onnx).", show_default=False)],
    data: Data,
    out: Annotated[Path | None, typer.Option(help="The file to write. Default: WEIGHTS, as .int8.onnx.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it is there.")] = False,
    images: Annotated[int, typer.Option(min=1, help="Training images on which ranges are measured.")] = 32,
    seed: SplitSeed = None,
    json: Json = False,
) -> None:
    """Write a trained network in 8-bit integers: half the time on a CPU, at nearly the same score.

    Ranges are measured on training images of DATA; both files are then scored on its validation images.
    """
    with friendly():
        out = weights.with_suffix(".int8.onnx") if out is None else out
        if out.exists() and not overwrite:
            raise FileExistsError(f"{out} exists already: give --overwrite or another --out")
        from operators.training.quantization import quantize_with

        compared = quantize_with(weights, data, out, images, seed)
    if json:
        typer.echo(jsonlib.dumps({"weights": str(out), "files": compared}))
        return
    table = Table("file", "kB", "score", "ms an image", box=None)
    for file, scores in compared.items():
        kilobytes, said = f"{Path(file).stat().st_size / 1000:.0f}", score_words(scores, ("ap50", "ap", "miou"))
        table.add_row(escape(file), kilobytes, said, f"{scores['ms']:.1f}")
    out_console.print(table)


def _run(task: Task, settings: Settings, out: Path, resume: bool, quiet: bool) -> Outcome:
    from operators.training.loop import train as run
    from operators.training.progress import TrainingBar

    if quiet:
        return run(task, settings, out, resume=resume)
    with TrainingBar(err_console) as bar:
        return run(task, settings, out, resume=resume, progress=bar)


def _prepare(
    network: nn.Module, backbone: Extractor, weights: Path | None, frozen_stride: int | None, initial: Path | None
) -> None:
    from operators.training.backbone import start_from

    if initial is not None:
        start_from(network, initial)
    given = weights is not None or initial is not None
    backbone.freeze(frozen_stride if frozen_stride is not None else 4 if given else 0)


def _tell(
    notes: Sequence[str], training: int, validation: int, classes: Sequence[str], size: tuple[int, int], quiet: bool
) -> None:
    print_notes(notes, quiet)
    if quiet:
        return
    named = ", ".join(classes[:12]) + (" ..." if len(classes) > 12 else "")
    counts = f"{training} images to train on, {validation} to score on"
    told = f"{counts}; {len(classes)} classes: {named}; input {size[0]}x{size[1]}"
    err_console.print(told, highlight=False, markup=False, soft_wrap=True)


def _finish(outcome: Outcome, operator: str, json: bool) -> None:
    if json:
        typer.echo(
            jsonlib.dumps(
                {
                    "weights": str(outcome.file),
                    "checkpoint": str(outcome.checkpoint),
                    "scores": outcome.best,
                    "epoch": outcome.best_epoch,
                    "epochs": len(outcome.history),
                    "seconds": round(outcome.seconds, 1),
                    "history": outcome.history,
                }
            )
        )
        return
    scores = score_words(outcome.best, [name for name in outcome.best if name != "score"])
    file = escape(str(outcome.file))
    out_console.print(f"[green]{file}[/green]: {scores} in epoch {outcome.best_epoch}", highlight=False, soft_wrap=True)
    out_console.print(f"use it: `use: {operator}` with `params: {{weights: {file}}}`", highlight=False, soft_wrap=True)


def _size(text: str | None, files: Sequence[Path]) -> tuple[int, int]:
    """The input size: as given, or the images' median proportions with the longest side 384."""
    if text is not None:
        match = re.fullmatch(r"(\d+)x(\d+)", text)
        if match is None:
            raise ValueError(f"--size {text!r} should be WIDTHxHEIGHT in pixels, such as 320x240")
        return int(match[1]), int(match[2])
    import cv2
    import numpy as np

    shapes = [found.shape for found in (cv2.imread(str(file)) for file in files) if found is not None]
    ratio = float(np.median([width / height for height, width, _ in shapes])) if shapes else 1.0
    extents = (min(1.0, ratio) * _LONGEST_SIDE, min(1.0, 1 / ratio) * _LONGEST_SIDE)
    width, height = (max(_MULTIPLE, round(extent / _MULTIPLE) * _MULTIPLE) for extent in extents)
    return width, height


def _free(out: Path, resume: bool, overwrite: bool) -> None:
    """Keeps an earlier training from being lost."""
    if out.suffix != ".onnx":
        raise ValueError(f"--out {str(out)!r} should end in .onnx")
    checkpoint = out.with_suffix(".pt")
    there = [str(file) for file in (out, checkpoint) if file.exists()]
    if there and not (resume or overwrite):
        raise FileExistsError(f"{' and '.join(there)} exist already: give --resume, --overwrite or another --out")
