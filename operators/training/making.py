"""Shared by the training commands that make their data from simulated worlds: options and progress."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import typer
from rich.progress import track

from operators.training.console import err_console

Worlds = Annotated[int, typer.Option(min=1, help="Worlds to train on.")]
Chosen = Annotated[int, typer.Option("--validation", min=1, help="Worlds by which the best epoch is chosen.")]
Processes = Annotated[int, typer.Option(min=1, help="Worlds made at once.")]


def followed(made: Iterator[int], total: int, quiet: bool) -> None:
    """Makes worlds, with a progress bar unless output is for programs."""
    for _ in made if quiet else track(made, total=total, description="worlds", console=err_console):
        pass


def tell(text: str, quiet: bool) -> None:
    """Says what is learned from, unless output is for programs."""
    if not quiet:
        err_console.print(text, highlight=False, markup=False, soft_wrap=True)
