"""`dataflow train focus` and `train reclassifier`: small things, found and named in the image's own resolution."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from operators.training.console import Json, friendly
from operators.training.making import Chosen, Processes, Worlds, followed, tell
from operators.training.options import Device, Every, Overwrite, Rate, Resume, Seed, Threads, Workers
from operators.training.running import keep_earlier, report, run_task

if TYPE_CHECKING:
    from operators.detection.focus.views import Views

Folder = Annotated[Path, typer.Argument(help="Folder of views; those that it lacks are made.", show_default=False)]


def train_focus(
    data: Folder,
    worlds: Worlds = 180,
    validation: Chosen = 9,
    processes: Processes = 1,
    epochs: Annotated[int, typer.Option(min=1, help="Passes through the views.")] = 12,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("focus.onnx"),
    resume: Resume = False,
    overwrite: Overwrite = False,
    batch: Annotated[int, typer.Option(min=2, help="Views a step.")] = 32,
    learning_rate: Rate = 3e-3,
    seed: Seed = 0,
    evaluate_every: Every = 2,
    workers: Workers = 1,
    threads: Threads = None,
    device: Device = None,
    json: Json = False,
) -> None:
    """Train the focus network, which finds mugs, balls, bottles, boxes, books and plants in parts of an image.

    A view is a part of a camera's image, in its own resolution, around small things of a simulated world. The score is
    COCO's AP in views of other worlds. `operators.detection:FocusDetector` takes the file as `weights`.

    Examples:

      dataflow train focus out/views --processes 2
      dataflow train focus out/views --worlds 30 --epochs 4 --out out/focus.onnx
    """
    with friendly():
        keep_earlier(out, resume, overwrite)
        from operators.detection.focus.training import FocusTask
        from operators.training.loop import Settings

        training, choosing = _views(data, worlds, validation, processes, json)
        task = FocusTask(training, choosing, seed=seed)
        tell(f"{task.samples} views of {worlds} worlds to train on, {validation} worlds to choose by", json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device,
        )  # fmt: skip
        outcome = run_task(task, settings, out, resume, json)
    report(outcome, "operators.detection:FocusDetector", json)


def train_reclassifier(
    data: Folder,
    worlds: Worlds = 180,
    validation: Chosen = 9,
    processes: Processes = 1,
    epochs: Annotated[int, typer.Option(min=1, help="Passes through the things in the views.")] = 15,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("reclassifier.onnx"),
    resume: Resume = False,
    overwrite: Overwrite = False,
    batch: Annotated[int, typer.Option(min=2, help="Close-ups a step.")] = 128,
    learning_rate: Rate = 3e-3,
    seed: Seed = 0,
    evaluate_every: Every = 1,
    workers: Workers = 1,
    threads: Threads = None,
    device: Device = None,
    json: Json = False,
) -> None:
    """Train the reclassifier, which tells mugs, balls, bottles, boxes, books and plants apart by close-ups.

    The views are those of `dataflow train focus`. The score is the mean over classes of the share of things that are
    right, in views of other worlds. `operators.detection:Reclassifier` takes the file as `weights`.

    Examples:

      dataflow train reclassifier out/views --processes 2
      dataflow train reclassifier out/views --worlds 30 --epochs 4 --out out/reclassifier.onnx
    """
    with friendly():
        keep_earlier(out, resume, overwrite)
        from operators.detection.reclassify.training import ReclassifierTask
        from operators.training.loop import Settings

        training, choosing = _views(data, worlds, validation, processes, json)
        task = ReclassifierTask(training, choosing, seed=seed)
        tell(f"{task.samples} close-ups of {worlds} worlds to train on, {validation} worlds to choose by", json)
        settings = Settings(
            epochs, batch, learning_rate, seed=seed, evaluate_every=evaluate_every, workers=workers, threads=threads,
            device=device,
        )  # fmt: skip
        outcome = run_task(task, settings, out, resume, json)
    report(outcome, "operators.detection:Reclassifier", json)


def _views(folder: Path, training: int, validation: int, processes: int, quiet: bool) -> tuple[Views, Views]:
    """Makes the views that a folder lacks, and reads all."""
    from operators.simulator.worlds import INDOOR
    from operators.training import made_worlds
    from operators.training.simulated_views import TRAINING, VALIDATION, read_views, write_views

    parts = (made_worlds.worlds(TRAINING, training, INDOOR), made_worlds.worlds(VALIDATION, validation, INDOOR))
    followed(write_views(folder, [*parts[0], *parts[1]], processes), training + validation, quiet)
    return read_views(folder, parts[0]), read_views(folder, parts[1])
