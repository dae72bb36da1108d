"""The inverse of the aligner: recorded firings, and messages in any order, give those firings again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from dataflow.sync.entries import Entry, Firing, InputValue
from dataflow.sync.refs import FiringInputs, InputRef, MessageRef, RunRef
from dataflow.sync.spec import AlignSpec, SampledSpec

Position = tuple[int, int]
"""Of a message in its stream: (incarnation, seq)."""


class RecordedAligner:
    """Yields recorded firings again, each as soon as all its messages are there.

    records: the operator's fire, tick and finish records in order; read one ahead, so an iterator over a file
    is fine.

    Within an input the recorded positions on a stream never go back, so what lies below the last position
    used by every input of a stream is forgotten. Messages of a stream from which records take nothing are
    held to the end: the host bounds how far it reads ahead.
    """

    def __init__(self, spec: AlignSpec, records: Iterable[FiringInputs]) -> None:
        self._records: Iterator[FiringInputs] = iter(records)
        self._next = next(self._records, None)
        self._held: dict[str, dict[Position, Entry]] = {stream: {} for stream in spec.streams}
        self._from: dict[str, dict[str, Position]] = {stream: {} for stream in spec.streams}  # stream -> input -> ...
        self._reused = frozenset(s.name for s in spec.inputs if isinstance(s, SampledSpec))
        for declared in spec.inputs:
            for stream in declared.streams:
                self._from[stream][declared.name] = (-1, -1)
        self._missing: MessageRef | None = None

    def push(self, stream: str, entry: Entry) -> None:
        """A message arrives; streams may be interleaved in any way."""
        if stream not in self._held:
            raise KeyError(f"stream {stream!r} feeds no input; those that do: {', '.join(sorted(self._held))}")
        if not entry.stream:
            entry = Entry(entry.stamp, entry.value, entry.seq, entry.incarnation, entry.digest, stream)
        position = (entry.incarnation, entry.seq)
        if self._next is not None and position >= min(self._from[stream].values()):
            self._held[stream][position] = entry

    def poll(self) -> Firing | None:
        """The next recorded firing, or None while a message of it is missing or when there is none left."""
        record = self._next
        if record is None or (self._missing is not None and self._find(self._missing) is None):
            return None
        self._missing = None
        inputs: dict[str, InputValue] = {}
        for name, ref in record.inputs.items():
            inputs[name] = self._resolve(ref)
            if self._missing is not None:
                return None
        self._next = next(self._records, None)
        self._forget(record)
        return Firing(record.stamp, record.kind, record.tick, inputs, record.stale, record.late)

    def ended(self) -> bool:
        """Whether every recorded firing has been returned."""
        return self._next is None

    def missing(self) -> MessageRef | None:
        """A message that the next firing waits for; None if `poll` has not found one missing."""
        return self._missing

    def buffered(self) -> dict[str, int]:
        """The number of messages held, by stream."""
        return {stream: len(held) for stream, held in self._held.items()}

    def _find(self, ref: MessageRef) -> Entry | None:
        return self._held[ref.stream].get((ref.incarnation, ref.seq))

    def _one(self, ref: MessageRef) -> Entry | None:
        entry = self._find(ref)
        if entry is None:
            self._missing = ref
        return entry

    def _resolve(self, ref: InputRef) -> InputValue:
        """The value that `ref` stands for; sets `_missing` if part of it is not there."""
        if ref is None:
            return None
        if isinstance(ref, MessageRef):
            return self._one(ref)
        if isinstance(ref, tuple):
            found = [self._one(message) for run in ref for message in run]
            return tuple(sorted((e for e in found if e is not None), key=lambda e: (e.stamp, e.stream)))
        entries = {stream: self._one(message) for stream, message in ref.items()}
        return {stream: entry for stream, entry in entries.items() if entry is not None}

    def _forget(self, record: FiringInputs) -> None:
        """Moves every input past what `record` took, and lets go of what no input can take any more."""
        if self._next is None:
            for held in self._held.values():
                held.clear()
            return
        moved: set[str] = set()
        for name, ref in record.inputs.items():
            keep = 0 if name in self._reused else 1
            for last in _last_refs(ref):
                position = (last.incarnation, last.seq + keep)
                if position > self._from[last.stream][name]:
                    self._from[last.stream][name] = position
                    moved.add(last.stream)
        for stream in moved:
            low, held = min(self._from[stream].values()), self._held[stream]
            while held and (position := next(iter(held))) < low:
                del held[position]


def _last_refs(ref: InputRef) -> Iterable[MessageRef]:
    if ref is None:
        return ()
    if isinstance(ref, MessageRef):
        return (ref,)
    if isinstance(ref, Mapping):
        return ref.values()
    return [MessageRef(run.stream, run.incarnation, run.last_seq) for run in ref if isinstance(run, RunRef)]
