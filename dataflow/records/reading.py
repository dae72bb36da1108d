"""Reads the firing records of a recording: the file once, every operator's records decoded at most once."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Protocol

from dataflow.recording import Recording, RecordingError
from dataflow.records.cuts import held_by, is_known
from dataflow.records.firing import CALLS, FiringRecord, FiringRecordError, decode_batch
from dataflow.sync import InputRef, MessageRef

Place = tuple[int, int]
"""(incarnation, number) of a message in its stream."""
Digests = Mapping[str, Mapping[Place, bytes]]
"""Stream → place → the recorded digest."""


class Maker(Protocol):
    """A node of a graph, as far as its records need it: `outputs` maps its ports to streams, in declared order."""

    @property
    def name(self) -> str: ...

    @property
    def outputs(self) -> Mapping[str, str]: ...


class FiringLog:
    """The firing records of many operators: as batches until they are requested."""

    def __init__(
        self, batches: Mapping[str, Sequence[bytes]], origin: str, begins: Mapping[str, int] | None = None
    ) -> None:
        """`begins`: by operator the index from which on there are all records, where those before were not read."""
        self._batches, self._origin = batches, origin
        self.begins: Mapping[str, int] = begins or {}
        self._decoded: dict[str, tuple[FiringRecord, ...]] = {}

    @staticmethod
    def read(recording: Recording) -> FiringLog:
        """The records of all operators, in one pass over the file."""
        batches: dict[str, list[bytes]] = {}
        for operator, payload in recording.firings():
            batches.setdefault(operator, []).append(payload)
        return FiringLog(batches, str(recording.path))

    @property
    def operators(self) -> Collection[str]:
        """The operators that left records."""
        return self._batches.keys()

    def batches(self, operator: str) -> Sequence[bytes]:
        """The batches of one operator as they were recorded."""
        return self._batches.get(operator, ())

    def of(self, operator: str) -> tuple[FiringRecord, ...]:
        """The records of one operator, in the order of the file.

        Raises `RecordingError` for a batch that is none, with the file and the operator.
        """
        if operator not in self._decoded:
            self._decoded[operator] = tuple(_decoded(self._batches.get(operator, ()), operator, self._origin))
        return self._decoded[operator]

    def digests(self, makers: Iterable[Maker], streams: Collection[str]) -> Digests:
        """Returns what `makers` emitted on `streams`, by its records."""
        found: dict[str, dict[Place, bytes]] = {stream: {} for stream in streams}
        for maker in makers:
            outputs = list(maker.outputs.values())
            if found.keys().isdisjoint(outputs):
                continue
            for record in self.of(maker.name):
                for stream, emission in zip(outputs, record.outputs, strict=False):  # a failed call has none
                    if emission is not None and stream in found:
                        found[stream][record.incarnation, emission.seq] = emission.digest
                for held in held_by(record):
                    if held.stream in found:
                        found[held.stream][held.place] = held.digest
        return found


def recorded_firings(recording: Recording, operator: str) -> Iterator[FiringRecord]:
    """The firing records of one operator, in the order of the file. Raises `RecordingError`."""
    payloads = (payload for _, payload in recording.firings(operator))
    return _decoded(payloads, operator, str(recording.path))


def _decoded(payloads: Iterable[bytes], operator: str, origin: str) -> Iterator[FiringRecord]:
    for payload in payloads:
        try:
            batch = decode_batch(payload)
        except FiringRecordError as error:
            raise RecordingError(f"{origin}: firing records of operator {operator!r} are damaged: {error}") from error
        if batch.operator != operator:
            raise RecordingError(
                f"{origin}: a batch of firing records of operator {batch.operator!r} is filed under {operator!r}"
            )
        yield from batch.records


def first_places(ref: InputRef) -> Iterator[tuple[str, tuple[int, int]]]:
    """(stream, (incarnation, number)) of the first message that a reference names on each stream."""
    match ref:
        case None:
            return
        case MessageRef():
            yield ref.stream, (ref.incarnation, ref.seq)
        case tuple():
            for run in ref:
                yield run.stream, (run.incarnation, run.first_seq)
        case _:
            for one in ref.values():
                yield one.stream, (one.incarnation, one.seq)


def needed_from(records: Iterable[FiringRecord]) -> dict[str, tuple[int, int]]:
    """By stream, the first message (incarnation, number) that the calls of `records` took."""
    needed: dict[str, tuple[int, int]] = {}
    for record in records:
        for ref in record.inputs.values():
            for stream, place in first_places(ref):
                needed[stream] = min(place, needed.get(stream, place))
    return needed


def whole(records: Iterable[FiringRecord]) -> tuple[list[FiringRecord], int]:
    """The records by (incarnation, index), each once, and how many calls had to be left out.

    Where records are missing, those after them in the same incarnation cannot be repeated: the operator's state there
    is not known. The next incarnation begins from `setup()` again (or, after a jump of the clock, does not).
    """
    kept: list[FiringRecord] = []
    lost = 0
    following = (0, 0)
    known = True
    for record in sorted(records, key=lambda r: (r.incarnation, r.index)):
        place = (record.incarnation, record.index)
        if place < following:
            continue  # handed over twice, when its process died
        begins = record.incarnation > following[0] or not following[1]
        if record.kind == "cut":
            known = True
        elif begins:
            known = record.index == 0 and (record.kind != "reset" or known)
        else:
            known = known and place == following
        following = (record.incarnation, record.index + 1)
        if known:
            kept.append(record)
        else:
            lost += record.kind in CALLS
    return kept, lost


def beginning(
    records: list[FiringRecord], begin: int | None, *, stateless: bool
) -> tuple[list[FiringRecord], list[FiringRecord], str]:
    """Returns what lies before the place from which records are repeated, the rest, and how that place was found.

    It is after the last recorded state at or before the stamp `begin`, or at `begin` itself for an operator without
    state; for any other at the start, since its state in the middle is not known.
    """
    if begin is None:
        return [], records, "start"
    place = max((k + 1 for k, r in enumerate(records) if is_known(r) and r.stamp <= begin), default=0)
    if stateless:
        place = next((k for k, r in enumerate(records) if r.kind in CALLS and r.stamp >= begin), len(records))
    found = "stateless" if stateless else "snapshot" if place else "start"
    return records[:place], records[place:], found
