"""`dataflow train trunk`: one trunk for two networks that were trained together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from operators.training.console import friendly, out_console

First = Annotated[Path, typer.Argument(help="A network file in 8 bits, which answers as before.", show_default=False)]
Second = Annotated[Path, typer.Argument(help="Another one, which takes over its trunk.", show_default=False)]


def train_trunk(
    first: First,
    second: Second,
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
