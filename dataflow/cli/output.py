"""How commands talk: tables for people on standard output, JSON for machines, errors with a distinct exit code."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape

DIFFERENT = 1
"""Exit code: it ran, and the answer is no (streams differ, the graph has faults, a run failed)."""
COULD_NOT_RUN = 2
"""Exit code: it could not run (a file is missing, an option is wrong)."""
INTERRUPTED = 130

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


def print_json(value: Any) -> None:
    """One JSON document on standard output."""
    print(json.dumps(value, indent=2, ensure_ascii=False, default=str))


def fail(message: str, *, details: str = "", code: int = COULD_NOT_RUN) -> typer.Exit:
    """Prints an error; the caller raises what it returns."""
    err.print(f"[bold red]error:[/] {escape(message)}")
    if details.strip():
        err.print(f"[dim]{escape(details.rstrip())}[/]", soft_wrap=True)
    return typer.Exit(code)


@contextmanager
def friendly_errors() -> Iterator[None]:
    """Turns the errors that bad input causes into one clear message and exit code 2 (1 for a graph with faults)."""
    from dataflow.graph import GraphError, OperatorImportError
    from dataflow.messages import MessageError
    from dataflow.operator import ParameterError
    from dataflow.recording import RecordingError
    from dataflow.runtime.replay import ReplayError
    from dataflow.runtime.supervisor import RunFailed

    try:
        yield
    except GraphError as error:
        err.print(escape(str(error)), soft_wrap=True)
        raise typer.Exit(DIFFERENT) from None
    except RunFailed as error:
        raise fail(str(error), details=error.details, code=DIFFERENT) from None
    except (RecordingError, ReplayError, ParameterError, MessageError, OperatorImportError) as error:
        raise fail(str(error)) from None
    except FileNotFoundError as error:
        raise fail(f"no such file: {error.filename}" if error.filename else str(error)) from None
    except (IsADirectoryError, PermissionError) as error:
        raise fail(f"{error.strerror}: {error.filename}") from None


def count(number: float) -> str:
    """1234567 → "1,234,567"."""
    return f"{number:,.0f}"


def size(nbytes: float) -> str:
    """Bytes for people: "3.2 MB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if abs(nbytes) < 1000 or unit == "GB":
            return f"{nbytes:.0f} {unit}" if unit == "B" else f"{nbytes:.1f} {unit}"
        nbytes /= 1000
    return ""


def figures(values: Mapping[str, Any]) -> str:
    """`{"ate_rmse_m": 0.0213, "poses": 250}` → "ate_rmse_m 0.0213 · poses 250"."""
    return " · ".join(f"{name} {f'{v:.4g}' if isinstance(v, float) else v}" for name, v in values.items())
