"""`dataflow train`. Heavy packages are imported when a command runs, so `--help` is quick."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from operators.training.console import Data, Json, SplitSeed, friendly, out_console, score_words
from operators.training.evaluation import evaluate
from operators.training.options import (
    Backbone,
    Batch,
    Bfloat16,
    Device,
    Epochs,
    Every,
    Flip,
    Frozen,
    Initial,
    Overwrite,
    Rate,
    Resume,
    Seed,
    Size,
    Strength,
    Threads,
    Width,
    Workers,
)
from operators.training.people_commands import train_activity, train_posture
from operators.training.refining import BORDERS, REFINER, BorderEpochs, RefinerEpochs, command_of, train_second
from operators.training.running import input_size, keep_earlier, prepare, report, run_task, tell_data, variation_of
from operators.training.torchvision_command import train_torchvision
from operators.training.trunk_command import train_trunk

__all__ = ["evaluate", "train"]

train = typer.Typer(
    name="train",
    help="""Train the project's networks on your own data.

    Examples:

      dataflow train detector DATA --out out/mine.onnx
      dataflow train torchvision ssdlite320_mobilenet_v3_large DATA --weights COCO_V1
    """,
    no_args_is_help=True,
    rich_markup_mode="rich",
)
train.command("activity")(train_activity)
train.command("posture")(train_posture)
train.command("torchvision")(train_torchvision)
train.command("trunk")(train_trunk)
for each in (REFINER, BORDERS):
    train.command(each.kind)(command_of(each))


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
    flip: Flip = True,
    variation: Strength = 1.0,
    refiner_epochs: RefinerEpochs = 8,
    evaluate_every: Every = 1,
    workers: Workers = 2,
    threads: Threads = None,
    device: Device = None,
    bfloat16: Bfloat16 = False,
    json: Json = False,
) -> None:
    """Train a grid detector on a folder in COCO or YOLO format.

    Writes the best epoch's network (.onnx), which the operator `operators.detection:CustomDetector` takes as `weights`,
    and a checkpoint (.pt) to resume from. Then a refiner is trained on what it finds, and put into the file.

    Examples:

      dataflow train detector DATA --out out/mine.onnx
      dataflow train detector DATA --classes mug,bottle --epochs 30 --size 320x240
      dataflow train detector DATA --out out/mine.onnx --resume
    """
    with friendly():
        keep_earlier(out, resume, overwrite)
        from operators.detection.custom.folder import read_detection_data
        from operators.detection.custom.training import DetectorTask
        from operators.learning.loop import Settings

        read = read_detection_data(data, seed)
        read = read if classes is None else read.only([name.strip() for name in classes.split(",") if name.strip()])
        task = DetectorTask(
            read,
            input_size(size, [image.file for image in read.training[:20]]),
            seed=seed,
            width=width,
            variation=variation_of(flip, variation),
            backbone=backbone_weights,
        )
        prepare(task, backbone_weights, frozen_stride, initial)
        tell_data(read.notes, len(read.training), len(read.validation), read.classes, task.size, json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device, bfloat16=bfloat16,
        )  # fmt: skip
        outcome = run_task(task, settings, out, resume, json)
        second = train_second(REFINER, read, out, settings, refiner_epochs, task.variation, resume, json)
    report(outcome, "operators.detection:CustomDetector", json, seconds={"refiner": second})


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
    flip: Flip = True,
    variation: Strength = 1.0,
    border_epochs: BorderEpochs = 10,
    evaluate_every: Every = 1,
    workers: Workers = 2,
    threads: Threads = None,
    device: Device = None,
    bfloat16: Bfloat16 = False,
    json: Json = False,
) -> None:
    """Train a segmenter on a folder with images/, masks/ (PNGs of class ids, 255 void) and classes.txt.

    Then a second look at the borders of classes is trained on what it answers, and put into the file.

    Examples:

      dataflow train segmenter DATA --out out/segmenter.onnx
    """
    with friendly():
        keep_earlier(out, resume, overwrite)
        from operators.learning.loop import Settings
        from operators.segmentation.dataset import read_segmentation_data
        from operators.segmentation.training import SegmenterTask

        read = read_segmentation_data(data, seed)
        task = SegmenterTask(
            read,
            input_size(size, [image.image for image in read.training[:20]]),
            seed=seed,
            width=width,
            variation=variation_of(flip, variation),
            backbone=backbone_weights,
        )
        prepare(task, backbone_weights, frozen_stride, initial)
        tell_data(read.notes, len(read.training), len(read.validation), read.classes, task.size, json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device, bfloat16=bfloat16,
        )  # fmt: skip
        outcome = run_task(task, settings, out, resume, json)
        second = train_second(BORDERS, read, out, settings, border_epochs, task.variation, resume, json)
    report(outcome, "operators.segmentation:Segmenter", json, seconds={"borders": second})


@train.command("classifier")
def train_classifier(
    data: Data,
    epochs: Epochs = 40,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("classifier.onnx"),
    resume: Resume = False,
    overwrite: Overwrite = False,
    size: Annotated[str, typer.Option(metavar="WxH", help="Input size, multiples of 32.")] = "96x96",
    residual: Annotated[bool, typer.Option(help="Carry what comes into each block around it.")] = False,
    batch: Batch = 32,
    learning_rate: Rate = 1e-3,
    seed: Seed = 0,
    initial: Initial = None,
    flip: Flip = True,
    variation: Strength = 1.0,
    evaluate_every: Every = 1,
    workers: Workers = 2,
    threads: Threads = None,
    device: Device = None,
    bfloat16: Bfloat16 = False,
    json: Json = False,
) -> None:
    """Train a recognition network on a folder of images sorted by class (DATA/cat/*.jpg, DATA/dog/*.jpg ...).

    Four convolution blocks and two linear layers, for any number of classes. The operators
    `operators.recognition:ImageClassifier` and `FeatureExtractor` take the file as `weights`.

    Examples:

      dataflow train classifier DATA --out out/classifier.onnx
      dataflow train classifier DATA --residual --size 128x128
    """
    with friendly():
        keep_earlier(out, resume, overwrite)
        from operators.learning.backbone import start_from
        from operators.learning.loop import Settings
        from operators.recognition.dataset import read_classification_data
        from operators.recognition.training import ClassifierTask

        read = read_classification_data(data, seed)
        task = ClassifierTask(
            read,
            input_size(size, ()),
            seed=seed,
            variation=variation_of(flip, variation),
            architecture="residual" if residual else "plain",
        )
        if initial is not None:
            start_from(task.network, initial)
        tell_data(read.notes, len(read.training), len(read.validation), read.classes, task.size, json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device, bfloat16=bfloat16,
        )  # fmt: skip
        outcome = run_task(task, settings, out, resume, json)
    report(outcome, "operators.recognition:ImageClassifier", json)


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
    flip: Flip = True,
    variation: Strength = 1.0,
    refiner_epochs: RefinerEpochs = 8,
    border_epochs: BorderEpochs = 10,
    evaluate_every: Every = 1,
    workers: Workers = 2,
    threads: Threads = None,
    device: Device = None,
    bfloat16: Bfloat16 = False,
    json: Json = False,
) -> None:
    """Train a detector and a segmenter that learn together, on a folder with both boxes (COCO) and masks.

    Writes detector.onnx and segmenter.onnx of the best epoch, and a checkpoint (pair.pt) to resume from. Both
    get second networks, as by `dataflow train detector` and `segmenter`.
    `python -m operators.training.simulated_worlds DATA` renders such a folder.

    Examples:

      dataflow train pair DATA --out out/networks
    """
    with friendly():
        file = out / "pair.onnx"
        keep_earlier(file, resume, overwrite)
        from operators.detection.custom.folder import read_detection_data
        from operators.learning.loop import Settings
        from operators.segmentation.dataset import read_segmentation_data
        from operators.training.pair import DETECTOR, SEGMENTER, PairTask

        boxes, masks = read_detection_data(data, seed), read_segmentation_data(data, seed)
        task = PairTask(
            boxes,
            masks,
            input_size(size, [image.file for image in boxes.training[:20]]),
            seed=seed,
            width=width,
            variation=variation_of(flip, variation),
        )
        prepare(task, None, 0, initial)
        tell_data(boxes.notes, len(boxes.training), len(boxes.validation), masks.classes, task.size, json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device, bfloat16=bfloat16,
        )  # fmt: skip
        outcome = run_task(task, settings, file, resume, json)
        refiner = train_second(REFINER, boxes, out / DETECTOR, settings, refiner_epochs, task.variation, resume, json)
        borders = train_second(BORDERS, masks, out / SEGMENTER, settings, border_epochs, task.variation, resume, json)
    seconds = {"refiner": refiner, "borders": borders}
    report(outcome, "operators.detection:CustomDetector and operators.segmentation:Segmenter", json, seconds=seconds)


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

    Examples:

      dataflow train quantize out/mine.onnx DATA
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
