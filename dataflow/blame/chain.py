"""The chain of calls that decided a value: each with the inputs, and the state, that change it when they are others.

Nothing is guessed: a call is made again from its state with an input nudged, taken from the message before, or left
out; the messages that come out go through all later calls on the chain, to the value. An input that changes it is on
the chain, and the call that made it is looked into next, the latest first.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from dataflow.blame.again import AS_IT_WAS, Effects, Other, Place, Slot, place_of, with_messages
from dataflow.blame.field import Field, differ
from dataflow.blame.line import Call, Line
from dataflow.blame.nudge import nudged
from dataflow.execution.threads import limited_threads
from dataflow.graph.model import Graph
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import ReplayError, graph_that_is_here
from dataflow.sync import Entry, Firing, InputValue
from dataflow.sync.entries import entries_of

Way = Literal["nudged", "the one before", "left out", "another"]
TOLERANCE = 1e-4
"""Of floating-point values: a hundredth of the size of a nudge."""
SECONDS = 60.0
ANOTHER = 8
"""Other messages of a stream, from its whole length, that are put in place of one of which nothing else shows an
effect: a number on the same side of a threshold, nudged, shows none."""
MOST_BYTES = 2**31
"""Of the inputs of all calls that are held: beyond it no others are read."""
HISTORY = 0.5
"""Of the time that is left, what the earlier calls of one operator may take."""


class BlameError(ReplayError):
    """Raised for a value whose origin cannot be found; the message has the reason."""


@dataclass(frozen=True, slots=True)
class Effect:
    """The value (None: none) that came when an input was another; `way`: how, and the fields nudged.

    `together`: how many inputs, or calls, were others at once, none of which changes the value alone (a tie).
    """

    way: Way | Literal["call left out", "a new operator"]
    fields: tuple[str, ...]
    value: Any
    together: int = 1


@dataclass(frozen=True, slots=True)
class Link:
    """An input of a call, or with `input` "" the state before it, that decided the value.

    - `call`: the one that took it; `stamp`: its, in ns.
    - `message`: of an input. `maker`: the call that made the message, or that left its mark in the state; None where it
      comes from a source, or from an operator that is not made again, and for a state that the operator was given
      before `call` (a reload, a beginning in the middle).
    - `effects`: the changes of it that changed the value.
    """

    call: Call
    stamp: int
    input: str
    message: Place | None
    message_stamp: int
    maker: Call | None
    effects: tuple[Effect, ...]


@dataclass(slots=True)
class Chain:
    """The calls that decided a value, the latest first.

    - `value`, of the message `place` that `target` made. `links`: why each is on the chain.
    - `sensed`: the links at the chain's ends.
    - `left`: calls on the chain that were not looked into, as the time or the memory for inputs (`MOST_BYTES`) was up.
      `unsplit`: operator, first and last of calls of which some left their mark in the state, which were not found for
      the same reason, or as the operator was given its state behind them.
    - `ended`: by operator, the call before which a new operator gives the same value, so that none before was tried.
    """

    target: Call
    place: Place
    stamp: int
    value: Any
    links: list[Link] = field(default_factory=list)
    left: list[Call] = field(default_factory=list)
    unsplit: list[tuple[str, int, int]] = field(default_factory=list)
    ended: dict[str, int] = field(default_factory=dict)
    made: int = 0
    seconds: float = 0.0

    @property
    def whole(self) -> bool:
        """Returns whether all of it was looked into."""
        return not self.left and not self.unsplit

    @property
    def sensed(self) -> list[Link]:
        """Returns the links to messages that no call made."""
        return [link for link in self.links if link.input and link.maker is None]

    def as_json(self) -> dict[str, Any]:
        """Returns it as JSON values; a value that is no number is as the message holds it."""
        return {
            "value": self.value,
            "call": [*self.target],
            "stamp": self.stamp,
            "links": [
                {
                    "call": [*link.call],
                    "stamp": link.stamp,
                    "input": link.input or None,
                    "message": None if link.message is None else [*link.message],
                    "from": None if link.maker is None else [*link.maker],
                    "effects": [
                        {"way": e.way, "fields": e.fields, "value": e.value, "together": e.together}
                        for e in link.effects
                    ],
                }
                for link in self.links
            ],
            "sensed": [[*place] for place in dict.fromkeys(link.message for link in self.sensed) if place is not None],
            "whole": self.whole,
            "not_looked_into": [[*call] for call in self.left],
            "not_taken_apart": [[*each] for each in self.unsplit],
            "not_tried_before": dict(self.ended),
            "calls_made": self.made,
            "seconds": self.seconds,
        }


class _OutOfTime(Exception):
    pass


class Blame:
    """Looks for what decided a field of a recorded message.

    `watch` gets the numbers of calls made and links found. `budget`: seconds. `tolerance`: see `differ`. Runs operators
    in this process, as `Debugger` does, and raises as that, and `BlameError`.
    """

    def __init__(
        self,
        recording: Recording,
        field: Field,
        graph: Graph | None = None,
        *,
        budget: float = SECONDS,
        tolerance: float = TOLERANCE,
        watch: Callable[[int, int], None] = lambda made, links: None,
    ) -> None:
        self._recording, self._field, self._tolerance, self._watch = recording, field, tolerance, watch
        self.graph = graph_that_is_here(recording)[0] if graph is None else graph
        self._budget, self._deadline = budget, float("inf")
        self._lines: dict[str, Line] = {}
        above = {name: _above(self.graph, name) for name in self.graph.nodes}
        self._rank = {name: len(found) for name, found in above.items()}
        """More than that of each operator that is upstream; equal in a cycle."""
        self._in_cycle = {n for n, found in above.items() if any(n in above[m] for m in found if m != n)}
        self._takers: dict[Place, list[Call]] = {}
        """The calls whose inputs are held that take a message."""
        self._last: dict[str, int] = {}
        """The latest call on the chain of each operator."""
        self._seen: set[Call] = set()
        self._searched: dict[str, int] = {}
        """By operator, from which call on it is known which ones left a mark."""
        self.made = 0
        self._open: list[tuple[tuple[int, int, int], Call]] = []

    def find(self) -> Chain:
        """Finds the chain."""
        began = time.monotonic()
        with ExitStack() as stack:
            stack.enter_context(limited_threads(self.graph.threads))
            try:
                self._chain = chain = self._target()
                self._deadline = began + self._budget
                self._queue(chain.target)
                self._work()
            finally:
                for line in self._lines.values():
                    line.close()
        chain.links.sort(key=lambda link: (-link.stamp, self._age(link.call)))
        chain.seconds = time.monotonic() - began
        return chain

    # ------------------------------------------------------------------------------------------------- the target

    def _target(self) -> Chain:
        stream = self._stream(self._field.stream)
        begins = [i.first for i in self._recording.streams.values() if i.first is not None and not i.static]
        until = min(begins, default=0) + round(self._field.seconds * 1e9)
        maker = self.graph.streams[stream].node
        node = self.graph.nodes[maker]
        if node.source or node.external:
            raise BlameError(f"{stream} is what {maker} gave, {'a source' if node.source else 'which is external'}")
        self.made = 0
        line = self._line(maker)
        port = list(node.outputs.values()).index(stream)
        for number in range(len(line.records) - 1, -1, -1):
            emission = line.records[number].outputs[port] if port < len(line.records[number].outputs) else None
            if emission is not None and emission.stamp <= until:
                break
        else:
            raise BlameError(f"{stream} has no message at or before {self._field.seconds:g} s")
        target, record = Call(maker, number), line.records[number]
        try:
            self._reach(target, number)
        except _OutOfTime:
            raise BlameError(f"the inputs of call {number} of {maker} take more than {MOST_BYTES:,} bytes") from None
        self._port = list(node.outputs)[port]
        shot = line.shots.get(number)
        if shot is None or shot.here.get(self._port) != emission.digest:
            raise BlameError(f"call {number} of {maker} does not give what was recorded: see dataflow verify")
        self._last[maker] = number
        message = self._repeated(target)[self._port]
        value = self._field.value(message)
        if value is None:
            raise BlameError(f"{stream} at {emission.stamp} ns has no {self._field.path.lstrip('.')}: {message!r}")
        self._value = value
        return Chain(target, (stream, record.incarnation, emission.seq), emission.stamp, value)

    def _stream(self, name: str) -> str:
        known = [s for s in self.graph.streams if s == name or s.endswith(f"/{name}")]
        if name not in self.graph.streams and len(known) != 1:
            what = "is several streams" if known else "is no stream"
            raise BlameError(f"{name!r} {what}; there are: {', '.join(known or self.graph.streams)}")
        return name if name in self.graph.streams else known[0]

    def _line(self, operator: str) -> Line:
        if operator not in self._lines:
            self._lines[operator] = Line(self._recording, self.graph, operator, self._count, self._was_read)
        return self._lines[operator]

    def _count(self) -> None:
        self.made += 1
        if time.monotonic() > self._deadline:
            raise _OutOfTime

    def _was_read(self, nbytes: int) -> None:
        if time.monotonic() > self._deadline or sum(line.nbytes for line in self._lines.values()) + nbytes > MOST_BYTES:
            raise _OutOfTime

    def _repeated(self, call: Call) -> Mapping[str, Message]:
        """Makes a call as it was; returns its messages by port. Raises `BlameError` where they are others."""
        line = self._lines[call.operator]
        line.begin(call.number)
        made = line.fire(call.number, line.shots[call.number].firing) or {}
        if {port: message.digest() for port, message in made.items()} != line.shots[call.number].here:
            where = f"call {call.number} of {call.operator}"
            raise BlameError(f"{where} does not repeat: dataflow verify --why {self._recording.path}")
        return made

    def _reach(self, call: Call, last: int) -> None:
        line = self._line(call.operator)
        for number in line.reach(call.number, last):
            for given in line.shots[number].firing.inputs.values():
                for entry in entries_of(given):
                    self._takers.setdefault(place_of(entry), []).append(Call(call.operator, number))
        if line.other is not None:
            raise BlameError(
                f"call {line.other} of {call.operator} does not give what was recorded: see dataflow verify"
            )

    def _age(self, call: Call) -> tuple[int, int, int]:
        """Orders calls, those that others depend on last: by operator, downstream first; in a cycle of operators by
        when they began."""
        operator, number = call
        began = self._lines[operator].records[number].wall_start if operator in self._in_cycle else 0
        return -self._rank[operator], -began, -number

    # ------------------------------------------------------------------------------------------------- the search

    def _queue(self, call: Call) -> None:
        if call not in self._seen:
            self._seen.add(call)
            self._last[call.operator] = max(call.number, self._last.get(call.operator, -1))
            heapq.heappush(self._open, (self._age(call), call))

    def _work(self) -> None:
        while self._open:
            _, call = heapq.heappop(self._open)
            self._watch(self.made, len(self._chain.links))
            try:
                self._look_into(call)
            except _OutOfTime:
                self._chain.left.append(call)
        self._chain.made = self.made

    def _look_into(self, call: Call) -> None:
        if time.monotonic() > self._deadline:
            raise _OutOfTime
        line = self._line(call.operator)
        self._reach(call, max(call.number, self._last[call.operator]))
        if (shot := line.shots.get(call.number)) is None:
            return
        if call != self._chain.target:
            self._repeated(call)
        without: list[list[Slot]] = []
        for name, given in shot.firing.inputs.items():
            slots = [(name, k) for k in range(len(entries_of(given)))]
            found = list(self._deciding(call, shot.firing, slots))
            self._link_all(call, shot.firing, found)
            if slots and not found:
                without.append(slots)
        if len(without) > 1:
            self._link_all(call, shot.firing, self._tied(call, shot.firing, without))
        if not line.stateless:
            self._look_back(call)

    def _link_all(self, call: Call, firing: Firing, found: Iterable[tuple[Slot, tuple[Effect, ...]]]) -> None:
        for (name, k), effects in found:
            self._link(call, name, entries_of(firing.inputs[name])[k], effects)

    def _tied(
        self, call: Call, firing: Firing, inputs: Sequence[Sequence[Slot]]
    ) -> Iterator[tuple[Slot, tuple[Effect, ...]]]:
        """Yields the messages of several inputs that decide together, though none alone."""
        effects = self._together(call, firing, [slot for slots in inputs for slot in slots])
        left = list(inputs) if effects else []
        for slots in inputs:
            rest = [each for each in left if each is not slots]
            if len(rest) > 1 and (fewer := self._together(call, firing, [slot for each in rest for slot in each])):
                left, effects = rest, fewer
        yield from ((slot, effects) for slots in left for slot in slots)

    def _link(self, call: Call, name: str, entry: Entry, effects: tuple[Effect, ...]) -> None:
        maker = self._maker(entry)
        stamp = self._lines[call.operator].records[call.number].stamp
        self._chain.links.append(Link(call, stamp, name, place_of(entry), entry.stamp, maker, effects))
        if maker is not None and any(effect.together == 1 for effect in effects):
            self._queue(maker)

    def _maker(self, entry: Entry) -> Call | None:
        stream = self.graph.streams[entry.stream]
        node = self.graph.nodes[stream.node]
        if node.source or node.external or stream.static:
            return None
        number = self._line(node.name).emitted(entry.stream, (entry.incarnation, entry.seq))
        return None if number is None else Call(node.name, number)

    def _deciding(self, call: Call, firing: Firing, slots: Sequence[Slot]) -> Iterator[tuple[Slot, tuple[Effect, ...]]]:
        """Yields those of the messages that decide, each with its effects; many are first tried together."""
        if not slots:
            return
        if len(slots) == 1:
            if effects := tuple(self._effects(call, firing, slots[0])):
                yield slots[0], effects
            return
        if len(slots) > ANOTHER and not self._together(call, firing, slots):
            return
        half, alone = len(slots) // 2, False
        for part in (slots[:half], slots[half:]):
            for found in self._deciding(call, firing, part):
                alone = True
                yield found
        if not alone and (effects := self._together(call, firing, slots)):
            yield from ((slot, effects) for slot in slots)

    def _together(self, call: Call, firing: Firing, slots: Sequence[Slot]) -> tuple[Effect, ...]:
        tried = ((way, self._changed({call: other})) for way, other in self._others(call, firing, slots))
        return tuple(Effect(way, (), found[0], len(slots)) for way, found in tried if found is not None)

    def _effects(self, call: Call, firing: Firing, slot: Slot) -> Iterator[Effect]:
        shown = False
        for way, other in self._others(call, firing, [slot]):
            if (found := self._changed({call: other})) is not None:
                shown = True
                yield Effect(way, self._fields(call, firing, slot) if way == "nudged" else (), found[0])
        entry = entries_of(firing.inputs[slot[0]])[slot[1]]
        for message in () if shown else self._elsewhere(call, slot[0], entry):
            if (found := self._changed({call: with_messages(firing, {slot: message})})) is not None:
                yield Effect("another", (), found[0])
                return

    def _fields(self, call: Call, firing: Firing, slot: Slot) -> tuple[str, ...]:
        """The fields of a message that change the value when they are nudged by themselves."""
        name, k = slot
        entry = entries_of(firing.inputs[name])[k]
        _, names = nudged(entry.value)
        if len(names) < 2:
            return names
        found = []
        for each in names:
            other, fields = nudged(entry.value, (each,))
            if fields and self._changed({call: with_messages(firing, {slot: other})}) is not None:
                found.append(each)
        return tuple(found)

    def _others(
        self, call: Call, firing: Firing, slots: Sequence[Slot]
    ) -> Iterator[tuple[Way, Mapping[str, InputValue]]]:
        """Yields the inputs with these messages nudged, taken from the message before, left out."""
        entries = {slot: entries_of(firing.inputs[slot[0]])[slot[1]] for slot in slots}
        yield "nudged", with_messages(firing, {slot: nudged(entry.value)[0] for slot, entry in entries.items()})
        before = {slot: self._before(call, slot[0], entry) for slot, entry in entries.items()}
        if any(message is not None for message in before.values()):
            yield "the one before", with_messages(firing, {slot: m for slot, m in before.items() if m is not None})
        lacking = self._without(call.operator, firing, slots)
        if lacking is not None:
            yield "left out", lacking

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

    def _elsewhere(self, call: Call, name: str, entry: Entry) -> Iterator[Message]:
        """The contents of other messages of a stream, spread over its length; of one that is not recorded, of those
        that calls before took."""
        info = self._recording.streams.get(entry.stream)
        if info is None:
            yield from (m.replace(stamp=entry.stamp) for m in self._taken(call, name, entry.stream)[-ANOTHER:])
        elif not info.static:
            index = self._recording.index(entry.stream)
            for row in sorted({round(k * (len(index) - 1) / (ANOTHER - 1)) for k in range(ANOTHER)}):
                yield index.read(row).message.replace(stamp=entry.stamp)

    def _taken(self, call: Call, name: str, stream: str) -> list[Message]:
        """What calls before took of a stream in an input."""
        first = max(0, call.number - ANOTHER)
        self._reach(Call(call.operator, first), call.number)
        shots = self._lines[call.operator].shots
        given = [shots[n].firing.inputs.get(name) for n in range(first, call.number) if n in shots]
        return [entry.value for each in given for entry in entries_of(each) if entry.stream == stream]

    def _without(self, operator: str, firing: Firing, slots: Sequence[Slot]) -> Mapping[str, InputValue] | None:
        """The inputs without these messages, where a firing may lack them."""
        spec = self.graph.nodes[operator].operator.spec
        inputs = dict(firing.inputs)
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

    # ------------------------------------------------------------------------------------------------- the state

    def _look_back(self, call: Call) -> None:
        """Finds the earlier calls of an operator that left their mark in its state: the latest ones first, in blocks of
        1, 1, 2, 4, 8... calls, back to where an operator that is new gives the same value, and no call before has
        brought the state back to that of a new one."""
        operator, line = call.operator, self._line(call.operator)
        first = line.begin_of(call.number)
        end = min(call.number, self._searched.get(operator, call.number))
        size = 1 if end == call.number else end - self._goes_back_to(operator, first, end)
        if end > first and not size:
            return
        deadline = self._deadline
        self._deadline = min(deadline, time.monotonic() + HISTORY * (deadline - time.monotonic()))
        try:
            while end > first:
                begin = max(first, end - size)
                self._reach(Call(operator, begin), self._last[operator])
                for number, effects in self._marks(call, begin, end):
                    earlier = Call(operator, number)
                    self._chain.links.append(Link(call, line.records[call.number].stamp, "", None, 0, earlier, effects))
                    if any(effect.together == 1 for effect in effects):
                        self._queue(earlier)
                self._searched[operator] = begin
                back = self._goes_back_to(operator, first, begin)
                if begin > first and back == begin:
                    self._chain.ended[operator] = min(begin, self._chain.ended.get(operator, begin))
                    break
                size, end = max(size, call.number - begin, begin - back), begin
            else:
                self._look_at_beginning(Call(operator, first))
        except _OutOfTime:
            self._chain.unsplit.append((operator, first, end - 1))
        finally:
            self._deadline = deadline

    def _goes_back_to(self, operator: str, first: int, begin: int) -> int:
        """The call down to which at least the search for marks goes on before `begin`: that itself where it ends.

        A new operator gives the same value where the calls before are forgotten, and where one of them has brought the
        state back to that of a new one: then the search goes back to that call.
        """
        if begin <= first or self._changed({}, anew=Call(operator, begin)) is not None:
            return begin - 1
        line = self._line(operator)
        if not line.is_as_new(begin):
            return begin
        self._reach(Call(operator, first), self._last[operator])
        returned = line.returned_by(begin)
        return begin if returned is None else returned

    def _look_at_beginning(self, first: Call) -> None:
        """Names the state that an operator was given before its first call, where that decides."""
        line = self._lines[first.operator]
        if not line.begins_with_state(first.number) or any(
            link.call == first and not link.input and link.maker is None for link in self._chain.links
        ):
            return
        if (found := self._changed({}, anew=first)) is None:
            return
        effects = (Effect("a new operator", (), found[0]),)
        self._chain.links.append(Link(first, line.records[first.number].stamp, "", None, 0, None, effects))
        if first.number:
            self._chain.unsplit.append((first.operator, 0, first.number - 1))

    def _marks(self, call: Call, begin: int, end: int) -> Iterator[tuple[int, tuple[Effect, ...]]]:
        """Yields those calls from `begin` to before `end` that decide by what they leave in the state."""
        line = self._line(call.operator)
        numbers = [n for n in range(begin, end) if n in line.shots]
        if not numbers:
            return
        effects = []
        if (left_out := self._changed({Call(call.operator, n): None for n in numbers})) is not None:
            effects.append(Effect("call left out", (), left_out[0]))
        if not effects or len(numbers) == 1:
            others = {n: self._nudged_all(line.shots[n].firing) for n in numbers}
            other = self._changed({Call(call.operator, n): inputs for n, inputs in others.items()})
            effects += [] if other is None else [Effect("nudged", (), other[0])]
        if not effects:
            return
        if len(numbers) == 1:
            yield numbers[0], tuple(effects)
            return
        half, alone = (begin + end) // 2, False
        for part in ((half, end), (begin, half)):
            for found in self._marks(call, *part):
                alone = True
                yield found
        if not alone:
            joint = tuple(replace(effect, together=len(numbers)) for effect in effects)
            yield from ((number, joint) for number in numbers)

    def _nudged_all(self, firing: Firing) -> Mapping[str, InputValue]:
        slots = {(n, k): e.value for n, given in firing.inputs.items() for k, e in enumerate(entries_of(given))}
        return with_messages(firing, {slot: nudged(message)[0] for slot, message in slots.items()})

    # ------------------------------------------------------------------------------------------------- the effect

    def _changed(self, others: Mapping[Call, Other], anew: Call | None = None) -> tuple[Any] | None:
        """Makes the calls again with other inputs, or `anew` by an operator that is new, and all later ones on the
        chain that these reach; returns the value if it changed."""
        run = Effects(self._lines, self._takers, self._last, self._age)
        message = run.through(others, anew, self._chain.target, self._port)
        if message is AS_IT_WAS:
            return None
        value = self._field.value(message)
        return (value,) if differ(self._value, value, self._tolerance) else None


def _above(graph: Graph, operator: str) -> set[str]:
    """The operator, and all that it depends on."""
    found, left = {operator}, [operator]
    while left:
        makers = {graph.streams[stream].node for stream in graph.nodes[left.pop()].taken} - found
        found |= makers
        left += makers
    return found
