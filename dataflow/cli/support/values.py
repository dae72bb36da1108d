"""Reads the words of a command line where their meaning is plain.

Typer has pydantic check every value, and to import pydantic takes as long as all else that a command line needs.
"""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

WHOLE = re.compile(r"-?[0-9]{1,15}")
DECIMAL = re.compile(r"-?[0-9]{1,15}(\.[0-9]{1,15})?")


def take_plainly(param: Any) -> None:
    """Has a parameter of ours take plain values as they are; what needs a check is left to Typer."""
    declared = getattr(param, "type_descriptor", None)  # an older Typer has none, and does not import pydantic
    if declared is None or declared.parameter_info.parser is not None:
        return
    (kind,) = get_args(declared.annotation) if _takes_many(param) else (declared.annotation,)
    param.process_value = partial(_processed, param, kind)


def _takes_many(param: Any) -> bool:
    return bool(param.multiple or param.nargs == -1)


def _processed(param: Any, kind: Any, context: Any, given: Any) -> Any:
    """The value as the command takes it."""
    try:
        value = _meaning(given, kind, param)
    except _NotPlain:
        return type(param).process_value(param, context, given)
    return value if param.callback is None else param.callback(context, param, value)


class _NotPlain(Exception):
    """A value that has to be checked."""


def _meaning(given: Any, kind: Any, param: Any) -> Any:
    many = _takes_many(param)
    if given is None and not param.required:
        return () if many else None
    if given is not None and given is param.default:
        return given
    words = given if many else (given,)
    if not words or not all(isinstance(word, str) and _plain(word, kind) for word in words):
        raise _NotPlain
    read = [word if get_origin(kind) is Literal else kind(word) for word in words]
    return read if many else read[0]


def _plain(word: str, kind: Any) -> bool:
    """Returns whether the word means a value of that type beyond doubt."""
    if get_origin(kind) is Literal:
        return word in get_args(kind)
    if kind is Path:
        return os.access(word, os.R_OK) or not os.path.exists(word)
    if kind is int or kind is float:
        return (WHOLE if kind is int else DECIMAL).fullmatch(word) is not None
    return kind is str
