"""Finds what a call sees besides its arguments: what it closes over, its defaults, the object that it is bound to."""

from __future__ import annotations

import re
import sys
import sysconfig
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from dataflow.messages.base import Message
from dataflow.operator import Operator

DEPTH = 2
"""Objects within objects that are looked into."""
MOST = 256
"""Values that are looked at."""
LARGE = 1 << 16
"""Bytes of an array, or elements of a collection, from which it is passed over in an object: data, no setting of it."""
_CREDENTIAL = re.compile(r"(?:^|_)(?:key|token|secret|password|credentials?)$|^auth")
_LIBRARIES = ("/site-packages/", "/dist-packages/", *{sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib")})
_SINGLE = (str, bytes, bool, int, float, complex, type(None), np.generic, np.ndarray, Message)
_SEVERAL = (tuple, list, set, frozenset, Mapping)


def surroundings(call: Callable[..., Any]) -> dict[str, Any]:
    """Returns values by place, such as `closure.prompt`, `default.prompt`, `self.prompt`: those that may have a digest.
    Not: attributes that are named as credentials, objects of libraries, module variables, the code itself."""
    found: dict[str, Any] = {}
    bound = getattr(call, "__self__", None)
    if bound is not None and not isinstance(bound, ModuleType):
        _look(bound, "self", found, DEPTH)
    function = getattr(call, "__func__", call)
    if isinstance(function, FunctionType):
        _look_into_function(function, "", found, DEPTH)
    return found


def texts_around(call: Callable[..., Any]) -> set[str]:
    """Returns the places of those that are texts, or hold nothing but texts: what they may pass to a service."""
    return {place for place, value in surroundings(call).items() if _is_text(value) and value}


def _look(value: Any, place: str, found: dict[str, Any], depth: int) -> None:
    if len(found) >= MOST or _CREDENTIAL.search(place.rpartition(".")[2]):
        return
    if isinstance(value, _SINGLE) or (isinstance(value, _SEVERAL) and type(value).__module__ == "builtins"):
        if not (place.startswith("self.") and _is_large(value)):
            found[place] = value
    elif isinstance(value, FunctionType):
        found[place] = f"{value.__module__}:{value.__qualname__}"
        _look_into_function(value, f"{place}.", found, depth - 1)
    elif isinstance(value, partial):
        _look(value.func, f"{place}.func", found, depth)
        _look([*value.args, value.keywords], f"{place}.args", found, depth)
    elif depth > 0:
        for name, held in _attributes(value):
            _look(held, f"{place}.{name}", found, depth - 1)


def _look_into_function(function: FunctionType, place: str, found: dict[str, Any], depth: int) -> None:
    if depth < 0:
        return
    code, names = function.__code__, function.__code__.co_varnames[: function.__code__.co_argcount]
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        try:
            _look(cell.cell_contents, f"{place}closure.{name}", found, depth)
        except ValueError:  # not assigned yet
            continue
    given: Sequence[Any] = function.__defaults__ or ()
    defaults = {**dict(zip(names[len(names) - len(given) :], given, strict=True)), **(function.__kwdefaults__ or {})}
    for name, value in defaults.items():
        _look(value, f"{place}default.{name}", found, depth)


def _attributes(thing: Any) -> Iterator[tuple[str, Any]]:
    """Yields the attributes of an object of own code, and the constants of its class."""
    cls = thing if isinstance(thing, type) else type(thing)
    constants: dict[str, Any] = {}
    for kind in reversed(cls.__mro__):
        if _is_own(kind):
            constants |= vars(kind)
    held: Mapping[str, Any] = {}
    if (_is_own(cls) or cls is SimpleNamespace) and thing is not cls:
        slots = (name for kind in cls.__mro__ for name in vars(kind).get("__slots__", ()))
        held = {name: getattr(thing, name, None) for name in slots} | getattr(thing, "__dict__", {})
        held = _of_operator(thing, held) if issubclass(cls, Operator) else held
    for name, value in {**constants, **held}.items():
        if not name.startswith("__") and not _belongs_to_class(value):
            yield name, value


def _of_operator(operator: Operator, held: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the attributes of an operator that are parameters, texts, or objects: others may be measured. Its state
    is recorded, and the rest is the engine's."""
    settings = dict(operator.params)
    engine = {"params", "files", "state"} | {name for name in held if name.startswith("_Operator__")}
    return {
        name: value
        for name, value in held.items()
        if name not in engine and (name in settings or _is_text(value) or not isinstance(value, (*_SINGLE, *_SEVERAL)))
    }


def _is_text(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(_is_text(part) for pair in value.items() for part in pair)
    if is_dataclass(value) and not isinstance(value, type):
        return all(_is_text(getattr(value, each.name)) for each in fields(value))
    return isinstance(value, str | bool) or (isinstance(value, list | tuple) and all(map(_is_text, value)))


def _belongs_to_class(value: Any) -> bool:
    return isinstance(value, FunctionType | classmethod | staticmethod | property) or hasattr(value, "__set_name__")


def _is_own(cls: type) -> bool:
    file = getattr(sys.modules.get(cls.__module__), "__file__", None) or ""
    engine = cls.__module__.partition(".")[0] == "dataflow"
    return bool(file) and not engine and not any(folder in file for folder in _LIBRARIES)


def _is_large(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.nbytes >= LARGE
    return isinstance(value, (str, bytes, *_SEVERAL)) and len(value) >= LARGE
