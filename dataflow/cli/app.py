"""The `dataflow` command. `registry.py` lists what it can do; each imports what it needs when it runs."""

from __future__ import annotations

import os
import sys
import traceback
from typing import Annotated

import typer
from rich.markup import escape

from dataflow.cli.commands import completion
from dataflow.cli.plugins import CommandGroup
from dataflow.cli.support.options import option
from dataflow.cli.support.output import (
    COULD_NOT_RUN,
    TRACEBACK,
    err,
    fail,
    forget_notes,
    interrupted_by_user,
    wants_traceback,
)
from dataflow.cli.support.standard_output import OutputFailed
from dataflow.extras import missing_extra

app = typer.Typer(
    name="dataflow",
    cls=CommandGroup,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"dataflow {version('robot-dataflow')}")
        raise typer.Exit


@app.callback()
def dataflow(
    version: Annotated[
        bool, option("--version", "Print the version and exit.", is_eager=True, callback=_print_version)
    ] = False,
    show_traceback: Annotated[
        bool,
        option(
            "--traceback", "Show where an error comes from; also behind the command. Environment: DATAFLOW_TRACEBACK=1."
        ),
    ] = False,
) -> None:
    """Deterministic record and replay for robot perception: run a graph live, record it, replay it bit for bit, see it.

    Results go to standard output, progress and errors to standard error.

    Exit codes:

      0    it worked, and where a question was asked the answer is yes
      1    it ran, and failed or the answer is no (different, faulty)
      2    it could not run: a wrong option, a missing file, a faulty graph
      130  interrupted with Ctrl-C

    Examples:

      dataflow run graphs/synthetic_rgbd.yaml --record run.mcap
      dataflow replay run.mcap --record again.mcap
      dataflow diff run.mcap again.mcap
      dataflow verify run.mcap
      dataflow view run.mcap
      dataflow run --help
    """
    forget_notes()
    if show_traceback:
        os.environ[TRACEBACK] = "1"


def call() -> None:
    """Calls the command that the arguments name."""
    completion.prepare()
    try:
        app()
    except OutputFailed:
        raise
    except Exception as error:  # a fault of ours, or of a plug-in
        if interrupted_by_user(error):
            raise KeyboardInterrupt from None
        if wants_traceback():
            err.print(escape(traceback.format_exc().rstrip()), soft_wrap=True)
            fail(f"internal error: {type(error).__name__}: {error}")
        elif hint := missing_extra(error):
            fail(f"{error}; {hint}")
        else:
            fail(f"internal error: {type(error).__name__}: {error} (where: run it again with {TRACEBACK}=1)")
        sys.exit(COULD_NOT_RUN)
