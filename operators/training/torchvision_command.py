"""`dataflow train torchvision`: a network of torchvision's zoo learns one's own classes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from operators.training.console import Data, friendly, print_notes
from operators.training.options import ImageTraining, takes
from operators.training.running import input_size, report, tell_data

if TYPE_CHECKING:
    from operators.training.running import Read


@takes(ImageTraining, epochs=20)
def train_torchvision(
    name: Annotated[str, typer.Argument(help="A detector or segmenter of torchvision.", show_default=False)],
    data: Data,
    options: ImageTraining,
    out: Annotated[Path | None, typer.Option(help="The file to write (.pth). Default: NAME.pth.")] = None,
    weights: Annotated[
        str | None,
        typer.Option(help="Begin with torchvision's weights of this name (default, COCO_V1, ...) from its cache."),
    ] = None,
    initial: Annotated[
        Path | None, typer.Option("--from", help="Begin with the weights of this file (.pth, .pt) that fit.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of training images. Default: theirs, longest side 384.")
    ] = None,
) -> None:
    """Fine-tune a torchvision detector or segmenter on your own classes.

    A detector takes a folder in COCO or YOLO format, a segmenter one with images/, masks/ and classes.txt. The last
    layers are made for your classes; without --weights or --from all others begin at random too, which takes many
    epochs. Writes the best epoch's weights with the class names (.pth), which `TorchvisionDetector` and
    `TorchvisionSegmenter` take as `checkpoint`, and a checkpoint (.pt) to resume from.

    Examples:

      dataflow train torchvision ssdlite320_mobilenet_v3_large out/worlds --weights COCO_V1 --epochs 10
      dataflow train torchvision lraspp_mobilenet_v3_large out/worlds --out out/masks.pth --size 384x288 --json
    """
    with friendly():
        out = Path(f"{name}.pth") if out is None else out
        options.keep_earlier(out, ".pth")
        if weights is not None and initial is not None:
            raise ValueError("give either --weights or --from: both are what to begin with")
        from operators.torch_models import cached_weights, family_of
        from operators.training.torchvision_tasks import TorchvisionDetectorTask, TorchvisionSegmenterTask, weights_in

        detects = family_of(name) == "detection"
        task: TorchvisionDetectorTask | TorchvisionSegmenterTask
        if detects:
            from operators.detection.custom.folder import read_detection_data

            boxes = read_detection_data(data, options.seed)
            shown = _shown(boxes, [image.file for image in boxes.training], size, options)
            task = TorchvisionDetectorTask(boxes, name, shown, seed=options.seed, variation=options.changes)
        else:
            from operators.segmentation.dataset import read_segmentation_data

            masks = read_segmentation_data(data, options.seed)
            shown = _shown(masks, [image.image for image in masks.training], size, options)
            task = TorchvisionSegmenterTask(masks, name, shown, seed=options.seed, variation=options.changes)
        if weights is not None or initial is not None:
            state = cached_weights(name, weights) if weights is not None else weights_in(initial or out)
            taken, known = task.begin_with(state)
            print_notes([f"{taken} of {known} arrays begin as given, the others at random"], options.json)
        outcome = options.run(task, out)
    params = f"model: {name}, checkpoint: {{file}}" + ("" if detects else f", side: {min(task.size)}")
    operator = "operators.detection:TorchvisionDetector" if detects else "operators.segmentation:TorchvisionSegmenter"
    report(outcome, operator, options.json, params)


def _shown(read: Read, files: list[Path], size: str | None, options: ImageTraining) -> tuple[int, int]:
    """The size of training images, after what was read is reported."""
    shown = input_size(size, files[:20])
    tell_data(read, shown, options.json)
    return shown
