"""The `dataflow` command. Commands import what they need when they run, so `--help` is quick."""

from __future__ import annotations

import sys

import typer

from dataflow.cli import execution, inspection

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


def main() -> None:
    """The console script."""
    sys.exit(app())


if __name__ == "__main__":
    main()
