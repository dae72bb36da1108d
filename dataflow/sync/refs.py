"""A firing by reference: which messages each input had, without their content. Firing records embed this.

A reference is never changed; those to one message, made for every firing, are not frozen all the same (see `entries`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from dataflow.sync.entries import Entry, Firing, FiringKind, InputValue


@dataclass(slots=True, unsafe_hash=True)
class MessageRef:
    """One message: its stream, the stream's incarnation, and its number there."""

    stream: str
    incarnation: int
    seq: int


@dataclass(frozen=True, slots=True)
class RunRef:
    """Consecutive messages of one stream, from `first_seq` to `last_seq`, both included."""

    stream: str
    incarnation: int
    first_seq: int
    last_seq: int

    def __iter__(self) -> Iterator[MessageRef]:
        return (MessageRef(self.stream, self.incarnation, seq) for seq in range(self.first_seq, self.last_seq + 1))


InputRef = MessageRef | None | tuple[RunRef, ...] | Mapping[str, MessageRef]
"""A message or None; of a Batch its runs; of a `many` trigger or Sampled a map from stream to message."""


def messages_of(ref: InputRef) -> Iterator[MessageRef]:
    """Every message that a reference names."""
    match ref:
        case None:
            return
        case MessageRef():
            yield ref
        case tuple():
            for run in ref:
                yield from run
        case _:
            yield from ref.values()


@dataclass(frozen=True, slots=True)
class FiringInputs:
    """Everything about a firing that `process()` could see, with messages by reference."""

    stamp: int
    kind: FiringKind
    tick: bool = False
    inputs: Mapping[str, InputRef] = field(default_factory=dict)
    stale: frozenset[str] = frozenset()
    late: frozenset[str] = frozenset()


def refs_of(firing: Firing) -> FiringInputs:
    """`firing` by reference. Its entries must name their stream, as those that come out of an aligner do."""
    return FiringInputs(firing.stamp, firing.kind, firing.tick, input_refs(firing), firing.stale, firing.late)


def input_refs(firing: Firing) -> dict[str, InputRef]:
    """The inputs of a firing by reference."""
    refs: dict[str, InputRef] = {}
    for name, value in firing.inputs.items():
        if value.__class__ is Entry:
            refs[name] = MessageRef(value.stream, value.incarnation, value.seq)
        else:
            refs[name] = _ref(value)
    return refs


def _ref(value: InputValue) -> InputRef:
    if value is None:
        return None
    if isinstance(value, Entry):
        return _message_ref(value)
    if isinstance(value, tuple):
        return _runs(value)
    return {stream: _message_ref(entry) for stream, entry in value.items()}


def _message_ref(entry: Entry) -> MessageRef:
    return MessageRef(entry.stream, entry.incarnation, entry.seq)


def _runs(entries: tuple[Entry, ...]) -> tuple[RunRef, ...]:
    """The fewest runs that hold exactly `entries`, stream by stream; a gap in seq begins a new run."""
    runs: list[RunRef] = []
    for entry in sorted(entries, key=lambda e: (e.stream, e.incarnation, e.seq)):
        last = runs[-1] if runs else None
        follows = (
            last is not None
            and (last.stream, last.incarnation) == (entry.stream, entry.incarnation)
            and last.last_seq + 1 == entry.seq
        )
        if last is not None and follows:
            runs[-1] = RunRef(last.stream, last.incarnation, last.first_seq, entry.seq)
        else:
            runs.append(RunRef(entry.stream, entry.incarnation, entry.seq, entry.seq))
    return tuple(runs)
