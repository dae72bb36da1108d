"""Finds the smallest calls of an operator that still show what is wrong in a recorded one."""

from __future__ import annotations

import bisect
import re
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from dataflow.capture.captured import BEFORE, CapturedCall, CapturedCalls, Change, OperatorSettings, Outcome, Predicate
from dataflow.capture.repeats import NotRepeated, check_repeats
from dataflow.debugging.debugger import DebugError, Debugger
from dataflow.debugging.fired import RepeatedCall
from dataflow.debugging.reduce import shortest_end, smallest
from dataflow.execution.failure import place_of, readable
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.records.cuts import is_known, parameters_at
from dataflow.records.firing import CALLS, WITHHELD, FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import seeding_of
from dataflow.state import StateError
from dataflow.sync.entries import entries_of
from dataflow.text import visible

SECONDS = 60.0
"""Time to reduce the calls from one beginning; there are at most three."""
SMALL = 100
"""Of so many calls, one is few: of the beginnings that are right, the first from which no more are needed is taken."""
LARGE = 1_000_000
"""Bytes of a test that lies beside others under version control."""
SLOW = 60.0
"""Seconds that its calls take: what is larger or slower begins with a state that may be wrong, if that is smaller."""
MOST_CALLS = 20_000
"""Calls whose inputs are held in memory to be reduced."""
MOST_BYTES = 2**29
"""Of these inputs."""


@dataclass(frozen=True, slots=True)
class CaptureResult:
    """A captured call, with the number of it, of the operator's calls, of those that are left, and what it begins with.

    `wrong`: what is shown, in words.
    """

    captured: CapturedCalls
    number: int
    calls: int
    left: int
    begins: str
    wrong: str


class FaultCondition:
    """The fault of a call: an expression is true of it, it raises an error (the class and line count), or its outputs
    are not the recorded ones."""

    def __init__(self, fired: RepeatedCall, predicate: str) -> None:
        self.predicate = Predicate(predicate) if predicate else None
        self.error, self.digests = None, None
        if predicate:
            self.text = predicate
        elif fired.error is not None and fired.raised is not None:
            self.error, self.text = _sort(fired.raised), fired.error.strip().splitlines()[-1]
        else:
            self.digests = {made.port: made.here.digest() for made in fired.made if made.here is not None}
            self.text = f"differs in {', '.join(made.port for made in fired.made if not made.same) or 'its error'}"

    def shows(self, outcome: Outcome) -> bool:
        """Returns whether the last of some calls is wrong in the same way."""
        if outcome.broken:
            return False
        if self.predicate is not None:
            return self.predicate.is_true(outcome.names())
        if self.error is not None:
            return outcome.error is not None and _sort(outcome.error) == self.error
        return outcome.error is None and outcome.digests == self.digests


class StartState(NamedTuple):
    """A state (None: a new operator), the number of the first call behind it, and the place in the operator's records
    up to which parameters were changed before. `text`: in words."""

    state: bytes | None
    first: int
    place: tuple[int, int]
    text: str
    doubtful: bool = False
    """The state may be wrong already: the mended operator, too, may be wrong behind it."""


class SmallestCapture(NamedTuple):
    """The fewest calls that were found so far, and what they begin with."""

    captured: CapturedCalls
    begins: str


def _sort(error: BaseException) -> tuple[type, str, int]:
    return (type(error), *place_of(error.__traceback__))


def capture(
    recording: Recording, debugger: Debugger, number: int | None = None, predicate: str = "", seconds: float = SECONDS
) -> CaptureResult:
    """Captures the call of that number, by default the first that does not give what was recorded, or for which
    `predicate` is true.

    Raises `DebugError` where there is nothing wrong with it, where it cannot be shown apart from the recording, or does
    not give the same each time; SyntaxError for a predicate that is no expression.
    """
    fired = _aimed(debugger, number, predicate)
    wrong = FaultCondition(fired, predicate)
    expected = None if wrong.digests is None else _recorded(fired)
    recorded_error = "" if wrong.error is not None else fired.recorded_error or ""
    setting = _setting(recording, debugger)
    ordered = FiringLog.read(recording).ordered(debugger.node)
    records = [r for r in ordered if r.kind not in CALLS and r.outcome != "error"]
    best: SmallestCapture | None = None
    too_large = False
    for begin in _beginnings(records, debugger, fired, wrong):
        if best is not None and _suffices(best, begin, len(debugger.calls)):
            break
        changes = changes_between(records, debugger, begin.place, fired.number)
        if (shots := _shots(debugger, begin.first, fired, changes)) is None:
            too_large = True
            continue
        parameters = parameters_at(r for r in records if (r.incarnation, r.index) <= begin.place)
        found = CapturedCalls(setting, *parameters, begin.state, tuple(shots), expected, recorded_error, predicate)
        reduced = _reduced(found, wrong, time.monotonic() + seconds)
        if reduced is not None and (best is None or len(reduced.shots) < len(best.captured.shots)):
            best = SmallestCapture(reduced, begin.text)
    if best is None and too_large:
        raise DebugError(
            f"call {fired.number} of {debugger.node.name}: the inputs up to it are more than {MOST_BYTES:,} bytes: "
            "record states (record: {snapshots: 1s}), to begin nearer to it"
        )
    if best is None:
        raise DebugError(
            f"call {fired.number} of {debugger.node.name} is not wrong when it is made apart from its recording: what "
            f"it depends on is neither among its inputs nor in its state, or it does not repeat (dataflow verify "
            f"{recording.path} --only {debugger.node.name} --why finds out)"
        )
    try:
        check_repeats(best.captured)
    except NotRepeated as error:
        raise DebugError(
            f"call {fired.number} of {debugger.node.name} does not repeat: {error}. A test of it would pass and fail "
            f"by chance: dataflow verify {recording.path} --why finds the cause"
        ) from None
    return CaptureResult(
        best.captured, fired.number, len(debugger.calls), len(best.captured.shots), best.begins, wrong.text
    )


def _aimed(debugger: Debugger, number: int | None, predicate: str) -> RepeatedCall:
    name = debugger.node.name
    true = Predicate(predicate) if predicate else None
    if number is not None:
        fired = debugger.goto(number)
        wrong = not fired.same or fired.error is not None if true is None else true.is_true(fired.names())
        if not wrong:
            what = "as recorded, no error" if true is None else f"it is not so: {predicate}{_raised(true)}"
            raise DebugError(f"call {fired.number} of {name}: {what}")
        return fired
    if true is not None:
        found = debugger.until(lambda fired: true.is_true(fired.names()))
    else:
        found = debugger.until(lambda fired: not fired.same or (fired.error is not None and not fired.injected))
    if found is None:
        what = "as recorded, without an error" if true is None else f"none for which {predicate}{_raised(true)}"
        if (unmade := debugger.unmade) is not None:
            raise DebugError(f"{name}: {len(debugger.calls) - unmade.count} calls {what}; {unmade}")
        raise DebugError(f"{name} has {len(debugger.calls)} calls: {'all ' * (true is None)}{what}")
    return found


def _raised(predicate: Predicate) -> str:
    return "" if predicate.problem is None else f", which raises {readable(predicate.problem)}"


def _recorded(fired: RepeatedCall) -> dict[str, Message]:
    """The recorded messages of a call, by port. Raises `DebugError` where one is not in the recording."""
    made = [made for made in fired.made if made.recorded is not None]
    if len(made) != sum(emission is not None for emission in fired.record.outputs):
        raise DebugError(
            f"call {fired.number}: what it made then is not recorded, so what is right is not known (record its "
            "stream, or dataflow replay --complete)"
        )
    return {each.port: each.recorded for each in made if each.recorded is not None}


def _setting(recording: Recording, debugger: Debugger) -> OperatorSettings:
    node, graph = debugger.node, debugger.graph
    known = graph.seed, seeding_of(recording), graph.threads
    return OperatorSettings(node.name, node.use, dict(node.params), *known, dict(node.outputs), node.env)


def _beginnings(
    records: Sequence[FiringRecord], debugger: Debugger, fired: RepeatedCall, wrong: FaultCondition
) -> Iterator[StartState]:
    """Where the calls may begin, the surest first.

    The state of a new operator is right, and so is a recorded one where the recorded outputs are. The state that the
    operator has here just before the call may be wrong already.
    """
    number, incarnation = fired.number, fired.call.incarnation
    here = (incarnation, fired.call.record)
    if debugger.node.operator.stateless:
        yield StartState(None, number, here, "nothing, as it is stateless")
        return
    first = next(k for k, call in enumerate(debugger.calls) if call.incarnation == incarnation)
    before = [r for r in records if r.incarnation == incarnation and r.index < fired.call.record]
    known = [r for r in before if is_known(r)]
    if known and wrong.digests is not None:
        index = known[-1].index
        after = next(k for k in range(first, number + 1) if debugger.calls[k].record > index)
        yield StartState(known[-1].detail["state"], after, (incarnation, index), "the recorded state")
    if number - first < MOST_CALLS:
        begun = [r.index for r in before if r.kind in ("setup", "cut") and r.index < debugger.calls[first].record]
        yield StartState(None, first, (incarnation, max(begun, default=-1)), "a new operator")
    if fired.before is not None:
        text = "the state that it has here before the call, which may be wrong already"
        yield StartState(fired.before, number, here, text, doubtful=True)


def _suffices(best: SmallestCapture, begin: StartState, calls: int) -> bool:
    """Returns whether it is needless to begin there, too. A state that may be wrong is begun with only where the calls
    from a right one are too many for a test."""
    if not begin.doubtful:
        return len(best.captured.shots) <= max(1, calls // SMALL)
    if len(best.captured.to_bytes()) > LARGE:
        return False
    began = time.monotonic()
    best.captured.play()
    return time.monotonic() - began < SLOW


def changes_between(
    records: Sequence[FiringRecord], debugger: Debugger, begin: tuple[int, int], last: int
) -> Mapping[int, Sequence[Change]]:
    """The changes behind a place in the records (incarnation, number), up to the call `last`; by the number of the call
    before which they were made."""
    changes: dict[int, list[Change]] = defaultdict(list)
    for r in records:
        place = r.incarnation, r.index
        if r.kind in ("param", "reset") and begin < place:
            number = bisect.bisect_left(debugger.calls, place, key=lambda call: (call.incarnation, call.record))
            if number <= last:
                name = r.detail["name" if r.kind == "param" else "input"]
                changes[number].append(Change(r.kind, name, r.detail.get("value"), (r.incarnation, r.stamp)))
    return changes


def _shots(
    debugger: Debugger, first: int, fired: RepeatedCall, changes: Mapping[int, Sequence[Change]]
) -> Sequence[CapturedCall] | None:
    """The calls from `first` to that of `fired`; None where their inputs are more than `MOST_BYTES`."""
    shots: list[CapturedCall] = []
    held: set[bytes] = set()
    nbytes = 0
    pending: list[Change] = []

    def take(each: RepeatedCall) -> bool:
        nonlocal nbytes
        if each.number >= first:
            pending.extend(changes.get(each.number, ()))
        if each.number >= first and each.firing is not None:
            shots.append(shot_of(debugger, each, tuple(pending)))
            pending.clear()
            entries = [entry for given in each.firing.inputs.values() for entry in entries_of(given)]
            new = {entry.digest: entry.value for entry in entries if entry.digest not in held}
            held.update(new)
            nbytes += sum(message.nbytes() for message in new.values())
        return each.number >= fired.number or nbytes > MOST_BYTES

    if not take(debugger.goto(first)):
        debugger.until(take)
    return shots if nbytes <= MOST_BYTES else None


def shot_of(debugger: Debugger, fired: RepeatedCall, changes: tuple[Change, ...]) -> CapturedCall:
    """Returns a call of the debugger, with the changes before it, as one that can be made apart from it."""
    record, firing = fired.record, fired.firing
    assert firing is not None
    effects = {name: value for name, value in record.detail.items() if name == "effects"}
    emitted = zip(debugger.node.outputs, record.outputs, strict=False)
    recorded = {port: e.digest for port, e in emitted if e is not None and e.seq != WITHHELD}
    here = {made.port: made.here.digest() for made in fired.made if made.here is not None}
    return CapturedCall(firing, effects, recorded, changes, here)


def _reduced(whole: CapturedCalls, wrong: FaultCondition, deadline: float) -> CapturedCalls | None:
    """The smallest part of the calls that is wrong in the same way; None where all of them are not.

    Calls that right code needs for what was recorded must stay: behind a state all do, and behind a new operator the
    latest ones, so many that those before the wrong one make what was recorded. All of them must make what they make in
    the debugger: else they depend on something that is not captured, and right code may not make what was recorded.
    """
    if not whole.shots:
        return None
    try:
        outcome = whole.play()
    except StateError:  # of another version of the class
        return None
    here = [shot.here for shot in whole.shots[:-1][-BEFORE:]]
    if not wrong.shows(outcome) or (wrong.digests is not None and list(outcome.before) != here):
        return None
    *earlier, last = range(len(whole.shots))

    def shows(numbers: Sequence[int]) -> bool:
        if time.monotonic() > deadline:
            return False
        part = _part(whole, (*numbers, last))
        outcome = part.play()
        return wrong.shows(outcome) and (wrong.digests is None or _as_recorded(outcome, part.shots[:-1]))

    left: Sequence[int]
    if wrong.digests is None:
        left = smallest(shortest_end(earlier, shows), shows)
    elif whole.state is None:
        left = shortest_end(earlier, shows)
        while len(left) < len(earlier) and shows(left[1:]):
            left = left[1:]
    else:
        left = earlier
    return _fewer_messages(_part(whole, (*left, last)), wrong, deadline)


def _part(whole: CapturedCalls, numbers: Sequence[int]) -> CapturedCalls:
    """Of the calls those of these numbers; changes before the others are made before the next of them."""
    shots: list[CapturedCall] = []
    after = 0
    for number in numbers:
        changes = tuple(change for shot in whole.shots[after : number + 1] for change in shot.changes)
        shots.append(whole.shots[number]._replace(changes=changes))
        after = number + 1
    return replace(whole, shots=tuple(shots))


def _as_recorded(outcome: Outcome, earlier: Sequence[CapturedCall]) -> bool:
    """Returns whether the calls just before the last one made what was recorded."""
    recorded = [shot.digests for shot in earlier[-BEFORE:]]
    return len(recorded) == BEFORE and list(outcome.before) == recorded


def _fewer_messages(captured: CapturedCalls, wrong: FaultCondition, deadline: float) -> CapturedCalls:
    """Without the messages of the last call's `Batch` inputs that an error or a predicate does not need."""
    if wrong.digests is not None:
        return captured
    for name, given in captured.shots[-1].firing.inputs.items():
        if isinstance(given, tuple) and given:
            whole = captured

            def shows(entries: Sequence[Any], whole: CapturedCalls = whole, name: str = name) -> bool:
                tried = _with(whole, name, entries)
                return time.monotonic() < deadline and wrong.shows(tried.play())

            captured = _with(whole, name, smallest(given, shows))
    return captured


def _with(captured: CapturedCalls, name: str, entries: Sequence[Any]) -> CapturedCalls:
    """With other messages in an input of the last call."""
    *earlier, last = captured.shots
    firing = replace(last.firing, inputs={**last.firing.inputs, name: tuple(entries)})
    return replace(captured, shots=(*earlier, last._replace(firing=firing)))


def write_test(found: CaptureResult, path: Path, recording: str, command: str) -> int:
    """Writes the test to `path` and what it needs beside it (`.capture`); returns the bytes of that file."""
    data = found.captured.to_bytes()
    path.with_suffix(".capture").write_bytes(data)
    name = re.sub(r"[^a-zA-Z0-9_]", "_", f"{found.captured.setting.name}_{found.number}")
    text = TEST.format(
        what=visible(f"{found.captured.setting.name}, call {found.number} of {recording}: {found.wrong}"),
        command=visible(command),
        left=found.left,
        calls=found.calls,
        begins=found.begins,
        name=name,
    )
    path.write_text(text, encoding="utf-8")
    return len(data)


TEST = '''"""A captured call: fails until the operator is mended."""

# {what}
#
# Captured by `{command}`:
# {left} of {calls} calls, begun with {begins}.

from pathlib import Path

from dataflow.capture.captured import check


def test_{name}() -> None:
    check(Path(__file__).with_suffix(".capture"))
'''
