"""Firing records: what every operator did, complete enough to drive it again and to compare what it made.

A record is one call of an operator: its stamp, the exact messages given to each input, what came out of each port and
how it ended. Records are gathered in batches of one operator and written to its stream
`<namespace>/@/firings/<operator>`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import msgpack

from dataflow.sync import Drop, FiringInputs, InputRef, MessageRef, RunRef

FORMAT = 1
MAX_STATE_BYTES = 2**29 - 2**16
"""Of a state in a record: with the record it fits into a chunk (`dataflow.recording.limits`). A larger one is left out,
and the run goes on."""
Kind = Literal["setup", "fire", "tick", "finish", "param", "reset", "restore", "snapshot", "cut"]
Outcome = Literal["ok", "error"]
KINDS: tuple[Kind, ...] = ("setup", "fire", "tick", "finish", "param", "reset", "restore", "snapshot", "cut")
OUTCOMES: tuple[Outcome, ...] = ("ok", "error")
CALLS: tuple[Kind, ...] = ("fire", "tick", "finish")
"""The kinds that stand for a call with messages."""

_KIND_NUMBER = {kind: number for number, kind in enumerate(KINDS)}
_NO_NAMES: frozenset[str] = frozenset()
_NO_DETAIL: Mapping[str, Any] = {}

WITHHELD = -1
"""The place in its stream of a message that was not sent, since its stamp did not increase (live runs only)."""


class FiringRecordError(ValueError):
    """Raised when a batch of firing records cannot be written or read; the message names the reason."""


@dataclass(slots=True)
class Emission:
    """Output of one port: its place in the stream (or `WITHHELD`), its stamp and its digest (16 bytes)."""

    seq: int
    stamp: int
    digest: bytes


@dataclass(slots=True)
class FiringRecord:
    """One call of an operator. A record is never changed; the class is not frozen since that would make a record cost
    four times as much, and one is made for every firing.

    `index` counts the calls of one incarnation without gaps. `inputs` holds, by input name, the messages that were
    given, by reference; `outputs` what came out, in the order of the operator's declared outputs. `drops` are those
    decided since the previous record. `detail` holds what is particular to the kind: parameters and file hashes for
    `setup`, the name and value for `param`, the input for `reset`, the state for `snapshot` (of one that is too large
    to be recorded its bytes, as `left_out`), what stands in for the records that were left out for `cut`
    (`dataflow.records.cuts`), what the operator sums up for `finish`, the error's text for the outcome `error` (with
    `injected` where no call was made at all), what the operator called outside and was answered as `effects`
    (`dataflow.execution.effects.journal`), and for `fire` and `finish` of a source how many steps it has not sent
    since the record before, by reason.
    `wall_start` (ns since the epoch) and `duration` (ns) are facts of that run and never compared.
    """

    operator: str
    incarnation: int
    index: int
    kind: Kind
    stamp: int
    tick: bool = False
    inputs: Mapping[str, InputRef] = field(default_factory=dict)
    stale: frozenset[str] = frozenset()
    late: frozenset[str] = frozenset()
    outputs: tuple[Emission | None, ...] = ()
    outcome: Outcome = "ok"
    drops: tuple[Drop, ...] = ()
    detail: Mapping[str, Any] = field(default_factory=dict)
    wall_start: int = 0
    duration: int = 0

    def firing(self) -> FiringInputs:
        """Returns what an aligner that is driven by records needs. Only for the kinds fire, tick and finish."""
        kind = self.kind
        if kind not in ("fire", "tick", "finish"):
            raise FiringRecordError(f"{self.operator}: record {self.index} is a {kind!r}, which no message made")
        return FiringInputs(self.stamp, kind, self.tick, self.inputs, self.stale, self.late)


def encode_batch(records: list[FiringRecord], *, last: bool = False) -> bytes:
    """A batch of consecutive records of one operator as msgpack. `last` marks the operator's final batch."""
    if not records:
        raise FiringRecordError("a batch holds at least one firing record")
    begin = records[0]
    operator, incarnation, index = begin.operator, begin.incarnation, begin.index
    if any(
        r.index != index + k or r.incarnation != incarnation or r.operator != operator for k, r in enumerate(records)
    ):
        raise FiringRecordError("a batch holds consecutive records of one incarnation of one operator")
    names = list(dict.fromkeys(name for record in records for name in record.inputs))
    streams: dict[str, int] = {}

    def stream_index(name: str) -> int:
        return streams.setdefault(name, len(streams))

    rows = [
        (
            _KIND_NUMBER[r.kind],
            r.stamp,
            r.tick,
            [_encode_ref(r.inputs.get(name), stream_index) for name in names] if r.inputs else (),
            sorted(r.stale) if r.stale else (),
            sorted(r.late) if r.late else (),
            [None if e is None else (e.seq, e.stamp - r.stamp, e.digest) for e in r.outputs],
            OUTCOMES.index(r.outcome),
            [(d.input, stream_index(d.stream), d.incarnation, d.seq, d.stamp, d.reason, d.because) for d in r.drops]
            if r.drops
            else (),
            dict(r.detail) if r.detail else _NO_DETAIL,
            r.wall_start,
            r.duration,
        )
        for r in records
    ]
    batch = {
        "format": FORMAT,
        "operator": operator,
        "incarnation": incarnation,
        "first": index,
        "last": last,
        "inputs": names,
        "streams": list(streams),
        "rows": rows,
    }
    data: bytes = msgpack.packb(batch, use_bin_type=True)
    return data


def encode_single(record: FiringRecord) -> bytes:
    """Returns the same as `encode_batch([record])`, optimised for a record like the one before it: the header that
    identifies its operator is already packed."""
    streams: list[str] = []
    refs: list[tuple[int, int, int, int]] = []
    for ref in record.inputs.values():
        if not isinstance(ref, MessageRef) or ref.stream in streams:
            return encode_batch([record])
        refs.append((0, len(streams), ref.incarnation, ref.seq))
        streams.append(ref.stream)
    if record.drops or record.detail or record.stale or record.late:
        return encode_batch([record])
    key = record.operator, record.incarnation, tuple(record.inputs), tuple(streams)
    about = _about.get(key) or _describe(*key)
    stamp = record.stamp
    outputs: list[tuple[int, int, bytes] | None] = []
    for made in record.outputs:
        outputs.append(None if made is None else (made.seq, made.stamp - stamp, made.digest))
    row = (
        _KIND_NUMBER[record.kind],
        stamp,
        record.tick,
        refs,
        (),
        (),
        outputs,
        0 if record.outcome == "ok" else 1,
        (),
        _NO_DETAIL,
        record.wall_start,
        record.duration,
    )
    return b"".join((about[0], _pack(record.index), about[1], _pack(row)))


_pack = msgpack.Packer(use_bin_type=True).pack
_about: dict[tuple[str, int, tuple[str, ...], tuple[str, ...]], tuple[bytes, bytes]] = {}
"""The bytes of batches of one record before and after its index, by (operator, incarnation, inputs, their streams)."""


def _describe(operator: str, incarnation: int, names: tuple[str, ...], streams: tuple[str, ...]) -> tuple[bytes, bytes]:
    before = {"format": FORMAT, "operator": operator, "incarnation": incarnation}
    after = {"last": False, "inputs": names, "streams": streams}
    fields = [b"".join(_pack(part) for item in each.items() for part in item) for each in (before, after)]
    head = bytes([0x80 | len(before) + 1 + len(after) + 1]) + fields[0] + _pack("first")
    if len(_about) >= _MOST_DESCRIBED:
        _about.clear()
    found = _about[operator, incarnation, names, streams] = head, fields[1] + _pack("rows") + b"\x91"
    return found


_MOST_DESCRIBED = 4096


def consecutive(records: Iterable[FiringRecord], most: int = sys.maxsize) -> Iterator[list[FiringRecord]]:
    """Records of one operator, in order, in parts of at most so many that can each be a batch."""
    part: list[FiringRecord] = []
    for record in records:
        if part and (
            len(part) == most or (record.incarnation, record.index) != (part[-1].incarnation, part[-1].index + 1)
        ):
            yield part
            part = []
        part.append(record)
    if part:
        yield part


@dataclass(frozen=True, slots=True)
class Batch:
    """A decoded batch of consecutive firing records of one operator, with the bytes that it was decoded from."""

    operator: str
    incarnation: int
    last: bool
    records: tuple[FiringRecord, ...]
    data: bytes


def decode_batch(data: bytes) -> Batch:
    """Raises `FiringRecordError` for anything that `encode_batch` did not write."""
    rows = unpack_batch(data)
    return Batch(rows.operator, rows.incarnation, rows.last, decode_rows(rows), data)


class Rows(NamedTuple):
    """A batch of which the records are rows still: values in the order of the fields of `FiringRecord` from `kind` on,
    with references to `streams` by number."""

    operator: str
    incarnation: int
    first: int
    last: bool
    names: list[str]
    streams: list[str]
    rows: list[list[Any]]


def unpack_batch(data: bytes) -> Rows:
    """The rows of a batch, for uses that need little of each. Raises `FiringRecordError` for what is no batch; what a
    row holds is not looked at."""
    try:
        batch = msgpack.unpackb(data, raw=False)
        if batch["format"] != FORMAT:
            raise FiringRecordError(f"firing records of format {batch['format']!r}; this version reads {FORMAT}")
        operator, incarnation, first = batch["operator"], batch["incarnation"], batch["first"]
        return Rows(operator, incarnation, first, bool(batch["last"]), batch["inputs"], batch["streams"], batch["rows"])
    except FiringRecordError:
        raise
    except _DAMAGE as error:
        raise _damaged(error) from error


def decode_rows(batch: Rows) -> tuple[FiringRecord, ...]:
    """The records of a batch. Raises `FiringRecordError`."""
    operator, incarnation, first, _, names, streams, rows = batch
    try:
        return tuple([_record(operator, incarnation, first + n, row, names, streams) for n, row in enumerate(rows)])
    except FiringRecordError:
        raise
    except _DAMAGE as error:
        raise _damaged(error) from error


_DAMAGE = (ValueError, TypeError, KeyError, IndexError, RecursionError, msgpack.UnpackException)


def _damaged(error: Exception) -> FiringRecordError:
    what = f"{type(error).__name__}: {error}".rstrip(": ")
    return FiringRecordError(f"not a batch of firing records ({what})")


def _record(
    operator: str, incarnation: int, index: int, row: list[Any], names: list[str], streams: list[str]
) -> FiringRecord:
    kind, stamp, tick, inputs, stale, late, outputs, outcome, drops, detail, wall_start, duration = row
    return FiringRecord(
        operator,
        incarnation,
        index,
        KINDS[kind],
        stamp,
        bool(tick),
        {name: _decode_ref(ref, streams) for name, ref in zip(names, inputs, strict=True)} if inputs else {},
        frozenset(stale) if stale else _NO_NAMES,
        frozenset(late) if late else _NO_NAMES,
        tuple([None if e is None else Emission(e[0], stamp + e[1], e[2]) for e in outputs]),
        OUTCOMES[outcome],
        tuple(Drop(i, streams[s], at, n, inc, why, of) for i, s, inc, n, at, why, of in drops) if drops else (),
        detail,
        wall_start,
        duration,
    )


def _encode_ref(ref: InputRef, stream_index: Callable[[str], int]) -> list[Any] | None:
    """nil, [0, stream, incarnation, seq], [1, runs of (stream, incarnation, first, more)...], [2, messages...]."""
    if isinstance(ref, MessageRef):
        return [0, stream_index(ref.stream), ref.incarnation, ref.seq]
    match ref:
        case None:
            return None
        case tuple():
            return [1, *([stream_index(r.stream), r.incarnation, r.first_seq, r.last_seq - r.first_seq] for r in ref)]
        case _:
            return [2, *([stream_index(m.stream), m.incarnation, m.seq] for m in ref.values())]


def _decode_ref(data: list[Any] | None, streams: list[str]) -> InputRef:
    if data is None:
        return None
    if data[0] == 0:
        _, stream, incarnation, seq = data
        return MessageRef(streams[stream], incarnation, seq)
    tag, *rest = data
    if tag == 1:
        return tuple(RunRef(streams[s], i, first, first + more) for s, i, first, more in rest)
    if tag == 2:
        return {streams[s]: MessageRef(streams[s], i, seq) for s, i, seq in rest}
    raise FiringRecordError(f"an input reference of kind {tag!r}; 0, 1 and 2 are known")
