"""`dataflow evaluate`. Heavy packages are imported when a command runs, so `--help` is quick."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Sequence
from typing import Annotated, TypeVar

import typer
from rich.markup import escape
from rich.table import Table

from operators.training.console import Data, Json, SplitSeed, Weights, friendly, out_console, print_notes
from operators.training.graph_evaluation import evaluate_graph

Sample = TypeVar("Sample")
Everything = Annotated[bool, typer.Option("--all", help="Score on all images, not only those for validation.")]

evaluate = typer.Typer(
    name="evaluate",
    help="""Score a network file on labelled data, or a graph by its metrics.

    Examples:

      dataflow evaluate detector DATA --weights out/mine.onnx
      dataflow evaluate graph slam --set duration=20s
    """,
    no_args_is_help=True,
    rich_markup_mode="rich",
)
evaluate.command("graph")(evaluate_graph)


@evaluate.command("detector")
def evaluate_detector(
    data: Data,
    weights: Weights,
    everything: Everything = False,
    seed: SplitSeed = None,
    json: Json = False,
) -> None:
    """Score a detector by COCO's rules on the validation images of a folder in COCO or YOLO format.

    Examples:

      dataflow evaluate detector DATA --weights out/mine.onnx
      dataflow evaluate detector DATA --weights out/mine.onnx --all --json
    """
    with friendly():
        from operators.detection.custom.assessment import assess
        from operators.detection.custom.folder import read_detection_data
        from operators.weights import training_seed

        read = read_detection_data(data, training_seed(weights) if seed is None else seed)
        chosen = every_image(read.training, read.validation) if everything else read.validation
        print_notes(read.notes, json)
        assessed = assess(weights, read.classes, chosen)
    if json:
        typer.echo(jsonlib.dumps(assessed))
        return
    images = scored(assessed["images"], len(every_image(read.training, read.validation)), everything)
    out_console.print(f"{weights.name}: {images}, {assessed['objects']} objects", markup=False, soft_wrap=True)
    table = Table("class", "AP50")
    for name, value in assessed["per_class"].items():
        table.add_row(escape(name), f"{value:.3f}")
    table.add_section()
    table.add_row("mean", f"{assessed['ap50']:.3f}")
    out_console.print(table)
    out_console.print(f"AP at 0.5 to 0.95: {assessed['ap']:.3f}; {assessed['ms']:.1f} ms an image")


@evaluate.command("segmenter")
def evaluate_segmenter(
    data: Data,
    weights: Weights,
    everything: Everything = False,
    seed: SplitSeed = None,
    json: Json = False,
) -> None:
    """Score a segmenter by its mean IoU on the validation images of a folder with images/, masks/ and classes.txt.

    Examples:

      dataflow evaluate segmenter DATA --weights out/segmenter.onnx
    """
    with friendly():
        from operators.segmentation.assessment import assess
        from operators.segmentation.dataset import read_segmentation_data
        from operators.weights import training_seed

        read = read_segmentation_data(data, training_seed(weights) if seed is None else seed)
        chosen = every_image(read.training, read.validation) if everything else read.validation
        print_notes(read.notes, json)
        assessed = assess(weights, read.classes, chosen)
    if json:
        typer.echo(jsonlib.dumps(assessed))
        return
    images = scored(assessed["images"], len(every_image(read.training, read.validation)), everything)
    out_console.print(f"{weights.name}: {images}", markup=False, soft_wrap=True)
    table = Table("class", "IoU")
    for name, value in assessed["per_class"].items():
        table.add_row(escape(name), f"{value:.3f}")
    table.add_section()
    table.add_row("mean", f"{assessed['miou']:.3f}")
    out_console.print(table)
    out_console.print(f"{assessed['ms']:.1f} ms an image")


def every_image(training: Sequence[Sample], validation: Sequence[Sample]) -> tuple[Sample, ...]:
    """All images of the data, each once."""
    return tuple(dict.fromkeys((*training, *validation)))


def scored(count: int, total: int, everything: bool) -> str:
    """Tells which of the `total` images are scored on."""
    return f"all {total} images" if everything else f"{count} validation images of {total}"
