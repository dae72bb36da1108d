"""Other messages in place of those that a call was given."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from dataflow.blame.line import Call
from dataflow.blame.links import Way
from dataflow.blame.nudge import groups, is_finite, made_finite, nudged
from dataflow.blame.repeated_calls import Slot
from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.sync import Entry, Firing, InputValue

ANOTHER = 8
"""Other messages of a stream, from its whole length, that are put in place of one of which nothing else shows an
effect: a number on the same side of a threshold, nudged, shows none."""


class TakenMessage(NamedTuple):
    """A message that a call took in an input."""

    call: Call
    input: str
    entry: Entry


class SubstituteMessages:
    """Finds other messages of a recording. `taken` gives the messages of a stream in an input of calls before one."""

    def __init__(self, recording: Recording, taken: Callable[[Call, str, str], list[Message]]) -> None:
        self._recording, self._taken = recording, taken
        self._spread: dict[str, list[Message]] = {}
        """Of recorded streams, some messages of the whole length."""

    def instead(self, taken: Sequence[TakenMessage], *, hold: bool) -> Iterator[tuple[Way, Sequence[Message]]]:
        """Yields other messages in place of some, where one is another indeed: nudged to either side, what is measured
        first; made finite and nudged, where some are not; the one before each, or with `hold` the one before the first
        of its stream, since a spike that lasts would only be put off."""
        for way, messages in self._alternatives(taken, hold=hold):
            if any(message != each.entry.value for message, each in zip(messages, taken, strict=True)):
                yield way, messages

    def _alternatives(self, taken: Sequence[TakenMessage], *, hold: bool) -> Iterator[tuple[Way, Sequence[Message]]]:
        values = [each.entry.value for each in taken]
        grouped = [self.groups(each) for each in taken]
        for k in range(max(map(len, grouped), default=0)):
            for sign in (1, -1):
                yield (
                    "nudged",
                    [nudged(v, g[k], sign=sign)[0] if k < len(g) else v for v, g in zip(values, grouped, strict=True)],
                )
        finite = [each.entry.value if is_finite(each.entry.value) else self._finite(each) for each in taken]
        if any(other is not value for other, value in zip(finite, values, strict=True)):
            for sign in (1, -1):
                yield "made finite", [nudged(value, sign=sign)[0] for value in finite]
        before: dict[tuple[str, str], Message | None] = {}
        others: list[Message] = []
        for call, name, entry in taken:
            key = name, entry.stream
            if key not in before or not hold:
                before[key] = self._before(call, name, entry)
            other = before[key]
            others.append(entry.value if other is None else other.replace(stamp=entry.stamp))
        yield "the one before", others

    def groups(self, taken: TakenMessage) -> list[tuple[str, ...]]:
        """Returns the fields of a message that are nudged, in their order."""
        return groups(taken.entry.value, self._before(*taken))

    def _finite(self, taken: TakenMessage) -> Message:
        """A message with finite neighbours in place of infinities, if there are any; else itself."""
        value: Message = taken.entry.value
        earlier = self._before(*taken)
        for beside in (*(() if earlier is None else (earlier,)), *self._of(taken.entry.stream)):
            if (made := made_finite(value, beside)) is not value:
                return made
        return made_finite(value, None)

    def _before(self, call: Call, name: str, entry: Entry) -> Message | None:
        """The content of the message before one on its stream, as if it had come at the same time; of a stream that is
        not recorded, of one that a call before took."""
        info = self._recording.streams.get(entry.stream)
        if info is not None and info.static:
            return None
        if info is None:
            earlier = [each for each in self._taken(call, name, entry.stream) if each.stamp < entry.stamp]
            return max(earlier, key=lambda each: each.stamp).replace(stamp=entry.stamp) if earlier else None
        index = self._recording.index(entry.stream, end=entry.stamp - 1)
        return index.read(len(index) - 1).message.replace(stamp=entry.stamp) if len(index) else None

    def elsewhere(self, call: Call, name: str, entry: Entry) -> Iterator[Message]:
        """The contents of other messages of a stream, spread over its length; of one that is not recorded, of those
        that calls before took."""
        recorded = entry.stream in self._recording.streams
        others = self._of(entry.stream) if recorded else self._taken(call, name, entry.stream)[-ANOTHER:]
        at_its_time = (message.replace(stamp=entry.stamp) for message in others)
        yield from (message for message in at_its_time if message != entry.value)

    def _of(self, stream: str) -> list[Message]:
        """Some messages of a recorded stream, spread over its length; none of one that is static, or not recorded."""
        if stream not in self._spread:
            info = self._recording.streams.get(stream)
            index = self._recording.index(stream) if info is not None and not info.static else ()
            rows = sorted({round(k * (len(index) - 1) / (ANOTHER - 1)) for k in range(ANOTHER)}) if index else []
            self._spread[stream] = [index.read(row).message for row in rows] if index else []
        return self._spread[stream]


def without(node: Node, firing: Firing, slots: Sequence[Slot]) -> Mapping[str, InputValue] | None:
    """The inputs without these messages, where a firing may lack them."""
    spec, inputs = node.operator.spec, dict(firing.inputs)
    for name in {name for name, _ in slots}:
        port, given = spec.inputs[name], inputs[name]
        out = {k for each, k in slots if each == name}
        if isinstance(given, tuple):
            inputs[name] = tuple(entry for k, entry in enumerate(given) if k not in out)
        elif port.kind == "in" and not spec.merge:
            return None
        elif isinstance(given, Mapping) and len(out) < len(given):
            inputs[name] = {s: entry for k, (s, entry) in enumerate(given.items()) if k not in out}
        elif port.kind == "in" or not port.required:
            inputs[name] = None
        else:
            return None
    triggered = firing.tick or any(inputs[p.name] for p in spec.triggers if p.name in inputs)
    return inputs if triggered or not spec.triggers else None
