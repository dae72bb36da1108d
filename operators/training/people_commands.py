"""`dataflow train activity` and `train posture`: what people do, learned from simulated worlds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import track

from operators.training.console import err_console, friendly
from operators.training.options import Training, takes
from operators.training.running import report

Worlds = Annotated[int, typer.Option(min=1, help="Worlds to train on.")]
Chosen = Annotated[int, typer.Option("--validation", min=1, help="Worlds by which the best epoch is chosen.")]
Processes = Annotated[int, typer.Option(min=1, help="Worlds made at once.")]
Folder = Annotated[Path, typer.Argument(help="Folder of episodes; those that it lacks are made.", show_default=False)]
Silhouettes = Annotated[
    Path, typer.Argument(help="Folder of silhouettes; those that it lacks are made.", show_default=False)
]
Variations = Annotated[int, typer.Option(min=0, help="Times that a tracker's errors are drawn for each world.")]
Sensed = Annotated[
    Path | None,
    typer.Option(help="Folder of tracks as sensors gave them (*.npz); benchmarks/sensed_people.py makes them."),
]
SensedChosen = Annotated[Path | None, typer.Option(help="Folder of such tracks by which the best epoch is chosen too.")]
Repeats = Annotated[int, typer.Option(min=1, help="Times that each of the sensed tracks is taken.")]


@takes(Training, epochs=10, batch=32, learning_rate=3e-3, workers=1, threads=1, device="cpu")
def train_activity(
    data: Folder,
    options: Training,
    worlds: Worlds = 40,
    validation: Chosen = 12,
    processes: Processes = 1,
    variations: Variations = 4,
    sensed: Sensed = None,
    sensed_validation: SensedChosen = None,
    repeats: Repeats = 8,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("activity.onnx"),
) -> None:
    """Train the activity network, two LSTM layers, on people of simulated worlds.

    No image is rendered: true boxes go through a seeded model of a tracker in space. Tracks that came from sensors may
    be added. The score is the macro-F1 at 0.5 s tolerance, the mean of true, tracked and sensed boxes.
    `operators.recognition:ActivityRecognizer` takes the file as `weights`.

    Examples:

      dataflow train activity out/episodes
      dataflow train activity out/episodes --worlds 10 --epochs 3 --out out/activity.onnx
    """
    with friendly():
        options.keep_earlier(out)
        from operators.recognition.activity.sensed_people import read_tracks
        from operators.recognition.activity.training import ActivityTask
        from operators.training import made_worlds
        from operators.training.simulated_people import TRAINING, VALIDATION, read_episodes, write_episodes

        parts = made_worlds.worlds(TRAINING, worlds), made_worlds.worlds(VALIDATION, validation)
        _followed(write_episodes(data, [*parts[0], *parts[1]], processes), worlds + validation, options.json)
        tracks = [read_tracks(folder) if folder else [] for folder in (sensed, sensed_validation)]
        task = ActivityTask(
            *(read_episodes(data, part) for part in parts), sensed=tracks[0], sensed_validation=tracks[1],
            repeats=repeats, seed=options.seed, variations=variations,
        )  # fmt: skip
        _tell(f"{task.samples} tracks of {worlds} worlds to train on, {validation} worlds to choose by", options.json)
        outcome = options.run(task, out)
    report(outcome, "operators.recognition:ActivityRecognizer", options.json)


@takes(Training, epochs=10, batch=128, learning_rate=3e-3, workers=1)
def train_posture(
    data: Silhouettes,
    options: Training,
    worlds: Worlds = 160,
    validation: Chosen = 8,
    processes: Processes = 1,
    out: Annotated[Path, typer.Option(help="The network file to write.")] = Path("posture.onnx"),
) -> None:
    """Train the posture network on silhouettes of people in simulated worlds.

    A silhouette is what a depth sensor sees of a person from somewhere around it, with the errors of a sensor and of a
    segmenter. The score is the mean over activities of the share that is right, in other worlds.
    `operators.recognition:PostureRecognizer` takes the file as `weights`.

    Examples:

      dataflow train posture out/silhouettes --processes 2
      dataflow train posture out/silhouettes --worlds 20 --epochs 4 --out out/posture.onnx
    """
    with friendly():
        if options.batch < 2:
            raise ValueError("--batch: normalisation needs 2 silhouettes a step or more")
        options.keep_earlier(out)
        from operators.recognition.posture.training import PostureTask
        from operators.training import made_worlds
        from operators.training.simulated_postures import TRAINING, VALIDATION, read_postures, write_postures

        parts = made_worlds.worlds(TRAINING, worlds), made_worlds.worlds(VALIDATION, validation)
        _followed(write_postures(data, [*parts[0], *parts[1]], processes), worlds + validation, options.json)
        task = PostureTask(read_postures(data, parts[0]), read_postures(data, parts[1]), seed=options.seed)
        _tell(
            f"{task.samples} silhouettes of {worlds} worlds to train on, {validation} worlds to choose by", options.json
        )
        outcome = options.run(task, out)
    report(outcome, "operators.recognition:PostureRecognizer", options.json)


def _followed(made: Iterator[int], total: int, quiet: bool) -> None:
    """Makes worlds, with a progress bar unless output is for programs."""
    for _ in made if quiet else track(made, total=total, description="worlds", console=err_console):
        pass


def _tell(text: str, quiet: bool) -> None:
    """Prints what is learned from, unless output is for programs."""
    if not quiet:
        err_console.print(text, highlight=False, markup=False, soft_wrap=True)
