"""Finds the smallest calls of an operator that still show what is wrong in a recorded one."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import CodeType
from typing import Any

from dataflow.capture.captured import BEFORE, Captured, Outcome, Setting, Shot
from dataflow.capture.reduce import shortest_end, smallest
from dataflow.debugging.debugger import DebugError, Debugger
from dataflow.debugging.fired import Fired
from dataflow.execution.failure import place_of
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.records.cuts import is_known
from dataflow.records.firing import WITHHELD
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import seeding_of

SECONDS = 60.0
"""Time to reduce the calls from one beginning; there are at most three."""
SMALL = 100
"""Of so many calls, one is few: the first beginning from which no more are needed is taken."""
MOST_CALLS = 20_000
"""Calls whose inputs are held in memory to be reduced."""


@dataclass(frozen=True, slots=True)
class Found:
    """A captured call, with the number of it, of the operator's calls, of those that are left, and what it begins with.

    `wrong`: what is shown, in words.
    """

    captured: Captured
    number: int
    calls: int
    left: int
    begins: str
    wrong: str


class Wrong:
    """The fault of a call: an expression is true of it, it raises an error (the class and line count), or its outputs
    are not the recorded ones."""

    def __init__(self, fired: Fired, predicate: str) -> None:
        self.predicate, self.error, self.digests = predicate, None, None
        if predicate:
            self._code = compile(predicate, "<predicate>", "eval")
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
        if self.predicate:
            return _true(self._code, outcome.names())
        if self.error is not None:
            return outcome.error is not None and _sort(outcome.error) == self.error
        return outcome.error is None and outcome.digests == self.digests


def _true(code: CodeType, names: dict[str, Any]) -> bool:
    """Whether an expression is true; one that raises is not."""
    try:
        return bool(eval(code, names))
    except Exception:
        return False


def _sort(error: BaseException) -> tuple[type, str, int]:
    return (type(error), *place_of(error.__traceback__))


def capture(
    recording: Recording, debugger: Debugger, number: int | None = None, predicate: str = "", seconds: float = SECONDS
) -> Found:
    """Captures the call of that number, by default the first that does not give what was recorded, or for which
    `predicate` is true.

    Raises `DebugError` where there is nothing wrong with it, or where it cannot be shown apart from the recording;
    SyntaxError for a predicate that is no expression.
    """
    fired = _aimed(debugger, number, predicate)
    wrong = Wrong(fired, predicate)
    expected, recorded_error = None, ""
    if wrong.digests is not None:
        recorded_error = fired.recorded_error or ""
        expected = _recorded(fired)
    setting = _setting(recording, debugger, fired)
    best: tuple[Captured, str] | None = None
    few = max(1, len(debugger.calls) // SMALL)
    for state, first, begins in _beginnings(recording, debugger, fired, wrong):
        shots = _shots(debugger, first, fired)
        found = Captured(setting, state, tuple(shots), expected, recorded_error, predicate)
        reduced = _reduced(found, wrong, time.monotonic() + seconds)
        if reduced is not None and (best is None or len(reduced.shots) < len(best[0].shots)):
            best = reduced, begins
        if best is not None and len(best[0].shots) <= few:
            break
    if best is None:
        raise DebugError(
            f"call {fired.number} of {debugger.node.name} is not wrong when it is made apart from its recording: what "
            "it depends on is neither among its inputs nor in its state (dataflow verify --why)"
        )
    captured, begins = best
    return Found(captured, fired.number, len(debugger.calls), len(captured.shots), begins, wrong.text)


def _aimed(debugger: Debugger, number: int | None, predicate: str) -> Fired:
    name = debugger.node.name
    if number is not None:
        fired = debugger.goto(number)
        wrong = _true(compile(predicate, "<predicate>", "eval"), fired.names()) if predicate else not fired.same
        if not (wrong or (fired.error is not None and not predicate)):
            raise DebugError(f"call {number} of {name}: {'not ' + predicate if predicate else 'as recorded, no error'}")
        return fired
    if predicate:
        code = compile(predicate, "<predicate>", "eval")
        found = debugger.until(lambda fired: _true(code, fired.names()))
    else:
        found = debugger.until(lambda fired: not fired.same or (fired.error is not None and not fired.injected))
    if found is None:
        what = f"none for which {predicate}" if predicate else "all as recorded, without an error"
        raise DebugError(f"{name} has {len(debugger.calls)} calls: {what}")
    return found


def _recorded(fired: Fired) -> dict[str, Message]:
    """The recorded messages of a call, by port. Raises `DebugError` where one is not in the recording."""
    made = [made for made in fired.made if made.recorded is not None]
    if len(made) != sum(emission is not None for emission in fired.record.outputs):
        raise DebugError(
            f"call {fired.number}: what it made then is not recorded, so what is right is not known (record its "
            "stream, or dataflow replay --complete)"
        )
    return {each.port: each.recorded for each in made if each.recorded is not None}


def _setting(recording: Recording, debugger: Debugger, fired: Fired) -> Setting:
    node = debugger.node
    return Setting(
        node.name,
        node.use,
        dict(node.params),
        dict(fired.parameters),
        debugger.graph.seed,
        seeding_of(recording),
        debugger.graph.threads,
        dict(node.outputs),
    )


def _beginnings(
    recording: Recording, debugger: Debugger, fired: Fired, wrong: Wrong
) -> Iterator[tuple[bytes | None, int, str]]:
    """States and the first calls behind them, the surest first.

    The state of a new operator is right, and so is a recorded one where the recorded outputs are. The state that the
    operator has here just before the call may be wrong already.
    """
    number = fired.number
    if debugger.node.operator.stateless:
        yield None, number, "nothing, as it is stateless"
        return
    incarnation = fired.call.incarnation
    first = next(k for k, call in enumerate(debugger.calls) if call.incarnation == incarnation)
    known = None
    if wrong.digests is not None:
        for record in FiringLog.read(recording).ordered(debugger.node):
            if is_known(record) and record.incarnation == incarnation and record.index < fired.call.record:
                known = record
    if known is not None:
        after = next(k for k in range(first, number + 1) if debugger.calls[k].record > known.index)
        yield known.detail["state"], after, "the recorded state"
    if number - first < MOST_CALLS:
        yield None, first, "a new operator"
    if fired.before is not None:
        yield fired.before, number, "the state that it has here before the call, which may be wrong already"


def _shots(debugger: Debugger, first: int, fired: Fired) -> list[Shot]:
    """The calls from `first` to that of `fired`."""
    shots: list[Shot] = []

    def take(each: Fired) -> bool:
        if each.number >= first and each.firing is not None:
            shots.append(_shot(debugger, each))
        return each.number >= fired.number

    if not take(debugger.goto(first)):
        debugger.until(take)
    return shots


def _shot(debugger: Debugger, fired: Fired) -> Shot:
    record, firing = fired.record, fired.firing
    assert firing is not None
    effects = {name: value for name, value in record.detail.items() if name == "effects"}
    emitted = zip(debugger.node.outputs, record.outputs, strict=False)
    return Shot(firing, effects, {port: e.digest for port, e in emitted if e is not None and e.seq != WITHHELD})


def _reduced(whole: Captured, wrong: Wrong, deadline: float) -> Captured | None:
    """The smallest part of the calls that is wrong in the same way; None where all of them are not.

    Calls that right code needs for what was recorded must stay: behind a state all do, and behind a new operator the
    latest ones, so many that those before the wrong one make what was recorded.
    """
    if not whole.shots or not wrong.shows(whole.play()):
        return None
    *earlier, last = whole.shots

    def shows(shots: Sequence[Shot]) -> bool:
        if time.monotonic() > deadline:
            return False
        outcome = replace(whole, shots=(*shots, last)).play()
        return wrong.shows(outcome) and (wrong.digests is None or _as_recorded(outcome, shots))

    if wrong.digests is None:
        left = smallest(shortest_end(earlier, shows), shows)
    elif whole.state is None:
        left = shortest_end(earlier, shows)
        while len(left) < len(earlier) and shows(left[1:]):
            left = left[1:]
    else:
        left = earlier
    return _fewer_messages(replace(whole, shots=(*left, last)), wrong, deadline)


def _as_recorded(outcome: Outcome, earlier: Sequence[Shot]) -> bool:
    """Returns whether the calls just before the last one made what was recorded."""
    recorded = [shot.digests for shot in earlier[-BEFORE:]]
    return len(recorded) == BEFORE and list(outcome.before) == recorded


def _fewer_messages(captured: Captured, wrong: Wrong, deadline: float) -> Captured:
    """Without the messages of the last call's `Batch` inputs that an error or a predicate does not need."""
    if wrong.digests is not None:
        return captured
    for name, given in captured.shots[-1].firing.inputs.items():
        if isinstance(given, tuple) and given:
            whole = captured

            def shows(entries: Sequence[Any], whole: Captured = whole, name: str = name) -> bool:
                tried = _with(whole, name, entries)
                return time.monotonic() < deadline and wrong.shows(tried.play())

            captured = _with(whole, name, smallest(given, shows))
    return captured


def _with(captured: Captured, name: str, entries: Sequence[Any]) -> Captured:
    """With other messages in an input of the last call."""
    *earlier, last = captured.shots
    firing = replace(last.firing, inputs={**last.firing.inputs, name: tuple(entries)})
    return replace(captured, shots=(*earlier, last._replace(firing=firing)))


def write_test(found: Found, path: Path, recording: str, command: str) -> int:
    """Writes the test to `path` and what it needs beside it (`.capture`); returns the bytes of that file."""
    data = found.captured.to_bytes()
    path.with_suffix(".capture").write_bytes(data)
    name = re.sub(r"\W", "_", f"{found.captured.setting.name}_{found.number}")
    text = TEST.format(
        what=f"{found.captured.setting.name}, call {found.number} of {recording}: {found.wrong}",
        command=command,
        left=found.left,
        calls=found.calls,
        begins=found.begins,
        name=name,
    )
    path.write_text(text, encoding="utf-8")
    return len(data)


TEST = '''"""{what}

Captured by `{command}`:
{left} of {calls} calls, begun with {begins}. Fails until the operator is mended.
"""

from pathlib import Path

from dataflow.capture.captured import check


def test_{name}() -> None:
    check(Path(__file__).with_suffix(".capture"))
'''
