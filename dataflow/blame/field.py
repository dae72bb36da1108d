"""A field of a recorded message at a time, its value, and whether two values differ."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from dataflow.execution.snapshots import pack_state
from dataflow.messages.base import Message
from dataflow.state import StateError, plain

_FORM = re.compile(r"(?P<stream>[^.\[@]+)(?P<path>[.\[].*)?@(?P<seconds>[0-9.]+)", re.DOTALL)
_ROW_FIRST = re.compile(r"(\[[^\]]*\])(\.\w+)")


@dataclass(frozen=True, slots=True)
class Field:
    """A field of the message of a stream at a time: `tracks[3].ids@12.4`. Raises ValueError for another text.

    `path`: a Python expression behind the message, "" for all of it; a row may stand in front of the field it is of,
    and brackets see the message's other fields (`tracks.boxes[ids == 7]@12.4`). `seconds`: from the recording's first
    message.
    """

    stream: str
    path: str
    seconds: float

    @staticmethod
    def parse(text: str) -> Field:
        """Reads STREAM.FIELD@SECONDS."""
        found = _FORM.fullmatch(text.strip())
        if found is None:
            raise ValueError(f"{text!r}: expected STREAM.FIELD@SECONDS, such as tracks.ids[3]@12.4")
        path = found["path"] or ""
        if row := _ROW_FIRST.match(path):
            path = row[2] + row[1] + path[row.end() :]
        try:
            compile(f"_{path}", "<field>", "eval")
            return Field(found["stream"], path, float(found["seconds"]))
        except (SyntaxError, ValueError) as error:
            raise ValueError(f"{text!r}: {error}") from None

    def value(self, message: Message | None) -> Any:
        """Returns the value in a message; None where there is no message, or no such place in it."""
        if message is None or not self.path:
            return message
        try:
            found = eval(f"_message{self.path}", {**dict(message.items()), "np": np, "_message": message})
        except Exception:  # the expression is the user's: whatever it raises, there is no such value
            return None
        return found


def differ(before: Any, after: Any, tolerance: float) -> bool:
    """Returns whether two values differ: floating-point numbers by more than `tolerance` times the largest of them
    before, others at all."""
    if before is None or after is None:
        return before is not after
    if isinstance(before, Message) or isinstance(after, Message):
        return not (isinstance(before, Message) and before == after)
    a, b = np.asarray(before), np.asarray(after)
    if a.dtype == object or b.dtype == object:
        return _packed(before) != _packed(after)
    if a.shape != b.shape or a.dtype.kind != b.dtype.kind:
        return True
    if a.dtype.kind not in "fc":
        return not np.array_equal(a, b)
    finite = np.isfinite(a)
    if not np.array_equal(finite, np.isfinite(b)):
        return True
    size = np.abs(a[finite]).max(initial=0.0)
    return bool(np.abs(a[finite] - b[finite]).max(initial=0.0) > tolerance * size)


def is_measured(value: Any) -> bool:
    """Returns whether a value consists of floating-point numbers."""
    return not isinstance(value, Message) and np.asarray(value).dtype.kind in "fc"


def change(before: Any, after: Any) -> float:
    """Returns by how much a value is another: of numbers the largest difference, of anything else infinity."""
    a, b = np.asarray(before), np.asarray(after)
    if a.shape != b.shape or not a.size or a.dtype.kind not in "biufc" or b.dtype.kind not in "biufc":
        return float("inf")
    kind = np.complex128 if "c" in (a.dtype.kind, b.dtype.kind) else np.float64
    with np.errstate(invalid="ignore"):
        most = float(np.abs(a.astype(kind) - b.astype(kind)).max())
    return float("inf") if np.isnan(most) else most


def _packed(value: Any) -> bytes:
    try:
        return pack_state({"": plain(value)})
    except StateError:
        return repr(value).encode()
