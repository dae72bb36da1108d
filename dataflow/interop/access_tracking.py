"""Returns which fields of a message of another system a conversion has not looked at, and so has not carried over."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, fields
from typing import Any

import numpy as np

ELSEWHERE = frozenset({"stamp", "seq", "is_dense", "angle_max", "row_step", "structure_needs_at_least_one_member"})
"""Fields whose content follows from what is carried: times are the stamp's, `seq` is of ROS 1's transport."""


class TrackedMessage:
    """A message of ROS whose fields are read as usual, and which keeps account of what was read.

    Messages that it holds are of this class too. `losses`: what a conversion has said with `lose`.
    """

    __slots__ = ("_children", "_read", "_value", "losses")

    def __init__(self, value: Any, losses: list[str] | None = None) -> None:
        self._value, self._read = value, set[str]()
        self._children: dict[str, Any] = {}
        self.losses: list[str] = [] if losses is None else losses

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._value, name)
        self._read.add(name)
        if name not in self._children:
            self._children[name] = _wrapped(value, self.losses)
        return self._children[name]

    def unread(self) -> tuple[str, ...]:
        """Names of the fields that hold something and were not read, such as `results[].id`, and what was lost."""
        root = getattr(getattr(self._value, "header", None), "frame_id", None)
        return tuple(dict.fromkeys([*self._unread("", root), *self.losses]))

    def _unread(self, where: str, frame: str | None) -> Iterator[str]:
        for name in _names(self._value):
            place = f"{where}.{name}" if where else name
            value = getattr(self._value, name)
            if name not in self._read:
                if _holds_something(value) and not (name == "frame_id" and value == frame):
                    yield from _named(value, place, frame)
                continue
            child = self._children[name]
            if isinstance(child, TrackedMessage):
                yield from child._unread(place, frame)
            elif isinstance(child, list):
                for one in child:
                    if isinstance(one, TrackedMessage):
                        yield from one._unread(f"{place}[]", frame)


def lose(message: Any, what: str) -> None:
    """Notes that a conversion keeps less than a message holds, if the message is a `TrackedMessage`."""
    if isinstance(message, TrackedMessage):
        message.losses.append(what)


def _names(value: Any) -> list[str]:
    """The fields of a message that count; its constants, which have a default, do not."""
    return [each.name for each in fields(value) if each.default is MISSING and each.name not in ELSEWHERE]


def _wrapped(value: Any, losses: list[str]) -> Any:
    if isinstance(value, list):
        return [_wrapped(one, losses) for one in value]
    return TrackedMessage(value, losses) if hasattr(value, "__dataclass_fields__") else value


def _named(value: Any, place: str, frame: str | None) -> Iterator[str]:
    """The fields of a message that hold something; the field itself where it is a value."""
    if hasattr(value, "__dataclass_fields__"):
        yield from TrackedMessage(value)._unread(place, frame)
    else:
        yield place


def _holds_something(value: Any) -> bool:
    if hasattr(value, "__dataclass_fields__"):
        return any(_holds_something(getattr(value, name)) for name in _names(value))
    if isinstance(value, np.ndarray):
        return bool(value.size) and bool(np.asarray(value != 0).any())
    return bool(value)
