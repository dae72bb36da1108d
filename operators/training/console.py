"""Output, errors and options that the training commands share."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

FAILED, COULD_NOT_RUN = 1, 2
out_console, err_console = Console(), Console(stderr=True)


Data = Annotated[Path, typer.Argument(help="The data folder.", show_default=False)]
SplitSeed = Annotated[
    int | None,
    typer.Option(
        "--seed",
        min=0,
        help="Sets the validation images aside, where DATA names none. Default: the seed of the network's training.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")]
Weights = Annotated[Path, typer.Option("--weights", help="The network file (.onnx).", show_default=False)]


@contextlib.contextmanager
def friendly() -> Iterator[None]:
    """Turns errors into one line: exit code 2 for data, files and options that do not do, 1 for a failed training."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in _EXTRA:
            raise
        fail(f"training needs the package {error.name!r}: pip install 'robot-dataflow[train]'", COULD_NOT_RUN)
    except (ValueError, FileNotFoundError, FileExistsError) as error:
        fail(str(error), COULD_NOT_RUN)
    except FloatingPointError as error:
        fail(str(error))
    except KeyboardInterrupt:
        fail("interrupted; go on with --resume", 130)


_EXTRA: dict[str | None, Any] = dict.fromkeys(("torch", "onnx", "pycocotools"))


def fail(message: str, code: int = FAILED) -> None:
    err_console.print(f"[bold red]error:[/bold red] {escape(message)}", highlight=False, soft_wrap=True)
    raise typer.Exit(code)


def print_notes(notes: Sequence[str], quiet: bool) -> None:
    for note in () if quiet else notes:
        err_console.print(f"[yellow]note:[/yellow] {escape(note)}", highlight=False, soft_wrap=True)


def score_words(scores: Mapping[str, Any], names: Sequence[str]) -> str:
    return ", ".join(f"{name} {scores[name]:.3f}" for name in names if name in scores)
