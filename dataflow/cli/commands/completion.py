"""Completion of commands, options and names by the shell, and `dataflow completion`, which sets it up."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from rich.text import Text

from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import fail, out

VARIABLE = "_DATAFLOW_COMPLETE"
"""Environment variable by which a shell asks this program what could come next."""
SHELLS = ("bash", "zsh", "fish", "powershell")


def prepare() -> None:
    """Lets the program answer a shell that asks; costs nothing where none does."""
    if VARIABLE in os.environ:
        _typer().completion_init()


def _typer() -> Any:
    """Typer's module of that name, which does not say which of its names others may use."""
    return importlib.import_module("typer.completion")


def completion(
    shell: Annotated[str | None, argument("SHELL", "bash, zsh, fish or powershell. Default: that of SHELL.")] = None,
    install: Annotated[bool, option("--install", "Set it up for this user instead of printing it.")] = False,
) -> None:
    """Print the script by which a shell completes commands, options, graphs and the names of what runs.

    Examples:

      dataflow completion --install
      dataflow completion bash > ~/.dataflow-completion.bash
      dataflow completion fish > ~/.config/fish/completions/dataflow.fish
    """
    shell = shell or Path(os.environ.get("SHELL", "")).name
    if shell not in SHELLS:
        raise fail(f"shell {shell or 'unknown'!r}: expected one of {', '.join(SHELLS)}")
    if not install:
        print(_typer().get_completion_script(prog_name="dataflow", complete_var=VARIABLE, shell=shell))
        return
    try:
        _, path = _typer().install(shell=shell, prog_name="dataflow", complete_var=VARIABLE)
    except OSError as error:
        raise fail(f"{error.filename}: {error.strerror}") from None
    out.print(Text(f"{shell} completes dataflow from its next start on ({path})"), soft_wrap=True)


def running_graphs(incomplete: str) -> Iterator[str]:
    """The names of the graphs that run."""
    from dataflow.transport.registry import RegistryError, running

    with contextlib.suppress(RegistryError):
        yield from (found.name for found in running() if found.name.startswith(incomplete))


def running_streams(incomplete: str) -> Iterator[str]:
    """The streams of the graphs that run, without their namespaces."""
    yield from (name for name in _named("streams") if name.startswith(incomplete))


def running_operators(incomplete: str) -> Iterator[str]:
    """The operators of the graphs that run."""
    yield from (name for name in _named("nodes") if name.startswith(incomplete))


def _named(what: str) -> Iterator[str]:
    from dataflow.transport.registry import RegistryError, running

    with contextlib.suppress(RegistryError):
        for found in running():
            for each in found.graph.get(what, ()):
                yield str(each["name"]).removeprefix(f"{found.namespace}/")
