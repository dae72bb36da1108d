"""Shared steps of the training commands: input sizes, first weights, what was read, the report."""

from __future__ import annotations

import json as jsonlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.markup import escape

from operators.training.console import err_console, out_console, print_notes, score_words

if TYPE_CHECKING:
    from operators.detection.custom.dataset import DetectionData
    from operators.detection.custom.training import DetectorTask
    from operators.learning.loop import Outcome
    from operators.recognition.dataset import ClassificationData
    from operators.segmentation.dataset import SegmentationData
    from operators.segmentation.training import SegmenterTask
    from operators.training.pair import PairTask

    Read = DetectionData | SegmentationData | ClassificationData

_LONGEST_SIDE, _MULTIPLE = 384, 32


def prepare(
    task: DetectorTask | SegmenterTask | PairTask, weights: Path | None, frozen_stride: int | None, initial: Path | None
) -> None:
    """Gives a network its first weights and freezes the part of the backbone that came with them."""
    from operators.learning.backbone import start_from

    if initial is not None and initial.suffix == ".onnx":
        task.begin_with(initial)
    elif initial is not None:
        start_from(task.network, initial)
    given = weights is not None or initial is not None
    task.backbone.freeze(frozen_stride if frozen_stride is not None else 4 if given else 0)


def tell_data(read: Read, size: tuple[int, int], quiet: bool, classes: Sequence[str] | None = None) -> None:
    """Prints what was read, before the first epoch."""
    print_notes(read.notes, quiet)
    if quiet:
        return
    classes = read.classes if classes is None else classes
    named = ", ".join(classes[:12]) + (" ..." if len(classes) > 12 else "")
    counts = f"{len(read.training)} images to train on, {len(read.validation)} to score on"
    told = f"{counts}; {len(classes)} classes: {named}; input {size[0]}x{size[1]}"
    err_console.print(told, highlight=False, markup=False, soft_wrap=True)


def report(
    outcome: Outcome,
    operator: str,
    json: bool,
    params: str = "weights: {file}",
    seconds: Mapping[str, Outcome | None] | None = None,
) -> None:
    """Prints the score, the file and the operator that takes it, with these parameters; or one JSON object.

    `seconds` are the outcomes of second networks, by kind; None for one that was left away.
    """
    trained = {kind: second for kind, second in (seconds or {}).items() if second is not None}
    if json:
        told = {"weights": str(outcome.file), "checkpoint": str(outcome.checkpoint), **told_of(outcome)}
        typer.echo(jsonlib.dumps(told | {kind: told_of(second) for kind, second in trained.items()}))
        return
    tell_scores(outcome.file, outcome)
    for kind, second in trained.items():
        out_console.print(f"with its {kind}: {_scores(second)}", highlight=False, soft_wrap=True)
    given = params.format(file=escape(str(outcome.file)))
    out_console.print(f"use it: `use: {operator}` with `params: {{{given}}}`", highlight=False, soft_wrap=True)


def tell_scores(file: Path, outcome: Outcome) -> None:
    """Prints the file that was written, and how well its best epoch did."""
    told = f"[green]{escape(str(file))}[/green]: {_scores(outcome)} in epoch {outcome.best_epoch}"
    out_console.print(told, highlight=False, soft_wrap=True)


def told_of(outcome: Outcome) -> dict[str, object]:
    """The outcome of a training as plain values."""
    return {
        "scores": outcome.best,
        "epoch": outcome.best_epoch,
        "epochs": len(outcome.history),
        "seconds": round(outcome.seconds, 1),
        "history": outcome.history,
    }


def _scores(outcome: Outcome) -> str:
    return score_words(outcome.best, [name for name in outcome.best if name != "score"])


def input_size(text: str | None, files: Sequence[Path]) -> tuple[int, int]:
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
