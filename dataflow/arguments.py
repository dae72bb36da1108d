"""Checks the arguments of public functions against their annotations, so that a wrong type is named at once."""

from __future__ import annotations

import functools
import inspect
import os
import reprlib
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

_WORDS: Mapping[Any, str] = {
    str: "a text",
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    Path: "a path",
    type(None): "None",
}
_PLAIN = (str, bytes, bool, int, float, list, tuple, dict, set, type(None))
"""Types whose values are shown as they are; of others the type is named."""


class Fault(NamedTuple):
    """A value of a wrong type: the place where it stands, the value, and the type that is wanted there."""

    place: str
    value: Any
    wanted: Any


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Makes a function raise `TypeError` for an argument that is not of its annotated type, before anything is done.

    The error names the function, the argument, what is expected and what was given. numpy's numbers and any
    `os.PathLike` count as numbers and paths; a single text is no sequence of texts, and True is no number. Annotations
    are read when the function is first called.
    """
    signature = inspect.signature(function)
    name = function.__qualname__.removesuffix(".__init__")

    @functools.cache
    def wanted() -> Mapping[str, Any]:
        given = {n: p.annotation for n, p in signature.parameters.items() if p.annotation is not p.empty}
        return evaluated(given, function.__globals__)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        require(name, _given(signature, wanted(), args, kwargs))
        return function(*args, **kwargs)

    return call


def evaluated(annotations: Mapping[str, Any], names: dict[str, Any]) -> Mapping[str, Any]:
    """The types that annotations mean, which may be texts; `names`: those of the module that they stand in."""
    return typing.get_type_hints(SimpleNamespace(__annotations__=dict(annotations)), names)


def require(function: str, given: Iterable[tuple[str, Any, Any]]) -> None:
    """Raises `TypeError` for the first of the arguments, (name, value, type), that is not of its type."""
    for place, value, hint in given:
        if (fault := find_fault(value, hint, place)) is not None:
            raise TypeError(
                f"{function}(): {fault.place}: expected {describe(fault.wanted)}, got {_shown(fault.value)}"
            )


def _given(
    signature: inspect.Signature, hints: Mapping[str, Any], args: Sequence[Any], kwargs: Mapping[str, Any]
) -> Iterable[tuple[str, Any, Any]]:
    """Yields (name, value, annotation) of each argument; those that are gathered by `*` and `**` one by one."""
    try:
        bound = signature.bind(*args, **kwargs)
    except TypeError:
        return  # the call names the argument that is missing or unknown
    for name, value in bound.arguments.items():
        if name not in hints:
            continue
        kind = signature.parameters[name].kind
        if kind is inspect.Parameter.VAR_POSITIONAL:
            yield from ((f"{name}[{i}]", each, hints[name]) for i, each in enumerate(value))
        elif kind is inspect.Parameter.VAR_KEYWORD:
            yield from ((key, each, hints[name]) for key, each in value.items())
        else:
            yield name, value, hints[name]


def find_fault(value: Any, hint: Any, place: str) -> Fault | None:
    """Returns where `value` is not what `hint` wants; None where it is. What cannot be decided counts as right."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        faults = [find_fault(value, each, place) for each in inner]
        if None in faults:
            return None
        deep = [f for f in faults if f is not None and f.place != place]
        return deep[0] if deep else Fault(place, value, hint)
    if origin is Literal:
        return None if any(value is each or value == each for each in inner) else Fault(place, value, hint)
    if origin is type:
        fits = isinstance(value, type) and (inner[0] is Any or issubclass(value, inner[0]))
        return None if fits else Fault(place, value, hint)
    if origin is not None:
        return _fault_in(value, hint, origin, inner, place)
    if hint is Any or not isinstance(hint, type):
        return None  # type variables are taken as they are, too
    return None if _is(value, hint) else Fault(place, value, hint)


def _fault_in(value: Any, hint: Any, origin: Any, inner: Sequence[Any], place: str) -> Fault | None:
    """The fault of a container, or the first of what it holds."""
    if not isinstance(value, origin) or isinstance(value, str | bytes):
        return Fault(place, value, hint)
    parts: Iterable[tuple[str, Any, Any]] = ()
    if isinstance(value, Mapping) and len(inner) == 2:
        parts = [(f"a key of {place}", key, inner[0]) for key in value]
        parts += [(f"{place}[{key!r}]", each, inner[1]) for key, each in value.items()]
    elif isinstance(value, list | tuple) and inner:
        parts = ((f"{place}[{i}]", each, inner[0]) for i, each in enumerate(value))
    return next((f for where, each, want in parts if (f := find_fault(each, want, where)) is not None), None)


def _is(value: Any, hint: type) -> bool:
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    if hint is int or hint is float:
        return isinstance(value, Integral if hint is int else Real) and not isinstance(value, bool)
    if hint is Path:
        return isinstance(value, os.PathLike)
    return isinstance(value, hint)


def describe(hint: Any) -> str:
    """The type as a reader of an error message takes it: `a text or a sequence of texts`."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        words = list(dict.fromkeys(describe(each) for each in inner))
        return f"{', '.join(words[:-1])} or {words[-1]}"
    if origin is Literal:
        return f"{', '.join(repr(each) for each in inner[:-1])} or {inner[-1]!r}" if inner[1:] else repr(inner[0])
    if origin is type:
        return f"a class derived from {inner[0].__name__}"
    if origin is not None and issubclass(origin, Mapping):
        return "a dictionary" + (f" from {_many(inner[0])} to {_many(inner[1])}" if len(inner) == 2 else "")
    if origin in (Sequence, Iterable, list, tuple):
        return f"a {'list' if origin in (list, Iterable) else 'sequence'} of {_many(inner[0])}"
    if origin is Callable:
        return "a function"
    if hint in _WORDS:
        return _WORDS[hint]
    name = getattr(hint, "__name__", str(hint))
    return f"an {name}" if name[0] in "AEIOU" else f"a {name}"


def _many(hint: Any) -> str:
    if hint is Any:
        return "values"
    words = describe(hint)
    article, _, noun = words.partition(" ")
    return f"{noun}s" if article in ("a", "an") and " " not in noun else f"{words} each"


def _shown(value: Any) -> str:
    kind = type(value)
    if value is None:
        return "None"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return f"{reprlib.repr(value)} ({kind.__name__})" if kind in _PLAIN else describe(kind)
