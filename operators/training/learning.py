"""`dataflow learn`: new classes of objects from a few labelled images, usable at once."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from operators.training.console import Data, Json, friendly, out_console

if TYPE_CHECKING:
    from operators.detection.custom.dataset import DetectionData, LabelledImage

learn = typer.Typer(name="learn", no_args_is_help=True, rich_markup_mode="rich")


@learn.callback()
def _learn() -> None:
    """Learn new things from a few examples.

    Examples:

      dataflow learn object mug DATA
    """


@learn.command("object")
def learn_object(
    name: Annotated[str, typer.Argument(help="The class to learn, as the labels name it.", show_default=False)],
    data: Data,
    out: Annotated[Path | None, typer.Option(help="The file to write. Default: NAME.object.npz.")] = None,
    background: Annotated[
        Path | None, typer.Option(help="Folder of images without the object: what it is not to be taken for.")
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(help="Network file of `dataflow train detector`. Default: the shipped detector.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it is there.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Decides how boxes are varied.")] = 0,
    json: Json = False,
) -> None:
    """Learn a class of objects from about five labelled images (COCO or YOLO format), in seconds.

    The file holds a prototype in the feature space of the detector's network.
    `operators.recognition:LearnedDetector` takes it in `objects` and finds known and learned classes.

    Examples:

      dataflow learn object mug DATA
      dataflow learn object mug DATA --background FOLDER --out out/mug.object.npz
    """
    out = Path(f"{name}.object.npz") if out is None else out
    with friendly():
        if out.exists() and not overwrite:
            raise FileExistsError(f"{out} exists already: give --overwrite or another --out")
        import hashlib

        import numpy as np

        from operators.detection.custom.folder import read_detection_data
        from operators.recognition.objects.learned_object import learn as fitted
        from operators.recognition.objects.learned_object import shown_in
        from operators.recognition.objects.proposals import COLOR, Trunk, inner_maps
        from operators.weights import shipped

        detector = shipped("detector.onnx") if weights is None else weights
        images = _images(read_detection_data(data, seed).only([name]), background)
        inner = (*inner_maps(detector), COLOR)
        trunk = Trunk(detector, inner)
        shown = []
        for k, image in enumerate(images):
            pixels = image.read()
            extent = np.array([pixels.shape[1], pixels.shape[0]] * 2, np.float32)
            shown.append(
                shown_in(trunk, pixels, image.boxes[~image.ignored] * extent, np.random.default_rng((seed, k)))
            )
        learned = fitted(name, shown, hashlib.sha256(detector.read_bytes()).hexdigest(), inner)
        learned.write(out)
    if json:
        typer.echo(jsonlib.dumps({"object": name, "file": str(out), "images": learned.images}))
        return
    counted = f"{escape(name)} from {learned.images} images of {len(images)}"
    used = escape(f"`use: operators.recognition:LearnedDetector` with `params: {{objects: [{out}]}}`")
    for line in (f"[green]{escape(str(out))}[/green]: {counted}", f"use it: {used}"):
        out_console.print(line, highlight=False, soft_wrap=True)


def _images(read: DetectionData, background: Path | None) -> list[LabelledImage]:
    """Returns the images of a class, each once, and those of a folder without it."""
    import numpy as np

    from operators.detection.custom.dataset import IMAGE_SUFFIXES, LabelledImage

    images = list({image.file: image for image in (*read.training, *read.validation)}.values())
    if background is None:
        return images
    files = sorted(f for f in background.rglob("*") if f.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise FileNotFoundError(f"{background} holds no image ({', '.join(sorted(IMAGE_SUFFIXES))})")
    nothing = np.zeros((0, 4), np.float32), np.zeros(0, np.int32), np.zeros(0, np.bool_)
    return images + [LabelledImage(file, *nothing) for file in files]
