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
from operators.training.options import Backbone, Frozen, ImageTraining, Initial, Size, Width, takes
from operators.training.people_commands import train_activity, train_posture
from operators.training.refining import BORDERS, REFINER, BorderEpochs, RefinerEpochs, command_of, train_second
from operators.training.running import input_size, prepare, report, tell_data
from operators.training.torchvision_command import train_torchvision

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
for each in (REFINER, BORDERS):
    train.command(each.kind)(command_of(each))


@train.command("detector")
@takes(ImageTraining, epochs=100)
def train_detector(
    data: Data,
    options: ImageTraining,
    classes: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Only these classes of the data, in this order.")
    ] = None,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("detector.onnx"),
    size: Size = None,
    width: Width = 1.0,
    backbone_weights: Backbone = None,
    frozen_stride: Frozen = None,
    initial: Initial = None,
    refiner_epochs: RefinerEpochs = 8,
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
        options.keep_earlier(out)
        from operators.detection.custom.folder import read_detection_data
        from operators.detection.custom.training import DetectorTask

        read = read_detection_data(data, options.seed)
        read = read if classes is None else read.only([name.strip() for name in classes.split(",") if name.strip()])
        task = DetectorTask(
            read,
            input_size(size, [image.file for image in read.training[:20]]),
            seed=options.seed,
            width=width,
            variation=options.changes,
            backbone=backbone_weights,
        )
        prepare(task, backbone_weights, frozen_stride, initial)
        tell_data(read, task.size, options.json)
        outcome = options.run(task, out)
        second = train_second(REFINER, read, out, options, refiner_epochs)
    report(outcome, "operators.detection:CustomDetector", options.json, seconds={"refiner": second})


@train.command("segmenter")
@takes(ImageTraining, epochs=60)
def train_segmenter(
    data: Data,
    options: ImageTraining,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("segmenter.onnx"),
    size: Size = None,
    width: Width = 1.0,
    backbone_weights: Backbone = None,
    frozen_stride: Frozen = None,
    initial: Initial = None,
    border_epochs: BorderEpochs = 10,
) -> None:
    """Train a segmenter on a folder with images/, masks/ (PNGs of class ids, 255 void) and classes.txt.

    Then a second look at the borders of classes is trained on what it answers, and put into the file.

    Examples:

      dataflow train segmenter DATA --out out/segmenter.onnx
    """
    with friendly():
        options.keep_earlier(out)
        from operators.segmentation.dataset import read_segmentation_data
        from operators.segmentation.training import SegmenterTask

        read = read_segmentation_data(data, options.seed)
        task = SegmenterTask(
            read,
            input_size(size, [image.image for image in read.training[:20]]),
            seed=options.seed,
            width=width,
            variation=options.changes,
            backbone=backbone_weights,
        )
        prepare(task, backbone_weights, frozen_stride, initial)
        tell_data(read, task.size, options.json)
        outcome = options.run(task, out)
        second = train_second(BORDERS, read, out, options, border_epochs)
    report(outcome, "operators.segmentation:Segmenter", options.json, seconds={"borders": second})


@train.command("classifier")
@takes(ImageTraining, epochs=40, batch=32)
def train_classifier(
    data: Data,
    options: ImageTraining,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("classifier.onnx"),
    size: Annotated[str, typer.Option(metavar="WxH", help="Input size, multiples of 32.")] = "96x96",
    residual: Annotated[bool, typer.Option(help="Carry what comes into each block around it.")] = False,
    initial: Initial = None,
) -> None:
    """Train a recognition network on a folder of images sorted by class (DATA/cat/*.jpg, DATA/dog/*.jpg ...).

    Four convolution blocks and two linear layers, for any number of classes. The operators
    `operators.recognition:ImageClassifier` and `FeatureExtractor` take the file as `weights`.

    Examples:

      dataflow train classifier DATA --out out/classifier.onnx
      dataflow train classifier DATA --residual --size 128x128
    """
    with friendly():
        options.keep_earlier(out)
        from operators.learning.backbone import start_from
        from operators.recognition.dataset import read_classification_data
        from operators.recognition.training import ClassifierTask

        read = read_classification_data(data, options.seed)
        task = ClassifierTask(
            read,
            input_size(size, ()),
            seed=options.seed,
            variation=options.changes,
            architecture="residual" if residual else "plain",
        )
        if initial is not None:
            start_from(task.network, initial)
        tell_data(read, task.size, options.json)
        outcome = options.run(task, out)
    report(outcome, "operators.recognition:ImageClassifier", options.json)


@train.command("pair")
@takes(ImageTraining, epochs=100)
def train_pair(
    data: Data,
    options: ImageTraining,
    out: Annotated[Path, typer.Option(help="The folder to write to.")] = Path("networks"),
    size: Size = None,
    width: Width = 1.0,
    initial: Initial = None,
    refiner_epochs: RefinerEpochs = 8,
    border_epochs: BorderEpochs = 10,
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
        options.keep_earlier(file)
        from operators.detection.custom.folder import read_detection_data
        from operators.segmentation.dataset import read_segmentation_data
        from operators.training.pair import DETECTOR, SEGMENTER, PairTask

        boxes, masks = read_detection_data(data, options.seed), read_segmentation_data(data, options.seed)
        task = PairTask(
            boxes,
            masks,
            input_size(size, [image.file for image in boxes.training[:20]]),
            seed=options.seed,
            width=width,
            variation=options.changes,
        )
        prepare(task, None, 0, initial)
        tell_data(boxes, task.size, options.json, masks.classes)
        outcome = options.run(task, file)
        refiner = train_second(REFINER, boxes, out / DETECTOR, options, refiner_epochs)
        borders = train_second(BORDERS, masks, out / SEGMENTER, options, border_epochs)
    seconds = {"refiner": refiner, "borders": borders}
    report(
        outcome,
        "operators.detection:CustomDetector and operators.segmentation:Segmenter",
        options.json,
        seconds=seconds,
    )


@train.command("trunk")
def train_trunk(
    first: Annotated[
        Path, typer.Argument(help="A network file in 8 bits, which answers as before.", show_default=False)
    ],
    second: Annotated[Path, typer.Argument(help="Another one, which takes over its trunk.", show_default=False)],
    out: Annotated[Path, typer.Option(help="The folder to write both to.")] = Path("networks"),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that are there.")] = False,
) -> None:
    """Give two networks in 8 bits one trunk: those of `dataflow train pair`, each quantized.

    Operators in one process then compute it once for an image.

    Examples:

      dataflow train trunk out/detector.int8.onnx out/segmenter.int8.onnx --out out/networks
    """
    with friendly():
        outs = (out / first.name, out / second.name)
        there = [each for each in outs if each.exists() and not overwrite]
        if there:
            raise FileExistsError(f"{there[0]} exists already: give --overwrite or another --out")
        from operators.training.trunk import share_trunk

        out.mkdir(parents=True, exist_ok=True)
        share_trunk(first, second, *outs)
    out_console.print(f"{escape(str(outs[0]))} and {escape(str(outs[1]))} have one trunk")


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
