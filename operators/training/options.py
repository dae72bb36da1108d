"""Options that the training commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Epochs = Annotated[int, typer.Option(min=1, help="Passes through the training images.")]
Batch = Annotated[int, typer.Option(min=1, help="Images a step.")]
Rate = Annotated[float, typer.Option("--learning-rate", min=1e-7, help="Largest learning rate.")]
Seed = Annotated[int, typer.Option(min=0, help="Decides everything random.")]
Size = Annotated[
    str | None,
    typer.Option(metavar="WxH", help="Input size, multiples of 16. Default: by the images, longest side 384."),
]
Width = Annotated[float, typer.Option(min=0.1, max=2.0, help="Width of the backbone, as a factor on its channels.")]
Backbone = Annotated[
    Path | None,
    typer.Option(
        "--backbone-weights", help="Start from these: torchvision's MobileNetV2 weights, or a checkpoint (.pt)."
    ),
]
Frozen = Annotated[
    int | None,
    typer.Option(
        help="Keep the backbone down to this stride as it is. Default: 4 with given weights, else 0 for none."
    ),
]
Initial = Annotated[
    Path | None,
    typer.Option(
        "--from",
        help="Fine-tuning: start from all weights of this checkpoint (.pt) that fit, or from a network file (.onnx), "
        "in 8 bits too. For a pair it is detector.onnx, with segmenter.onnx beside it.",
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint beside --out.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the files of an earlier training.")]
Flip = Annotated[bool, typer.Option(help="Mirror images: not where left and right differ, as in text.")]
Strength = Annotated[
    float, typer.Option("--variation", min=0, max=2, help="Strength of the random changes of training images.")
]
Every = Annotated[int, typer.Option(min=1, help="Score after every so many epochs.")]
Workers = Annotated[int, typer.Option(min=1, help="Threads that prepare images.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Threads that compute. Default: one a core.")]
Device = Annotated[str | None, typer.Option(help="cpu, cuda, cuda:1 ... Default: a GPU where there is one.")]
Bfloat16 = Annotated[
    bool,
    typer.Option(help="Compute convolutions in bfloat16: twice as fast on processors that have it, slower on others."),
]
