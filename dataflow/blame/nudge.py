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


def nudged(message: M, only: Collection[str] = ()) -> tuple[M, tuple[str, ...]]:
    """Returns the message with its numbers nudged, each by a different part of `SIZE`, and the names of the fields.

    Texts stay, and so do fields that the type does not take otherwise. `only`: no others. The same message is nudged
    in the same way. Directions (rows whose norm the type checks) keep their norm.
    """
    random = np.random.default_rng(int.from_bytes(message.digest()[:8], "little"))
    names: list[str] = []
    for name, value in [(field.name, getattr(message, field.name)) for field in type(message).FIELDS]:
        for other in _others(value, random):
            if only and name not in only:
                continue
            try:
                message = message.replace(**{name: other})
            except MessageError:
                continue
            names.append(name)
            break
    return message, tuple(names)


def _others(value: Any, random: np.random.Generator) -> list[Any]:
    if value is None or isinstance(value, str | bytes):
        return []
    array = np.asarray(value)
    if not array.size or array.dtype.kind not in "biuf":
        return []
    moved = _moved(array, random)
    if not isinstance(value, np.ndarray):
        return [type(value)(moved.item())]
    tries = [moved]
    if array.ndim and array.dtype.kind == "f":
        wide = array.astype(np.float64)
        with np.errstate(all="ignore"):
            norm = np.linalg.norm(wide, axis=-1, keepdims=True) / np.linalg.norm(moved, axis=-1, keepdims=True)
        tries.append((moved * norm).astype(array.dtype))
    return tries


def _moved(array: npt.NDArray[Any], random: np.random.Generator) -> npt.NDArray[Any]:
    if array.dtype.kind == "b":
        return ~array
    part = random.uniform(0.5, 1.0, array.shape) * random.choice([-1.0, 1.0], array.shape)
    wide = array.astype(np.float64)
    largest = np.abs(wide[np.isfinite(wide)]).max(initial=0.0) or 1.0
    if array.dtype.kind == "f":
        return np.asarray(wide + part * SIZE * largest, array.dtype)
    step = np.sign(part) * np.ceil(np.abs(part) * SIZE * largest)
    limits = np.iinfo(array.dtype)
    outside = (wide + step < limits.min) | (wide + step > limits.max)
    return np.asarray(array + np.where(outside, -step, step).astype(np.int64).astype(array.dtype), array.dtype)
