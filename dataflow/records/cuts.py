"""Stands in for firing records that were left out on purpose, in a part of a recording: `cut` records.

The detail of a `cut` record holds

- `left_out`: how many calls were left out just before it; absent where none were;
- `state`: the operator's state there, packed; absent where it is not known;
- `params`: the parameters that were changed by then: [before the last `setup()`, since];
- `code`: the digests, by module, of the code that it ran since its last `setup()`, where that is left out;
- `again`: whether the operator had been set up more than once by then;
- `held`: messages of the operator that the part holds although the calls that made them are not in it:
  [stream, incarnation, seq, stamp, digest] each.

It keeps the number of the record before the one that follows it, so that firings are called by their own numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from dataflow.records.firing import CALLS, FiringRecord


class OrphanedMessage(NamedTuple):
    """A message whose maker's record was left out."""

    stream: str
    incarnation: int
    seq: int
    stamp: int
    digest: bytes

    @property
    def place(self) -> tuple[int, int]:
        """(incarnation, number) in its stream."""
        return self.incarnation, self.seq


class ResumePoint(NamedTuple):
    """Place where an operator is to be taken up: its changed parameters, its state (None: not known), and the code of
    its last `setup()` if that is left out."""

    again: bool
    at_setup: Mapping[str, Any]
    since: Mapping[str, Any]
    state: bytes | None
    code: Mapping[str, str] | None = None


def cut_record(
    before: FiringRecord, *, left_out: int, taken: ResumePoint | None, held: Iterable[OrphanedMessage], stamp: int
) -> FiringRecord:
    """The record that takes the place of `before` and of those in front of it."""
    detail: dict[str, Any] = {"held": [list(message) for message in held]}
    if taken is not None:
        detail |= {"left_out": left_out, "again": taken.again, "params": [dict(taken.at_setup), dict(taken.since)]}
        if taken.state is not None:
            detail["state"] = taken.state
        if taken.code is not None:
            detail["code"] = dict(taken.code)
    return FiringRecord(before.operator, before.incarnation, before.index, "cut", stamp, detail=detail)


def held_by(record: FiringRecord) -> Iterator[OrphanedMessage]:
    """The messages that a `cut` record accounts for."""
    if record.kind == "cut":
        for message in record.detail.get("held", ()):
            yield OrphanedMessage(*message)


def taken_by(record: FiringRecord) -> ResumePoint | None:
    """Returns where a `cut` record takes an operator up; None where no calls were left out."""
    detail = record.detail
    if record.kind != "cut" or "left_out" not in detail:  # that of a snapshot is the size of one too large to be kept
        return None
    at_setup, since = detail["params"]
    return ResumePoint(bool(detail["again"]), at_setup, since, detail.get("state"), code_in(record))


def code_in(record: FiringRecord) -> Mapping[str, str] | None:
    """Returns the digests, by module, of the code that an operator ran from here on; None where the record has none."""
    code = record.detail.get("code")
    if not isinstance(code, Mapping) or not all(isinstance(word, str) for pair in code.items() for word in pair):
        return None
    return code


def parameters_at(records: Iterable[FiringRecord]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the changed parameters of an operator behind its records: before the last `setup()`, and since."""
    at_setup: dict[str, Any] = {}
    since: dict[str, Any] = {}
    for record in records:
        if record.kind == "param":
            since[record.detail["name"]] = record.detail["value"]
        elif record.kind == "setup":
            at_setup |= since
            since = {}
        elif (taken := taken_by(record)) is not None:
            at_setup |= taken.at_setup
            since = dict(taken.since)
    return at_setup, since


def is_known(record: FiringRecord) -> bool:
    """Returns whether a record holds the operator's state."""
    if record.kind == "restore":
        return record.detail["state"] is not None
    return record.kind in ("snapshot", "cut") and "state" in record.detail


class StateKnowledge:
    """Follows the records of an operator with a state: whether it is known, from a cut without a state on."""

    def __init__(self) -> None:
        self._lost = False

    def of(self, record: FiringRecord) -> FiringRecord | None:
        """Returns the next record as it is to be repeated; None for a call that cannot be, since the state is not
        known. From the next snapshot on it is known again."""
        kind = record.kind
        if kind == "cut" and taken_by(record) is not None:
            self._lost = "state" not in record.detail
        elif self._lost and kind == "snapshot" and is_known(record):
            self._lost = False
            return replace(record, kind="restore")
        elif self._lost and kind == "setup":
            self._lost = False
        return None if self._lost and kind in (*CALLS, "reset") else record
