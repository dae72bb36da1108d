"""Declares options and arguments of commands, for `Annotated`."""

from __future__ import annotations

from typing import Any

import typer

FLAG = " "
"""The metavar of an option without a value: nothing is shown."""


def option(words: str, help: str, panel: str | None = None, **more: Any) -> Any:
    """An option by the words that the help shows: "--out -o FILE", or "--quiet -q" without a value."""
    names = [word for word in words.split() if word.startswith("-")]
    metavar = words.split()[len(names) :] or [FLAG]
    return typer.Option(*names, metavar=metavar[0], help=help, rich_help_panel=panel, **more)


def argument(metavar: str, help: str, **more: Any) -> Any:
    """An argument, by the name that the help shows."""
    return typer.Argument(metavar=metavar, help=help, **more)
