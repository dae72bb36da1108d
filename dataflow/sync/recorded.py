"""The inverse of the aligner: recorded firings, and messages in any order, give those firings again."""

from __future__ import annotations

from collections.abc import Iterable

from dataflow.sync.entries import Entry, Firing, InputValue
from dataflow.sync.refs import FiringInputs, InputRef, MessageRef, messages_of
from dataflow.sync.spec import AlignSpec


class RecordedAligner:
    """Yields recorded firings again, each as soon as all its messages are there.

    records: the operator's fire, tick and finish records in order. They say which messages will be taken, and how
    often: only those are held, each until its last firing. Whatever else arrives is let go at once.
    """

    def __init__(self, spec: AlignSpec, records: Iterable[FiringInputs]) -> None:
        self._records = list(records)
        self._place = 0
        self._streams = frozenset(spec.streams)
        self._wanted: dict[tuple[str, int], dict[int, int]] = {}
        """(stream, incarnation) → number of a message → how many records still take it."""
        for record in self._records:
            for ref in record.inputs.values():
                for message in messages_of(ref):
                    uses = self._wanted.setdefault((message.stream, message.incarnation), {})
                    uses[message.seq] = uses.get(message.seq, 0) + 1
        self._held: dict[MessageRef, Entry] = {}
        self._missing: MessageRef | None = None

    def push(self, stream: str, entry: Entry) -> None:
        """A message arrives; streams may be interleaved in any way."""
        if stream not in self._streams:
            raise KeyError(f"stream {stream!r} feeds no input; those that do: {', '.join(sorted(self._streams))}")
        if entry.seq in self._wanted.get((stream, entry.incarnation), ()):
            if not entry.stream:
                entry = Entry(entry.stamp, entry.value, entry.seq, entry.incarnation, entry.digest, stream)
            self._held[MessageRef(stream, entry.incarnation, entry.seq)] = entry

    def poll(self) -> Firing | None:
        """The next recorded firing, or None while a message of it is missing or when there is none left."""
        if self.ended() or (self._missing is not None and self._missing not in self._held):
            return None
        record = self._records[self._place]
        self._missing = None
        inputs: dict[str, InputValue] = {}
        for name, ref in record.inputs.items():
            inputs[name] = self._resolve(ref)
            if self._missing is not None:
                return None
        self._place += 1
        self._let_go(record)
        return Firing(record.stamp, record.kind, record.tick, inputs, record.stale, record.late)

    def ended(self) -> bool:
        """Tells whether every recorded firing has been returned."""
        return self._place >= len(self._records)

    def missing(self) -> MessageRef | None:
        """A message that the next firing waits for; None if `poll` has not found one missing."""
        return self._missing

    def buffered(self) -> dict[str, int]:
        """The number of messages held, by stream."""
        held = dict.fromkeys(sorted(self._streams), 0)
        for message in self._held:
            held[message.stream] += 1
        return held

    def _one(self, ref: MessageRef) -> Entry | None:
        entry = self._held.get(ref)
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

    def _let_go(self, record: FiringInputs) -> None:
        """Counts what `record` took, and releases what no later record takes."""
        for ref in record.inputs.values():
            for message in messages_of(ref):
                uses = self._wanted[message.stream, message.incarnation]
                uses[message.seq] -= 1
                if not uses[message.seq]:
                    del uses[message.seq], self._held[message]
