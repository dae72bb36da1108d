"""Messages with fields that are a little different."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from dataflow.messages.base import Message, MessageError

SIZE = 0.01
"""A nudge, as a part of the largest number of a field; of whole numbers 1 at least."""


M = TypeVar("M", bound=Message)


def nudged(message: M, only: Collection[str] = (), *, sign: int = 1) -> tuple[M, tuple[str, ...]]:
    """Returns the message with its numbers nudged, each by a different part of `SIZE`, and the names of the fields.

    Texts stay, and so do fields that the type does not take otherwise, and numbers that are not finite. `only`: no
    others. The same message is nudged in the same way; with `sign` -1 each number moves the other way. Directions (rows
    whose norm the type checks) keep their norm.
    """
    random = np.random.default_rng(int.from_bytes(message.digest()[:8], "little"))
    names: list[str] = []
    for name, value in [(field.name, getattr(message, field.name)) for field in type(message).FIELDS]:
        for other in _others(value, random, sign):
            if only and name not in only:
                continue
            try:
                message = message.replace(**{name: other})
            except MessageError:
                continue
            names.append(name)
            break
    return message, tuple(names)


def groups(message: Message, before: Message | None) -> list[tuple[str, ...]]:
    """Returns the names of the fields with numbers in the order in which they are nudged: what is measured, then single
    whole numbers beside it, of which those that are as in the message before (the size of an image) are none."""
    _, names = nudged(message)
    whole = tuple(name for name in names if type(getattr(message, name)) is int)
    measured = tuple(name for name in names if name not in whole)
    if measured:
        whole = tuple(n for n in whole if getattr(before, n, None) not in (None, getattr(message, n)))
    return [group for group in (measured, whole) if group]


def is_finite(message: Message) -> bool:
    """Returns whether all numbers of a message are finite."""
    arrays = [np.asarray(getattr(message, field.name)) for field in type(message).FIELDS]
    return all(array.dtype.kind != "f" or bool(np.isfinite(array).all()) for array in arrays)


def made_finite(message: M, beside: Message | None) -> M:
    """Returns the message with a finite neighbour in place of each number that is not finite: from the same array, or,
    where that has none, from the same place of the message `beside`. Returns the same message where there is none."""
    for name, value in [(field.name, getattr(message, field.name)) for field in type(message).FIELDS]:
        if value is None or isinstance(value, str | bytes):
            continue
        array = np.asarray(value)
        if array.dtype.kind != "f" or np.isfinite(array).all():
            continue
        near = np.asarray(getattr(beside, name, None)) if type(beside) is type(message) else array
        filled = _filled(array, near)
        if not (np.isfinite(filled) > np.isfinite(array)).any():
            continue
        try:
            message = message.replace(**{name: filled if isinstance(value, np.ndarray) else filled.item()})
        except MessageError:
            continue
    return message


def _filled(array: npt.NDArray[Any], near: npt.NDArray[Any]) -> npt.NDArray[Any]:
    flat = array.reshape(-1)
    places = np.flatnonzero(np.isfinite(flat))
    if len(places):
        after = np.searchsorted(places, np.arange(len(flat)), side="right")
        filled = flat[places[np.maximum(after - 1, 0)]].reshape(array.shape)
    elif near.shape == array.shape and near.dtype.kind == "f":
        filled = np.where(np.isfinite(near), near, array).astype(array.dtype)
    else:
        return array
    return np.where(np.isfinite(array), array, filled)


def _others(value: Any, random: np.random.Generator, sign: int) -> list[Any]:
    if value is None or isinstance(value, str | bytes):
        return []
    array = np.asarray(value)
    if not array.size or array.dtype.kind not in "biuf":
        return []
    moved = _moved(array, random, sign)
    if not isinstance(value, np.ndarray):
        return [type(value)(moved.item())]
    tries = [moved]
    if array.ndim and array.dtype.kind == "f":
        wide = array.astype(np.float64)
        with np.errstate(all="ignore"):
            norm = np.linalg.norm(wide, axis=-1, keepdims=True) / np.linalg.norm(moved, axis=-1, keepdims=True)
        tries.append((moved * norm).astype(array.dtype))
    return tries


def _moved(array: npt.NDArray[Any], random: np.random.Generator, sign: int) -> npt.NDArray[Any]:
    if array.dtype.kind == "b":
        return ~array
    part = sign * random.uniform(0.5, 1.0, array.shape) * random.choice([-1.0, 1.0], array.shape)
    wide = array.astype(np.float64)
    largest = np.abs(wide[np.isfinite(wide)]).max(initial=0.0) or 1.0
    if array.dtype.kind == "f":
        return np.asarray(wide + part * SIZE * largest, array.dtype)
    step = np.sign(part) * np.ceil(np.abs(part) * SIZE * largest)
    limits = np.iinfo(array.dtype)
    outside = (wide + step < limits.min) | (wide + step > limits.max)
    return np.asarray(array + np.where(outside, -step, step).astype(np.int64).astype(array.dtype), array.dtype)
