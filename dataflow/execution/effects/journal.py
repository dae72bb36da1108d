"""The journal of an operator's effects: makes calls and keeps their answers, or gives recorded ones again."""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dataflow.execution.effects.answers import Answer, Call, EffectMiss, Key
from dataflow.execution.effects.captured_values import texts_around
from dataflow.recording.limits import MAX_EFFECT_BYTES

EFFECTS = "effects"
"""The key of a record's detail: the number of the firing's first call, and of each call its function, the digests of
its arguments, whether it raised, and its packed answer."""
GIVEN, MISSED, AGAIN, SAME = "given", "missed", "again", "same"
"""Counts of a re-execution: recorded answers that were given, misses, calls made again, equal answers of these."""
_ENGINE = Path(__file__).parents[2]


class Journal:
    """Makes the effects of an operator. `made` holds those of the firing that is under way, for its record; `asked`
    counts calls since the beginning of the firing."""

    def __init__(self) -> None:
        self.made: list[list[Any]] = []
        self.asked = 0
        self.missed: EffectMiss | None = None
        self._before = 0
        self._moving = defaultdict[str, set[str]](set)

    def ask(self, call: Call, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Returns the answer in the form that is recorded. Raises what the call raises, and `EffectError`."""
        key = Key.of(call, args, kwargs)
        # What the call changes is in no key, but for the texts with which it begins, such as a conversation's.
        texts = set() if key.function in self._moving else texts_around(call)
        self.asked += 1
        left = MAX_EFFECT_BYTES - sum(len(data) for *_, data in self.made)
        answer = Answer.of(key.name, call, args, kwargs, left)
        moving = self._moving[key.function]
        moving |= key.moved(call)
        key = key.without(moving - texts)
        self.made.append([key.function, dict(key.arguments), answer.raised, answer.data])
        return answer.value()

    def take(self) -> dict[str, Any]:
        """The detail of the firing's record, empty where there was no call. The next firing begins."""
        made, self.made, self.asked = self.made, [], 0
        first, self._before = self._before, self._before + len(made)
        return {EFFECTS: [first, made]} if made else {}


class RecordedJournal(Journal):
    """Gives recorded answers. With `make`, calls are made again and compared, and a miss gets the new answer. `counts`:
    by name of a call and what was done."""

    def __init__(self, *, make: bool = False) -> None:
        super().__init__()
        self.counts: Counter[tuple[str, str]] = Counter()
        self._make = make
        self._left: list[tuple[Key, Answer]] = []

    def begin(self, detail: Mapping[str, Any]) -> None:
        """Begins a firing; `detail` is that of its record."""
        self.missed, self.asked = None, 0
        self._before, made = detail.get(EFFECTS, (0, ()))
        self._left = [(Key(function, arguments), Answer(raised, data)) for function, arguments, raised, data in made]

    def summary(self) -> dict[str, dict[str, int]]:
        """The counts by name of a call."""
        names = dict.fromkeys(name for name, _ in self.counts)
        return {name: {what: self.counts[name, what] for what in (GIVEN, MISSED, AGAIN, SAME)} for name in names}

    def ask(self, call: Call, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        key = Key.of(call, args, kwargs)
        self.asked += 1
        left = enumerate(self._left)
        found = next((n for n, (it, _) in left if it.function == key.function and not key.missing(it)), None)
        if found is None:
            return self._miss(key, call, args, kwargs)
        _, answer = self._left.pop(found)
        self.counts[key.name, GIVEN] += 1
        if self._make:
            self.counts[key.name, AGAIN] += 1
            self.counts[key.name, SAME] += Answer.of(key.name, call, args, kwargs, MAX_EFFECT_BYTES) == answer
        return answer.value()

    def _miss(self, key: Key, call: Call, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        self.counts[key.name, MISSED] += 1
        if self._make:
            return Answer.of(key.name, call, args, kwargs, MAX_EFFECT_BYTES).value()
        why = key.differing([recorded for recorded, _ in self._left])
        number = self._before + self.asked - 1
        self.missed = EffectMiss(f"miss at effect {number} ({_caller()}), {key.name}: {why}")
        raise self.missed


def _caller() -> str:
    """File and line of the operator's code that asked."""
    frame = sys._getframe()
    while frame.f_back is not None and _ENGINE in Path(frame.f_code.co_filename).parents:
        frame = frame.f_back
    return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
