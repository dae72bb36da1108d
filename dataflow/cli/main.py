"""The `dataflow` command. Commands import what they need when they run, so `--help` is quick."""

from __future__ import annotations

import os
import sys

import typer

from dataflow.cli import execution, inspection, live, recordings

app = typer.Typer(
    name="dataflow",
    help="Robot perception as a dataflow graph: run it live, record it, replay it bit for bit, see it.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)

app.command()(execution.run)
app.command()(execution.replay)
app.command()(inspection.check)
app.command()(inspection.show)
app.command()(inspection.operators)
app.command()(recordings.info)
app.command()(recordings.diff)
app.command()(live.view)
app.command("list")(live.list_running)
app.command()(live.echo)
app.command()(live.hz)


def main() -> None:
    """The console script. Operators may lie in the folder it is called from."""
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    sys.exit(app())


if __name__ == "__main__":
    main()
