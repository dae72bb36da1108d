"""Compares two recordings stream by stream: which messages are missing, and where the first difference lies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from dataflow.messages.base import Message
from dataflow.messages.declaration import Declaration
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.entries import Recorded
from dataflow.recording.streams.reader import Recording

M = TypeVar("M")
_LAST = (2**63, 0)
"""Behind every message."""

Outcome = Literal["same", "within tolerance", "different", "only in A", "only in B"]


@dataclass(frozen=True, slots=True)
class FieldDifference:
    """One field that differs in the messages of one stamp.

    `detail`: text for people; `max_difference` is the largest absolute difference where both sides are numbers of
    one shape (infinite where one is NaN or infinite and the other is not the same), else None. In arrays of one shape
    `index` is the first element that differs, `count` how many of `size` do. `a` and `b` are the two values there, as
    JSON values: text where JSON has no word for them.
    """

    stamp: int
    field: str
    detail: str
    max_difference: float | None
    index: tuple[int, ...] | None = None
    count: int = 1
    size: int = 1
    a: str | int | float | bool | None = None
    b: str | int | float | bool | None = None

    def as_json(self) -> dict[str, Any]:
        """JSON values; an infinite difference is the string "Infinity"."""
        value = asdict(self)
        value["max_difference"] = _plain(self.max_difference)
        value["index"] = None if self.index is None else list(self.index)
        return value


@dataclass(slots=True)
class StreamDiff:
    """Comparison of one stream. `missing_in_a`, `missing_in_b`: messages without a partner of equal stamp, in files of
    other programs also for the other one cannot be read: those are counted in `unread_in_a`, `unread_in_b`.

    `differing` counts the pairs that differ beyond the tolerance, `first` is the first difference of the first of them,
    or the first message without a partner where that comes earlier (field `(message)`). `max_difference` is over all
    numeric fields of all pairs.
    """

    stream: str
    outcome: Outcome
    count_a: int
    count_b: int
    missing_in_a: int = 0
    missing_in_b: int = 0
    unread_in_a: int = 0
    unread_in_b: int = 0
    differing: int = 0
    max_difference: float = 0.0
    first: FieldDifference | None = None


@dataclass(slots=True)
class DiffReport:
    """The result of `diff`. `same`: no stream differs (beyond the tolerance, where one was given)."""

    a: str
    b: str
    tolerance: float | None
    streams: list[StreamDiff] = field(default_factory=list)

    @property
    def same(self) -> bool:
        return all(s.outcome in ("same", "within tolerance") for s in self.streams)

    def as_json(self) -> dict[str, Any]:
        """The report as JSON values; an infinite difference is the string "Infinity"."""
        streams = [
            asdict(s)
            | {"max_difference": _plain(s.max_difference), "first": None if s.first is None else s.first.as_json()}
            for s in self.streams
        ]
        return {"same": self.same, "a": self.a, "b": self.b, "tolerance": self.tolerance, "streams": streams}


def diff(
    a: Recording, b: Recording, *, streams: Sequence[str] | None = None, tolerance: float | None = None
) -> DiffReport:
    """Compares the decoded messages of two recordings; `streams` limits it to those named, else the runtime's own
    streams (logs, diagnostics: facts of one run) are left out.

    Without `tolerance` messages are the same when their digests are. With it, numbers may differ by at most that much,
    absolutely, element by element, and NaN equals NaN; integers, strings and shapes must still be equal. Messages are
    paired by incarnation and stamp. Streams whose messages are not known here are compared by their bytes.

    Raises `RecordingError` for a named stream that neither recording holds, and for messages that do not decode.
    """
    if tolerance is not None and not 0 <= tolerance < np.inf:
        raise RecordingError(f"tolerance must be a finite number ≥ 0, got {tolerance}")
    if streams is None:
        names = sorted(name for name in {*a.streams, *b.streams} if "/@/" not in f"/{name}")
    else:
        names = list(dict.fromkeys(streams))
    report = DiffReport(str(a.path), str(b.path), tolerance)
    for name in names:
        in_a, in_b = a.streams.get(name), b.streams.get(name)
        if in_a is None and in_b is None:
            raise RecordingError(f"neither {a.path} nor {b.path} holds a stream {name!r}")
        if in_a is None or in_b is None:
            count_a, count_b = (in_a.count if in_a else 0), (in_b.count if in_b else 0)
            report.streams.append(StreamDiff(name, "only in B" if in_a is None else "only in A", count_a, count_b))
            continue
        result = StreamDiff(name, "same", in_a.count, in_b.count)
        if in_a.message_type is not None and in_b.message_type is not None:
            _compare_messages(result, a, b, tolerance)
        else:
            _compare_bytes(result, a, b)
        _count_unread(result, a, b)
        if result.first is not None:
            result.outcome = "different"
        elif result.max_difference > 0:
            result.outcome = "within tolerance"
        report.streams.append(result)
    return report


def _compare_messages(result: StreamDiff, a: Recording, b: Recording, tolerance: float | None) -> None:
    for in_a, in_b in _paired(a.messages([result.stream]), b.messages([result.stream]), _by_stamp):
        if in_a is None or in_b is None:
            there = in_a or in_b
            assert there is not None
            _count_missing(
                result, in_a is None, FieldDifference(there.stamp, "(message)", f"message {there.seq}", None)
            )
        elif in_a.message.digest() != in_b.message.digest():
            found, largest = differences(in_a.message, in_b.message, tolerance)
            result.max_difference = max(result.max_difference, largest)
            if found:
                result.differing += 1
                result.first = result.first or found[0]


def _paired(
    a: Iterator[M], b: Iterator[M], order: Callable[[M], tuple[int, int]]
) -> Iterator[tuple[M | None, M | None]]:
    """Messages of equal order side by side; None stands for the one that is missing."""
    in_a, in_b = next(a, None), next(b, None)
    while in_a is not None or in_b is not None:
        key_a, key_b = (_LAST if m is None else order(m) for m in (in_a, in_b))
        takes_a, takes_b = key_a <= key_b, key_b <= key_a
        yield (in_a if takes_a else None), (in_b if takes_b else None)
        in_a = next(a, None) if takes_a else in_a
        in_b = next(b, None) if takes_b else in_b


def _by_stamp(recorded: Recorded) -> tuple[int, int]:
    return recorded.incarnation, recorded.stamp


def _count_unread(result: StreamDiff, a: Recording, b: Recording) -> None:
    """What cannot be read cannot be the same."""
    in_a, in_b = a.unread.get(result.stream), b.unread.get(result.stream)
    for side, unread in (("A", in_a), ("B", in_b)):
        if unread is not None:
            stamp = (a if side == "A" else b).streams[result.stream].first or 0
            result.first = result.first or FieldDifference(stamp, "(message)", f"{side}: {unread}", None)
    result.unread_in_a, result.unread_in_b = (0 if unread is None else unread.count for unread in (in_a, in_b))


def _count_missing(result: StreamDiff, lacks_a: bool, present: FieldDifference) -> None:
    result.missing_in_a += lacks_a
    result.missing_in_b += not lacks_a
    result.first = result.first or replace(present, detail=f"{present.detail} is only in {'B' if lacks_a else 'A'}")


def differences(a: Message, b: Message, tolerance: float | None = None) -> tuple[list[FieldDifference], float]:
    """The fields that differ beyond the tolerance, the stamp among them, and the largest difference of any field.

    Without `tolerance`, fields differ when their bits do. With it, floating-point numbers may differ by at most that
    much, absolutely, and NaN equals NaN; everything else must be equal.
    """
    if type(a) is not type(b):
        kinds = Declaration.of(type(a)), Declaration.of(type(b))
        forms = kinds[0].differences(kinds[1], "A", "B") if a.SCHEMA == b.SCHEMA else ()
        text = f"two declarations of {a.SCHEMA}: {'; '.join(forms)}" if forms else f"{a.SCHEMA} against {b.SCHEMA}"
        if forms or a.SCHEMA != b.SCHEMA:
            return [FieldDifference(a.stamp, "(message)", text, None, a=a.SCHEMA, b=b.SCHEMA)], 0
    found: list[FieldDifference] = []
    largest = 0.0
    for (name, left), (_, right) in zip(a.items(), b.items(), strict=True):
        distance = _distance(left, right)
        largest = max(largest, distance or 0.0)
        if tolerance is not None and distance is not None and _is_float(left):
            equal = distance <= tolerance
        else:
            equal = _bits(left) == _bits(right)
        if not equal:
            found.append(_field_difference(a.stamp, name, left, right, distance, tolerance))
    return found, largest


def _distance(left: Any, right: Any) -> float | None:
    """The largest absolute difference of two numbers or arrays of numbers of one shape; NaN is at 0 from NaN."""
    if isinstance(left, (str, tuple, bool)) or isinstance(right, (str, tuple, bool)) or left is None or right is None:
        return None
    x, y = np.asarray(left), np.asarray(right)
    if x.shape != y.shape or x.dtype.kind == "b":
        return None
    if not x.size:
        return 0.0
    if x.dtype.kind in "iu" and y.dtype.kind in "iu":
        return float((np.maximum(x, y).astype(np.uint64) - np.minimum(x, y).astype(np.uint64)).max())  # modulo 2^64
    x, y = x.astype(np.float64), y.astype(np.float64)
    same = (x == y) | (np.isnan(x) & np.isnan(y))
    with np.errstate(invalid="ignore", over="ignore"):
        gap = np.abs(x - y)
    return float(np.where(same, 0.0, np.where(np.isfinite(gap), gap, np.inf)).max())


def _is_float(value: Any) -> bool:
    return isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f")


def _bits(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return (type(value), np.float64(value).tobytes()) if isinstance(value, float) else (type(value), value)


def _field_difference(
    stamp: int, name: str, left: Any, right: Any, distance: float | None, tolerance: float | None
) -> FieldDifference:
    if not (isinstance(left, np.ndarray) and isinstance(right, np.ndarray)):
        detail = f"{_short(left)} against {_short(right)}"
        return FieldDifference(stamp, name, detail, distance, a=_plain(left), b=_plain(right))
    if left.shape != right.shape or left.dtype != right.dtype:
        detail = f"{left.dtype}{list(left.shape)} against {right.dtype}{list(right.shape)}"
        return FieldDifference(stamp, name, detail, distance, a=_plain(left), b=_plain(right))
    flat = np.flatnonzero(_unequal(left, right, tolerance))
    index = tuple(int(i) for i in np.unravel_index(int(flat[0]), left.shape))
    where = ", ".join(map(str, index))
    detail = f"[{where}] is {left[index]!s} against {right[index]!s}, {len(flat)} of {left.size} differ"
    a, b = _plain(left[index]), _plain(right[index])
    return FieldDifference(stamp, name, detail, distance, index, len(flat), left.size, a, b)


def _unequal(left: npt.NDArray[Any], right: npt.NDArray[Any], tolerance: float | None) -> npt.NDArray[np.bool_]:
    """Returns which elements of two arrays of one shape and type differ, flat: beyond the tolerance, or in any bit."""
    if tolerance is not None and left.dtype.kind == "f":
        x, y = left.reshape(-1).astype(np.float64), right.reshape(-1).astype(np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            near = np.abs(x - y) <= tolerance
        alike: npt.NDArray[np.bool_] = near | (x == y) | (np.isnan(x) & np.isnan(y))
        return ~alike
    bytes_of_left, bytes_of_right = (
        array.reshape(-1).view(np.uint8).reshape(array.size, -1) for array in (left, right)
    )
    return np.asarray((bytes_of_left != bytes_of_right).any(axis=1))


def _plain(value: Any) -> str | int | float | bool | None:
    """A JSON value; text for arrays, lists and numbers that JSON has no word for."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return "NaN" if np.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, str) and len(value) <= 60:
        return value
    return value if value is None or isinstance(value, (bool, int, float)) else _short(value)


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _compare_bytes(result: StreamDiff, a: Recording, b: Recording) -> None:
    """Streams without a message type: the records of equal log time side by side."""
    pairs = _paired(a.raw([result.stream]), b.raw([result.stream]), lambda record: (record.log_time, 0))
    for number, (in_a, in_b) in enumerate(pairs):
        there = in_a or in_b
        assert there is not None
        if in_a is None or in_b is None:
            _count_missing(result, in_a is None, FieldDifference(there.log_time, "(bytes)", f"message {number}", None))
        elif in_a.data != in_b.data:
            result.differing += 1
            detail = f"message {number} has other bytes ({len(in_a.data)} against {len(in_b.data)})"
            result.first = result.first or FieldDifference(there.log_time, "(bytes)", detail, None)
