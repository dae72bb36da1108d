"""The chain of calls that decided a value: each with the inputs, and the state, that change it when they are others.

Nothing is guessed: a call is made again from its state with an input nudged, taken from the message before, or left
out; the messages that come out go through all later calls on the chain, to the value. An input that changes it is on
the chain, and the call that made it is looked into next, the latest first. Where several change it together alone, the
sensors' messages behind all of them are tried.
"""

from __future__ import annotations

import heapq
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any

from dataflow.blame.field import Field, differ, is_measured
from dataflow.blame.line import Call, Line
from dataflow.blame.links import Chain, Effect, Link, Way
from dataflow.blame.nudge import nudged
from dataflow.blame.repeated_calls import AS_IT_WAS, RAISED, Effects, Other, Place, Slot, place_of, with_messages
from dataflow.blame.split import split
from dataflow.blame.substitutes import ANOTHER, SubstituteMessages, TakenMessage, without
from dataflow.execution.feeds.playable import span_of
from dataflow.execution.threads import limited_threads
from dataflow.graph.model import Graph
from dataflow.graph.reach import upstream
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import ReplayError, graph_that_is_here
from dataflow.sync import Entry, Firing, InputValue
from dataflow.sync.entries import entries_of

TOLERANCE = 1e-4
"""Of floating-point values: a hundredth of the size of a nudge."""
SECONDS = 60.0
MOST_BYTES = 2**31
"""Of the inputs of all calls that are held: beyond it no others are read."""
HISTORY = 0.5
"""Of the time that is left, what the earlier calls of one operator may take."""
FURTHER = 3
"""Blocks of earlier calls that are tried behind the first new operator that gives the same value, where that is no
floating-point number: the same truth value, or the same class, may come of another state."""


class BlameError(ReplayError):
    """Raised for a value whose origin cannot be found; the message has the reason."""


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
        above = {name: {name} | upstream(self.graph, [name]) for name in self.graph.nodes}
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
        self._joint: list[list[TakenMessage]] = []
        """Messages of which none changes the value alone, though all of them together do."""
        self._messages = SubstituteMessages(recording, self._taken)
        self._raised = ""
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
        looked_into = sorted(self._seen - set(chain.left), key=self._age)
        chain.loose += [call for call in chain.loose_of(looked_into) if call not in chain.loose]
        chain.links.sort(key=lambda link: (*(-each for each in chain.weight(link)), -link.stamp, self._age(link.call)))
        chain.seconds = time.monotonic() - began
        return chain

    # ------------------------------------------------------------------------------------------------- the target

    def _target(self) -> Chain:
        stream = self._stream(self._field.stream)
        origin, end = span_of(self._recording, self._recording.streams) or (0, 0)
        until = origin + round(self._field.seconds * 1e9)
        maker = self.graph.streams[stream].node
        node = self.graph.nodes[maker]
        if node.source or node.external:
            raise BlameError(f"{stream} is what {maker} gave, {'a source' if node.source else 'which is external'}")
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
        return Chain(target, (stream, record.incarnation, emission.seq), emission.stamp, value, until > end)

    def _stream(self, name: str) -> str:
        streams = {stream: stream for stream in self.graph.streams} | dict(self.graph.aliases)
        if name in streams:
            return streams[name]
        known = [each for each in streams if each.endswith(f"/{name}")]
        if len(found := {streams[each] for each in known}) != 1:
            what = "is several streams" if found else "is no stream"
            raise BlameError(f"{name!r} {what}; there are: {', '.join(known or streams)}")
        return found.pop()

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
        for joint in self._joint:
            try:
                self._look_behind(joint)
            except _OutOfTime:
                self._chain.left.append(joint[0].call)
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
            with self._noting(call, call.number, name):
                found = list(self._deciding(call, shot.firing, slots))
            self._link_all(call, shot.firing, found)
            if slots and not found:
                without.append(slots)
        if len(without) > 1:
            self._link_all(call, shot.firing, list(self._tied(call, shot.firing, without)))
        if not line.stateless:
            self._look_back(call)

    @contextmanager
    def _noting(self, call: Call, last: int, name: str) -> Iterator[None]:
        """Notes an input, or with `name` "" the calls up to `last`, where a call raised with all that was tried."""
        tried, raised = self._chain.tried.total(), self._chain.raised.total()
        yield
        tried, raised = self._chain.tried.total() - tried, self._chain.raised.total() - raised
        if tried and raised == tried:
            self._chain.was_raised(call, last, name, self._raised)

    def _link_all(self, call: Call, firing: Firing, found: Sequence[tuple[Slot, tuple[Effect, ...]]]) -> None:
        """Makes links; one for messages of a stream that follow each other, and decide only together."""
        stamp = self._lines[call.operator].records[call.number].stamp
        joint: dict[int, list[TakenMessage]] = defaultdict(list)
        links = self._chain.links
        for (name, k), effects in found:
            entry = entries_of(firing.inputs[name])[k]
            maker, place = self._maker(entry), place_of(entry)
            alone = any(effect.together == 1 for effect in effects)
            before = links[-1] if links else None
            if before is not None and not alone and _goes_on(before, TakenMessage(call, name, entry), effects):
                links[-1] = replace(before, last=place[2])
            else:
                links.append(Link(call, stamp, name, place, entry.stamp, maker, effects))
            if not alone:
                joint[id(effects)].append(TakenMessage(call, name, entry))
            elif maker is not None:
                self._queue(maker)
        self._joint += joint.values()

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
        return self._shown(((way, {call: other}) for way, other in self._others(call, firing, slots)), len(slots))

    def _shown(self, tries: Iterator[tuple[Way, Mapping[Call, Other]]], together: int) -> tuple[Effect, ...]:
        """The effects of what is tried, one for each way."""
        effects: dict[Way, Effect] = {}
        for way, others in tries:
            if way in effects or (way == "made finite" and "nudged" in effects):
                continue
            if (found := self._changed(way, others)) is not None:
                effects[way] = Effect(way, (), found[0], together)
        return tuple(effects.values())

    def _effects(self, call: Call, firing: Firing, slot: Slot) -> Iterator[Effect]:
        effects = self._together(call, firing, [slot])
        for effect in effects:
            yield replace(effect, fields=self._fields(call, firing, slot)) if effect.way == "nudged" else effect
        entry = entries_of(firing.inputs[slot[0]])[slot[1]]
        for message in () if effects else self._messages.elsewhere(call, slot[0], entry):
            if (found := self._changed("another", {call: with_messages(firing, {slot: message})})) is not None:
                yield Effect("another", (), found[0])
                return

    def _fields(self, call: Call, firing: Firing, slot: Slot) -> tuple[str, ...]:
        """The fields of a message that change the value when they are nudged by themselves."""
        name, k = slot
        entry = entries_of(firing.inputs[name])[k]
        grouped = self._messages.groups(TakenMessage(call, name, entry))
        if sum(map(len, grouped)) < 2:
            return tuple(each for names in grouped for each in names)
        found: list[str] = []
        for names in grouped:
            for each in () if found else names:
                others = [nudged(entry.value, (each,), sign=sign) for sign in (1, -1)]
                tries = ({call: with_messages(firing, {slot: other})} for other, fields in others if fields)
                if any(self._changed("nudged", other) is not None for other in tries):
                    found.append(each)
        return tuple(found)

    def _others(
        self, call: Call, firing: Firing, slots: Sequence[Slot]
    ) -> Iterator[tuple[Way, Mapping[str, InputValue]]]:
        """Yields the inputs with these messages nudged, taken from the message before, left out."""
        taken = [TakenMessage(call, name, entries_of(firing.inputs[name])[k]) for name, k in slots]
        for way, messages in self._messages.instead(taken, hold=False):
            yield way, with_messages(firing, dict(zip(slots, messages, strict=True)))
        lacking = without(self.graph.nodes[call.operator], firing, slots)
        if lacking is not None:
            yield "left out", lacking

    def _taken(self, call: Call, name: str, stream: str) -> list[Message]:
        """What calls before took of a stream in an input."""
        first = max(0, call.number - ANOTHER)
        self._reach(Call(call.operator, first), max(call.number, self._last.get(call.operator, -1)))
        shots = self._lines[call.operator].shots
        given = [shots[n].firing.inputs.get(name) for n in range(first, call.number) if n in shots]
        return [entry.value for each in given for entry in entries_of(each) if entry.stream == stream]

    # ------------------------------------------------------------------------------------------------- the state

    def _look_back(self, call: Call) -> None:
        """Finds the earlier calls of an operator that left their mark in its state: the latest ones first, in blocks of
        1, 1, 2, 4, 8... calls, back to where the calls before are forgotten (`_is_forgotten`)."""
        operator, line = call.operator, self._line(call.operator)
        first = line.begin_of(call.number)
        end = min(call.number, self._searched.get(operator, call.number))
        size = 1 if end == call.number else end - self._goes_back_to(operator, first, end)
        if end > first and not size:
            return
        deadline, agreed, found = self._deadline, 0, False
        self._deadline = min(deadline, time.monotonic() + HISTORY * (deadline - time.monotonic()))
        try:
            while end > first:
                begin = max(first, end - size)
                self._reach(Call(operator, begin), self._last[operator])
                found |= self._link_marks(call, begin, end)
                if not found and end < call.number:  # these calls do again what the ones before have done
                    found = self._link_marks(call, begin, call.number)
                self._searched[operator] = begin
                back = self._goes_back_to(operator, first, begin)
                if begin > first and back == begin:
                    agreed += 1
                    if self._is_forgotten(call, begin, agreed, found=found):
                        self._chain.ended[operator] = min(begin, self._chain.ended.get(operator, begin))
                        break
                    back = begin - 1
                size, end = max(size, call.number - begin, begin - back), begin
            else:
                self._look_at_beginning(Call(operator, first))
        except _OutOfTime:
            self._chain.unsplit.append((operator, first, end - 1))
        finally:
            self._deadline = deadline

    def _link_marks(self, call: Call, begin: int, end: int) -> bool:
        """Makes links to those calls from `begin` to before `end` that decide by what they leave in the state; returns
        whether there are any."""
        line, operator = self._line(call.operator), call.operator
        stamp, links = line.records[call.number].stamp, len(self._chain.links)
        with self._noting(Call(operator, begin), end - 1, ""):
            there = [n for n in range(begin, end) if n in line.shots]
            cancels = not isinstance(self._value, Message) and not is_measured(self._value)
            marks = list(split(there, lambda n: self._mark(operator, n), cancels=cancels))
        for numbers, effects in marks:
            maker, last = Call(operator, numbers[0]), numbers[-1] if len(numbers) > 1 else None
            self._chain.links.append(Link(call, stamp, "", None, 0, maker, effects, last))
            if last is None:
                self._queue(maker)
            else:
                self._joint.append([taken for number in numbers for taken in self._given(Call(operator, number))])
        return len(self._chain.links) > links

    def _mark(self, operator: str, numbers: Sequence[int]) -> tuple[Effect, ...]:
        """The effects of some calls that are others together; of several, one effect."""
        line = self._line(operator)

        def tries() -> Iterator[tuple[Way, Mapping[Call, Other]]]:
            yield "call left out", {Call(operator, n): None for n in numbers}
            taken = {n: self._given(Call(operator, n)) for n in numbers}
            for way, messages in self._messages.instead([each for n in numbers for each in taken[n]], hold=True):
                left, others = iter(messages), dict[Call, Other]()
                for n in numbers:
                    firing = line.shots[n].firing
                    sizes = {name: len(entries_of(given)) for name, given in firing.inputs.items()}
                    slots = [(name, k) for name, size in sizes.items() for k in range(size)]
                    others[Call(operator, n)] = with_messages(firing, {slot: next(left) for slot in slots})
                yield way, others

        if len(numbers) == 1:
            return self._shown(tries(), 1)
        for each in tries():
            if effects := self._shown(iter([each]), len(numbers)):
                return effects
        return ()

    def _given(self, call: Call) -> list[TakenMessage]:
        """The messages of a call whose inputs are held, in the order of its inputs."""
        inputs = self._lines[call.operator].shots[call.number].firing.inputs
        return [TakenMessage(call, name, entry) for name, given in inputs.items() for entry in entries_of(given)]

    def _goes_back_to(self, operator: str, first: int, begin: int) -> int:
        """The call down to which at least the search for marks goes on before `begin`: that itself where it may end.

        A new operator gives the same value where the calls before are forgotten, and where one of them has brought the
        state back to that of a new one: then the search goes back to that call.
        """
        if begin <= first or self._value_with("a new operator", {}, anew=Call(operator, begin)) is not _SAME:
            return begin - 1
        line = self._line(operator)
        if not line.is_as_new(begin):
            return begin
        self._reach(Call(operator, first), self._last[operator])
        returned = line.returned_by(begin)
        return begin if returned is None else returned

    def _is_forgotten(self, call: Call, begin: int, agreed: int, *, found: bool) -> bool:
        """Returns whether the calls before `begin` do not count, where a new operator gives the same value for the
        `agreed`th time.

        They may count where the calls from there on do again what they have done: then one of these without the other
        does not change the value. A truth value may be the same by chance, if the state is another.
        """
        operator = call.operator
        if not found:
            again: dict[Call, Other] = {Call(operator, n): None for n in range(begin, call.number)}
            if self._changed("call left out", again, anew=Call(operator, begin)) is not None:
                return False
        if isinstance(self._value, Message) or is_measured(self._value) or agreed > FURTHER:
            return True
        return self._line(operator).has_forgotten(begin, call.number)

    def _look_at_beginning(self, first: Call) -> None:
        """Names the state that an operator was given before its first call, where that decides."""
        line = self._lines[first.operator]
        if not line.begins_with_state(first.number) or any(
            link.call == first and not link.input and link.maker is None for link in self._chain.links
        ):
            return
        if (found := self._changed("a new operator", {}, anew=first)) is None:
            return
        effects = (Effect("a new operator", (), found[0]),)
        self._chain.links.append(Link(first, line.records[first.number].stamp, "", None, 0, None, effects))
        if first.number:
            self._chain.unsplit.append((first.operator, 0, first.number - 1))

    # ------------------------------------------------------------------------------------------ what is in common

    def _look_behind(self, joint: Sequence[TakenMessage]) -> None:
        """Finds the sensors' messages behind some that decide only together: those that decide alone, through all of
        them; else the smallest run of one stream; else of several streams."""
        by_stream: dict[tuple[str, int], list[TakenMessage]] = defaultdict(list)
        for each in sorted(self._sensed_behind(joint), key=lambda each: place_of(each.entry)):
            by_stream[place_of(each.entry)[:2]].append(each)
        runs = [run for taken in by_stream.values() for run in split(taken, self._sensed)]
        if not runs and len(by_stream) > 1 and (effects := self._sensed([t for ts in by_stream.values() for t in ts])):
            left = dict(by_stream)
            for stream in by_stream:
                rest = [each for other in left if other != stream for each in left[other]]
                if rest and (fewer := self._sensed(rest)):
                    effects = fewer
                    del left[stream]
            runs = [(taken, effects) for taken in left.values()]
        runs = runs or [run for taken in by_stream.values() for run in self._elsewhere(taken)]
        for taken, effects in runs:
            call, name, entry = taken[0]
            place, last = place_of(entry), taken[-1].entry.seq if len(taken) > 1 else None
            if any(link.message == place and link.maker is None for link in self._chain.links):
                continue
            stamp = self._lines[call.operator].records[call.number].stamp
            self._chain.links.append(Link(call, stamp, name, place, entry.stamp, None, effects, last))
        if not runs:
            makers = (self._maker(each.entry) for each in joint)
            self._chain.loose += [maker for maker in makers if maker is not None][:1]

    def _sensed_behind(self, joint: Sequence[TakenMessage]) -> list[TakenMessage]:
        """Returns the messages at the beginning of all that some come from, with the calls that took them; the inputs
        of the calls between are held then."""
        sensed: dict[Place, TakenMessage] = {}
        makers: dict[str, set[int]] = defaultdict(set)
        done: set[str] = set()
        left = list(joint)
        while left:
            for each in left:
                if (maker := self._maker(each.entry)) is None:
                    sensed.setdefault(place_of(each.entry), each)
                else:
                    makers[maker.operator].add(maker.number)
            ready = [operator for operator in makers if operator not in done]
            if not ready:
                break
            operator = max(ready, key=self._rank.__getitem__)
            done.add(operator)
            calls = [Call(operator, number) for number in self._behind(operator, makers[operator])]
            left = [taken for call in calls for taken in self._given(call)]
        return [*sensed.values()]

    def _behind(self, operator: str, numbers: set[int]) -> Sequence[int]:
        """The calls that some calls of an operator come from: with a state, those before that are not forgotten."""
        line, first, last = self._line(operator), min(numbers), max(numbers)
        self._last[operator] = last = max(last, self._last.get(operator, -1))
        self._reach(Call(operator, first), last)
        if line.stateless:
            return sorted(number for number in numbers if number in line.shots)
        begin, size = line.begin_of(last), last + 1 - first
        while first > begin and self._changed("a new operator", {}, anew=Call(operator, first)) is not None:
            first, size = max(begin, first - size), 2 * size
            self._reach(Call(operator, first), last)
        return [number for number in range(first, last + 1) if number in line.shots]

    def _sensed(self, taken: Sequence[TakenMessage]) -> tuple[Effect, ...]:
        """The effects of sensors' messages that are others for all calls that take them; of several, one."""
        effects: dict[Way, Effect] = {}
        for way, messages in self._messages.instead(taken, hold=True):
            others = {place_of(each.entry): message for each, message in zip(taken, messages, strict=True)}
            if way not in effects and (found := self._changed(way, {}, messages=others)) is not None:
                effects[way] = Effect(way, (), found[0], len(taken))
                if len(taken) > 1:
                    break
        return tuple(effects.values())

    def _elsewhere(self, taken: Sequence[TakenMessage]) -> Iterator[tuple[Sequence[TakenMessage], tuple[Effect, ...]]]:
        """Yields those of some sensors' messages that decide when they are others of their stream for all calls that
        take them, each another one: an operator may know one that comes twice, such as a picture of a hanging camera.
        """
        there = {place_of(each.entry): list(self._messages.elsewhere(*each)) for each in taken}
        for k in range(ANOTHER if all(there.values()) else 0):
            chosen = {place: others[(k + n) % len(others)] for n, (place, others) in enumerate(there.items())}

            def shows(part: Sequence[TakenMessage], chosen: Mapping[Place, Message] = chosen) -> tuple[Effect, ...]:
                messages = {place: chosen[place] for place in (place_of(each.entry) for each in part)}
                found = self._changed("another", {}, messages=messages)
                return () if found is None else (Effect("another", (), found[0], len(part)),)

            if shows(taken):
                yield from split(taken, shows)
                return

    # ------------------------------------------------------------------------------------------------- the effect

    def _changed(
        self,
        way: Way,
        others: Mapping[Call, Other],
        anew: Call | None = None,
        messages: Mapping[Place, Message] | None = None,
    ) -> tuple[Any] | None:
        """Makes the calls again with other inputs, or `anew` by an operator that is new, or with other messages of
        sensors, and all later ones on the chain that these reach; returns the value if it changed."""
        value = self._value_with(way, others, anew, messages)
        return None if value is _SAME or value is RAISED else (value,)

    def _value_with(
        self,
        way: Way,
        others: Mapping[Call, Other],
        anew: Call | None = None,
        messages: Mapping[Place, Message] | None = None,
    ) -> Any:
        """As `_changed`; `_SAME` where it does not, `RAISED` where a call raises."""
        run = Effects(self._lines, self._takers, self._last, self._age)
        message = run.through(others, anew, self._chain.target, self._port, messages)
        self._chain.tried[way] += 1
        if message is RAISED:
            self._raised = run.raised
            self._chain.raised[run.raised] += 1
            return RAISED
        if message is AS_IT_WAS:
            return _SAME
        value = self._field.value(message)
        return value if differ(self._value, value, self._tolerance) else _SAME


_SAME: Any = object()


def _goes_on(link: Link, taken: TakenMessage, effects: tuple[Effect, ...]) -> bool:
    """Returns whether a message follows that of a link, with which it decides together."""
    same = link.effects is effects and (link.call, link.input) == (taken.call, taken.input)
    stream, incarnation, number = place_of(taken.entry)
    return same and (stream, incarnation, number - 1) == link.messages[-1]
