"""Commands that other packages supply, through the entry-point group `dataflow.commands`.

The entry point's name is the command; its value is a `typer.Typer` or a function that could be given to
`Typer.command`. Nothing of a plug-in is imported before its command, or the help of all commands, is asked for; one
that does not load is listed with its error.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

from dataflow.cli.registry import Commands, paragraphs
from dataflow.cli.support.options import FLAG
from dataflow.cli.support.output import COULD_NOT_RUN, TRACEBACK, err, fail, say, wants_traceback
from dataflow.cli.support.values import take_plainly
from dataflow.extras import missing_extra

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "dataflow.commands"
PANEL = "Commands of other packages"
BROKEN_PANEL = "Commands that do not load"
NAMES = {int: "N", float: "X", str: "TEXT", Path: "PATH"}
"""The name of a value in the help, by its type."""


@cache
def advertised() -> Mapping[str, EntryPoint]:
    """The commands that installed packages supply, by name, in alphabetical order."""
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in sorted(entry_points(group=GROUP), key=lambda e: (e.name, e.value))}


class CommandGroup(TyperGroup):
    """The built-in commands, then those of other packages; a built-in command cannot be replaced."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = Commands()
        self._added: set[str] = set()

    def list_commands(self, ctx: Any) -> list[str]:
        present = list(self.commands)
        return [*present, *(name for name in advertised() if name not in present)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        present = super().get_command(ctx, cmd_name)
        if present is None and cmd_name in advertised():
            self._added.add(cmd_name)
            self.add_command(load(advertised()[cmd_name]), cmd_name)
            present = super().get_command(ctx, cmd_name)
        if present is not None:
            tidy(present, ctx)
        return present

    def get_params(self, ctx: Any) -> list[Any]:
        for param in (params := super().get_params(ctx)):
            take_plainly(param)
        return params

    def format_help(self, ctx: Any, formatter: Any) -> None:
        tidy(self, ctx)
        super().format_help(ctx, formatter)
        for name in advertised():
            if name in self.commands and name not in self._added:
                value = escape(advertised()[name].value)
                say(f"[yellow]{value} supplies a command {name!r}, which is built in; it is left out[/]")

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and self.get_command(ctx, args[0]) is None:
            for name in advertised():  # so that they are suggested too
                self.get_command(ctx, name)
        found, command, rest = super().resolve_command(ctx, args)
        return found, command, _without_traceback(rest)


def _without_traceback(words: list[str]) -> list[str]:
    """The words of a command without `--traceback`, which may stand behind it too, where one types it."""
    end = words.index("--") if "--" in words else len(words)
    if "--traceback" in words[:end]:
        os.environ[TRACEBACK] = "1"
    return [*(word for word in words[:end] if word != "--traceback"), *words[end:]]


def tidy(command: Any, ctx: Any) -> None:
    """Makes the help of a command and its subcommands alike.

    Examples keep their line breaks, values have a name in capitals and not a type, flags have neither, and there
    are no options to install completion.
    """
    if command.help:
        command.help = paragraphs(command.help)
    command.params = [p for p in command.params if p.name not in ("install_completion", "show_completion")]
    own = type(ctx)(command, help_option_names=ctx.help_option_names)
    helping = command.get_help_option(own)
    take_plainly(helping)
    for param in (*command.params, helping):
        if param.metavar is None:
            param.metavar = _metavar(param)
    for inner in getattr(command, "commands", {}).values():
        if inner is not command:
            tidy(inner, ctx)


def _metavar(param: Any) -> str | None:
    """The name of a parameter's value in the help, where its declaration has none."""
    if getattr(param, "is_bool_flag", False):
        return FLAG
    if param.param_type_name == "argument":
        return str(param.name).upper()
    declared = getattr(param, "type_descriptor", None)  # an older Typer has none
    return None if declared is None else NAMES.get(declared.annotation)


def load(entry: EntryPoint) -> Any:
    """Returns the command of an entry point; for one that does not load, a command that prints why."""
    try:
        return _command(entry)
    except Exception as error:  # a plug-in may fail in any way when it is imported
        return _broken(entry, error)


def _command(entry: EntryPoint) -> Any:
    value = entry.load()
    if isinstance(value, typer.Typer):
        app = value
        app.info.name = entry.name
    elif callable(value):
        app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        app.command(entry.name)(value)
    else:
        raise TypeError(f"{entry.value} is {type(value).__name__}; expected a typer.Typer or a function")
    command = typer.main.get_command(app)
    command.name = entry.name
    if not getattr(command, "rich_help_panel", None):  # of a single command a placeholder that is no name
        command.rich_help_panel = PANEL  # type: ignore[attr-defined]
    return command


def _broken(entry: EntryPoint, error: Exception) -> Any:
    package = f" of package {entry.dist.name}" if entry.dist is not None else ""
    reason = f"{entry.value}{package}: {type(error).__name__}: {error}"
    reason = "; ".join(filter(None, (reason, missing_extra(error))))
    app = typer.Typer(add_completion=False)
    trace = "".join(traceback.format_exception(error)).rstrip()

    @app.command(
        entry.name,
        help=escape(f"Does not load: {reason}"),
        rich_help_panel=BROKEN_PANEL,
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )
    def command() -> None:
        if wants_traceback():
            err.print(escape(trace), style="dim", soft_wrap=True)
        raise fail(f"command {entry.name!r} does not load: {reason}", code=COULD_NOT_RUN)

    return typer.main.get_command(app)
