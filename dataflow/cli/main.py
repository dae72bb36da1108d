"""The `dataflow` command. Commands import what they need when they run, so `--help` is quick."""

from __future__ import annotations

import os
import sys
import traceback
from typing import Annotated

import typer
from rich.markup import escape

from dataflow.cli import execution, inspection, live, recordings, viewing
from dataflow.cli.arguments import FLAG
from dataflow.cli.output import COULD_NOT_RUN, TRACEBACK, err, fail, wants_traceback
from dataflow.cli.plugins import CommandGroup

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
        bool,
        typer.Option(
            "--version", metavar=FLAG, is_eager=True, callback=_print_version, help="Print the version and exit."
        ),
    ] = False,
    show_traceback: Annotated[
        bool,
        typer.Option(
            "--traceback", metavar=FLAG, help="Show where an error comes from. Environment: DATAFLOW_TRACEBACK=1."
        ),
    ] = False,
) -> None:
    """Robot perception as a dataflow graph: run it live, record it, replay it bit for bit, see it.

    Results go to standard output, progress and errors to standard error.

    Exit codes:

      0    it worked, and where a question was asked the answer is yes
      1    it ran, and failed or answers no: a failed run, different recordings, a faulty graph
      2    it could not run: a wrong option, a missing file, a graph with faults
      130  interrupted with Ctrl-C

    Examples:

      dataflow run graphs/synthetic_rgbd.yaml --record run.mcap
      dataflow replay run.mcap --record again.mcap
      dataflow diff run.mcap again.mcap
      dataflow view run.mcap
      dataflow run --help
    """
    if show_traceback:
        os.environ[TRACEBACK] = "1"


_MAKE, _LOOK, _FOLLOW = "Run and replay", "Look at graphs, operators and recordings", "Follow a running graph"

app.command(rich_help_panel=_MAKE)(execution.run)
app.command(rich_help_panel=_MAKE)(execution.replay)
app.command(rich_help_panel=_LOOK)(inspection.check)
app.command(rich_help_panel=_LOOK)(inspection.show)
app.command(rich_help_panel=_LOOK)(inspection.operators)
app.command(rich_help_panel=_LOOK)(recordings.info)
app.command(rich_help_panel=_LOOK)(recordings.diff)
app.command(rich_help_panel=_LOOK)(viewing.view)
app.command("list", rich_help_panel=_FOLLOW)(live.list_running)
app.command(rich_help_panel=_FOLLOW)(live.echo)
app.command(rich_help_panel=_FOLLOW)(live.hz)


def main() -> None:
    """The console script. Operators may lie in the folder it is called from."""
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        app()
    except Exception as error:  # a fault of ours, or of a plug-in
        if wants_traceback():
            err.print(escape(traceback.format_exc().rstrip()), soft_wrap=True)
            fail(f"internal error: {type(error).__name__}: {error}")
        else:
            fail(f"internal error: {type(error).__name__}: {error} (where: run it again with {TRACEBACK}=1)")
        sys.exit(COULD_NOT_RUN)


if __name__ == "__main__":
    main()
