"""The inverse of the aligner: recorded firings, and messages in any order, give those firings again."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.sync.entries import Entry, Firing, InputValue
from dataflow.sync.refs import FiringInputs, InputRef, MessageRef, messages_of
from dataflow.sync.spec import AlignSpec

_BITS = 10
_PAGE = 1 << _BITS
_MOST = 255


class Uses:
    """Counts how often recorded firings take each message, in a byte a message as long as it is less than 255 times."""

    def __init__(self) -> None:
        self._pages: dict[tuple[str, int], dict[int, bytearray]] = {}
        """(stream, incarnation) → number of a message without its last bits → counts by these."""
        self._more: dict[tuple[str, int, int], int] = {}

    def add(self, inputs: Mapping[str, InputRef]) -> None:
        """Counts what one firing takes."""
        for ref in inputs.values():
            for message in (ref,) if ref.__class__ is MessageRef else messages_of(ref):
                pages = self._pages.setdefault((message.stream, message.incarnation), {})
                page = pages.get(message.seq >> _BITS)
                if page is None:
                    page = pages[message.seq >> _BITS] = bytearray(_PAGE)
                at = message.seq & _PAGE - 1
                if page[at] < _MOST:
                    page[at] += 1
                else:
                    place = (message.stream, message.incarnation, message.seq)
                    self._more[place] = self._more.get(place, 0) + 1

    def left(self, stream: str, incarnation: int, seq: int) -> bool:
        """Returns whether a message is still to be taken."""
        page = self._pages.get((stream, incarnation), {}).get(seq >> _BITS)
        return page is not None and page[seq & _PAGE - 1] > 0

    def take(self, message: MessageRef) -> bool:
        """Counts one use as done. Returns whether it was the last of that message."""
        if self._more:
            place = (message.stream, message.incarnation, message.seq)
            if (more := self._more.pop(place, 0)) > 1:
                self._more[place] = more - 1
            if more:
                return False
        page = self._pages[message.stream, message.incarnation][message.seq >> _BITS]
        page[message.seq & _PAGE - 1] -= 1
        return not page[message.seq & _PAGE - 1]


class RecordedAligner:
    """Makes recorded firings again, each as soon as all its messages are there. `uses`: how often the firings to come
    take each message. Only those are held, each until its last firing. Whatever else arrives is let go at once."""

    def __init__(self, spec: AlignSpec, uses: Uses) -> None:
        self._streams = frozenset(spec.streams)
        self._uses = uses
        self._held: dict[MessageRef, Entry] = {}
        self._missing: MessageRef | None = None

    def push(self, stream: str, entry: Entry) -> None:
        """A message arrives; streams may be interleaved in any way."""
        if stream not in self._streams:
            raise KeyError(f"stream {stream!r} feeds no input; those that do: {', '.join(sorted(self._streams))}")
        if self.takes(stream, entry):
            if not entry.stream:
                entry = Entry(entry.stamp, entry.value, entry.seq, entry.incarnation, entry.digest, stream)
            self._held[MessageRef(stream, entry.incarnation, entry.seq)] = entry

    def takes(self, stream: str, entry: Entry) -> bool:
        """Returns whether a firing to come takes a message."""
        return self._uses.left(stream, entry.incarnation, entry.seq)

    def take(self, record: FiringInputs) -> Firing | None:
        """Returns the next firing, of which `record` holds the inputs; None while a message of it is missing."""
        if self._missing is not None and self._missing not in self._held:
            return None
        self._missing = None
        inputs: dict[str, InputValue] = {}
        for name, ref in record.inputs.items():
            inputs[name] = self._resolve(ref)
            if self._missing is not None:
                return None
        self._let_go(record)
        return Firing(record.stamp, record.kind, record.tick, inputs, record.stale, record.late)

    def missing(self) -> MessageRef | None:
        """A message that the next firing waits for; None if `take` has not found one missing."""
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
                if self._uses.take(message):
                    del self._held[message]
