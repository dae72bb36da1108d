"""The `dataflow` command. Commands import what they need when they run, so `--help` is quick."""

from __future__ import annotations

import inspect
import os
import sys
import traceback
from collections.abc import Callable
from typing import Annotated

import typer
from rich.markup import escape

from dataflow.cli import (
    completion,
    convert,
    demo,
    doctor,
    foxglove,
    inspection,
    latency,
    lint,
    live,
    logs,
    new,
    param,
    pub,
    recordings,
    replay,
    run,
    top,
    verification,
    viewing,
)
from dataflow.cli.arguments import FLAG
from dataflow.cli.output import COULD_NOT_RUN, TRACEBACK, err, fail, wants_traceback
from dataflow.cli.plugins import CommandGroup, renamed
from dataflow.cli.start import OutputFailed

app = typer.Typer(
    name="dataflow",
    cls=CommandGroup,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"], "token_normalize_func": renamed},
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
    if show_traceback:
        os.environ[TRACEBACK] = "1"


_MAKE, _LOOK, _FOLLOW = "Run, replay, verify", "Look at graphs, operators and recordings", "Follow a running graph"
_MATERIAL = "Work with recordings and bags"


def _paragraphs(text: str) -> str:
    """A docstring with the lines of each paragraph joined, so that it wraps where the terminal ends; lists stay."""
    blocks = inspect.cleandoc(text).split("\n\n")
    return "\n\n".join(block if block.startswith(" ") else " ".join(block.split("\n")) for block in blocks)


def _add(
    function: Callable[..., None], panel: str | None, name: str | None = None, to: typer.Typer = app, **settings: bool
) -> None:
    text = _paragraphs(function.__doc__ or "")
    to.command(name, rich_help_panel=panel, help=text, context_settings=dict(settings))(function)


_add(demo.demo, _MAKE)
_add(run.run, _MAKE)
_add(replay.replay, _MAKE)
_add(verification.verify, _MAKE)
_add(inspection.check, _LOOK)
_add(inspection.show, _LOOK)
_add(doctor.doctor, _LOOK)
_add(completion.completion, _LOOK)
_add(inspection.operators, _LOOK)
_add(demo.graphs, _LOOK)
_add(recordings.info, _LOOK)
_add(recordings.diff, _LOOK)
_add(convert.convert, _MATERIAL)
_add(latency.latency, _LOOK)
_add(lint.lint, _LOOK)
_add(viewing.view, _LOOK)
_add(foxglove.foxglove, _LOOK)
_add(live.list_running, _FOLLOW, "list")
_add(live.echo, _FOLLOW)
_add(live.hz, _FOLLOW)
_add(top.top, _FOLLOW)
_add(logs.logs, _FOLLOW)
beginnings = typer.Typer(no_args_is_help=True, help="Begin an operator, a graph or a project, with tests that pass.")
_add(new.operator, None, to=beginnings)
_add(new.graph, None, to=beginnings)
_add(new.project, None, to=beginnings)
app.add_typer(beginnings, name="new", rich_help_panel=_MAKE)
_add(pub.pub, _FOLLOW)
parameters = typer.Typer(no_args_is_help=True, help="Read and change the parameters of a running graph.")
_add(param.set_, None, "set", parameters, ignore_unknown_options=True)  # so that -1 is a value
_add(param.get, None, to=parameters)
_add(param.list_, None, "list", parameters)
_add(param.dump, None, to=parameters)
_add(param.load, None, to=parameters)
app.add_typer(parameters, name="param", rich_help_panel=_FOLLOW)


def main() -> None:
    """Calls the command that the arguments name."""
    completion.prepare()
    try:
        app()
    except OutputFailed:
        raise
    except Exception as error:  # a fault of ours, or of a plug-in
        if wants_traceback():
            err.print(escape(traceback.format_exc().rstrip()), soft_wrap=True)
            fail(f"internal error: {type(error).__name__}: {error}")
        else:
            fail(f"internal error: {type(error).__name__}: {error} (where: run it again with {TRACEBACK}=1)")
        sys.exit(COULD_NOT_RUN)


if __name__ == "__main__":
    from dataflow.cli.start import main as start

    if not sys.flags.safe_path:
        del sys.path[0]  # the current folder: what lies there must not replace installed modules
    start()
