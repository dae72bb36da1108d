"""`dataflow evaluate`. Heavy packages are imported when a command runs, so `--help` is quick."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from operators.training.console import Data, Json, SplitSeed, Weights, friendly, out_console, print_notes
from operators.training.graph_evaluation import evaluate_graph

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
    data: Data, weights: Weights, everything: Everything = False, seed: SplitSeed = None, json: Json = False
) -> None:
    """Score a detector by COCO's rules on the validation images of a folder in COCO or YOLO format.

    Examples:

      dataflow evaluate detector DATA --weights out/mine.onnx
      dataflow evaluate detector DATA --weights out/mine.onnx --all --json
    """
    with friendly():
        from operators.detection.assessment import assess
        from operators.detection.custom.folder import read_detection_data

        assessed = _assessed(read_detection_data, assess, data, weights, everything, seed, json)
    if not json:
        _print(weights, assessed, "AP50", "ap50", f"AP at 0.5 to 0.95: {assessed['ap']:.3f}; ")


@evaluate.command("segmenter")
def evaluate_segmenter(
    data: Data, weights: Weights, everything: Everything = False, seed: SplitSeed = None, json: Json = False
) -> None:
    """Score a segmenter by its mean IoU on the validation images of a folder with images/, masks/ and classes.txt.

    Examples:

      dataflow evaluate segmenter DATA --weights out/segmenter.onnx
    """
    with friendly():
        from operators.segmentation.assessment import assess
        from operators.segmentation.dataset import read_segmentation_data

        assessed = _assessed(read_segmentation_data, assess, data, weights, everything, seed, json)
    if not json:
        _print(weights, assessed, "IoU", "miou")


def _assessed(
    read: Callable[[Path, int], Any],
    assess: Callable[[Path, Sequence[str], Sequence[Any]], dict[str, Any]],
    data: Path,
    weights: Path,
    everything: bool,
    seed: int | None,
    json: bool,
) -> dict[str, Any]:
    """Scores a network file on data; prints the notes on these, or the scores as JSON."""
    from operators.weights import training_seed

    found = read(data, training_seed(weights) if seed is None else seed)
    images = tuple(dict.fromkeys((*found.training, *found.validation)))
    print_notes(found.notes, json)
    assessed = assess(weights, found.classes, images if everything else found.validation)
    if json:
        typer.echo(jsonlib.dumps(assessed))
    chosen = "all" if everything else f"{assessed['images']} validation images of"
    return {**assessed, "images": f"{chosen} {len(images)}{' images' if everything else ''}"}


def _print(weights: Path, assessed: Mapping[str, Any], column: str, mean: str, further: str = "") -> None:
    objects = f", {assessed['objects']} objects" if "objects" in assessed else ""
    out_console.print(f"{weights.name}: {assessed['images']}{objects}", markup=False, soft_wrap=True)
    table = Table("class", column)
    for name, value in assessed["per_class"].items():
        table.add_row(escape(name), f"{value:.3f}")
    table.add_section()
    table.add_row("mean", f"{assessed[mean]:.3f}")
    out_console.print(table)
    out_console.print(f"{further}{assessed['ms']:.1f} ms an image")
