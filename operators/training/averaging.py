"""The mean of two trainings of a detector and a segmenter: often better than either where one was fine-tuned from the
other on other data (Wortsman et al. 2022, "Model soups").

python -m operators.training.averaging DATA FIRST SECOND --out FOLDER [--size 384x288] [--share 0.5]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import nn

from operators.detection.custom.folder import read_detection_data
from operators.segmentation.dataset import read_segmentation_data
from operators.training.backbone import start_from
from operators.training.files import save_atomically
from operators.training.network_weights import sample_images
from operators.training.pair import PairTask
from operators.training.running import input_size

_AT_ONCE = 16


def average(task: PairTask, first: Path, second: Path, share: float = 0.5) -> None:
    """Gives the task's network the mean of two files' weights (.pt or .onnx), `share` of it from the second.

    The statistics of its normalisations are measured anew on training images. Both must have the same anchors, which
    are those of a network file. Raises `TrainingFileError` for a file that does not fit.
    """
    states = []
    for file in (first, second):
        if file.suffix == ".onnx":
            task.begin_with(file)
        else:
            start_from(task.network, file)
        states.append({name: value.clone() for name, value in task.network.state_dict().items()})
    mean = {
        name: value.lerp(states[1][name], share) if value.dtype.is_floating_point else states[1][name]
        for name, value in states[0].items()
    }
    task.network.load_state_dict(mean)
    _measure(task)


def _measure(task: PairTask) -> None:
    """Gives every normalisation the mean statistics of batches of training images."""
    norms = [module for module in task.network.modules() if isinstance(module, nn.BatchNorm2d)]
    momenta = [norm.momentum for norm in norms]
    task.network.eval()
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # the mean over all batches
        norm.train()
    with torch.inference_mode():
        for images in torch.split(sample_images(task), _AT_ONCE):
            task.network(images)
    task.network.eval()
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum


def main(arguments: Sequence[str] | None = None) -> None:
    """Averages two files, as told on the command line, and scores the result."""
    parser = argparse.ArgumentParser(
        prog="python -m operators.training.averaging",
        description="Write the mean of two trainings of `dataflow train pair`: detector.onnx, segmenter.onnx, pair.pt.",
    )
    parser.add_argument("data", type=Path, help="folder with boxes and masks")
    parser.add_argument("first", type=Path, help="detector.onnx with segmenter.onnx beside it, or a checkpoint (.pt)")
    parser.add_argument("second", type=Path, help="the same")
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    parser.add_argument("--size", default="384x288", help="the networks' input, WxH")
    parser.add_argument("--share", type=float, default=0.5, help="share of the second")
    options = parser.parse_args(arguments)
    boxes, masks = read_detection_data(options.data), read_segmentation_data(options.data)
    task = PairTask(boxes, masks, input_size(options.size, ()))
    average(task, options.first, options.second, options.share)
    scores = task.evaluate(task.network)
    options.out.mkdir(parents=True, exist_ok=True)
    facts = {"scores": scores, "share": options.share}
    task.export(task.network, facts, options.out / "pair.onnx")
    save_atomically({"kind": task.kind, "ema": task.network.state_dict()}, options.out / "pair.pt")
    print(", ".join(f"{name} {value:.3f}" for name, value in scores.items()))


if __name__ == "__main__":
    main()
