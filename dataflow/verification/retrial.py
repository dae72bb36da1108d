"""Tries culprits again as the recorded run had them: what ran in a process apart is re-executed apart.

Operators of one process share modules, settings of libraries and the memory of messages. A worker puts operators
together that may never have shared a process, so no operator is a culprit for what it makes there alone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dataflow.records.comparison import Verification
from dataflow.supervision.core.report import RunFailed

Answer = Mapping[str, Any]
"""The answer of `job.verify_part`."""
First = tuple[int, int, str]
"""A first difference: incarnation, index of the record, what was made."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Operators to be re-executed in one process to their end, or until each of those `asked` has differed otherwise
    than first at the place, and by the result, that is given for it (None: than not at all).

    `wired`: as in the run, they are called in its order, and given what they make, not what was recorded of it.
    """

    operators: frozenset[str]
    asked: Mapping[str, First | None] = field(default_factory=dict)
    wired: bool = False


Try = Callable[[Sequence[Trial]], Sequence[Answer]]


@dataclass(frozen=True, slots=True)
class Retrial:
    """The outcome for culprits that were tried again.

    `repeated`: whether both times they made the same, to the end, in the process that they had. `instead` are the
    answers that count for operators rather than those of the first trial. `shared` names, by operator that makes what
    was recorded, those that share its process where it does not, or where alone it does. `wrote`: the messages that
    operators wrote into, by operator. `overwritten`: which, of its process, wrote into what an operator was given up to
    its first difference, by operator: what it had was not what was recorded.
    """

    repeated: dict[str, bool] = field(default_factory=dict)
    instead: dict[str, Answer] = field(default_factory=dict)
    shared: dict[str, tuple[str, ...]] = field(default_factory=dict)
    wrote: dict[str, str] = field(default_factory=dict)
    overwritten: dict[str, str] = field(default_factory=dict)

    def enter(self, found: Verification) -> None:
        """Enters what was found of an operator's own writing, and of another's, into what the first trial found."""
        found.wrote = found.wrote or self.wrote.get(found.operator, "")
        found.own_fault &= found.operator not in self.overwritten


def retry(
    culprits: Iterable[str], of: Mapping[str, Answer], mates: Mapping[str, frozenset[str]], attempt: Try
) -> Retrial:
    """Tries `culprits` again. `of`: the answer by which each is one; `mates`: the operators of its recorded process."""
    outcome = Retrial()
    first = {name: _first(of[name], name) for name in culprits}
    told = _try(outcome, _grouped(first, mates), attempt)
    outcome.repeated.update({name: _alike(answer, of[name], name) for name, answer in told.items()})
    differ = [name for name, answer in told.items() if _first(answer, name) is not None and len(mates[name]) > 1]
    _acquit_in_company(outcome, differ, of, mates, attempt)
    apart = {name: told[name] for name, alike in outcome.repeated.items() if not alike}
    others = {n: a for n, a in apart.items() if of[n]["operators"].keys() != a["operators"].keys()}
    _acquit_apart(outcome, {n: a for n, a in others.items() if _first(a, n) is None}, of, attempt)
    _confirm(outcome, {n: a for n, a in others.items() if _first(a, n) is not None}, mates, attempt)
    _acquit_overwritten(outcome, told, of)
    return outcome


def _acquit_apart(outcome: Retrial, suspects: Mapping[str, Answer], of: Mapping[str, Answer], attempt: Try) -> None:
    """Acquits operators that make what was recorded in the process that they had, if beside those of the first trial
    they differ again, and alike."""
    first = {name: _first(of[name], name) for name in suspects}
    beside = _grouped(first, {name: frozenset(of[name]["operators"]) for name in suspects})
    for name, answer in _try(outcome, beside, attempt).items():
        if _alike(answer, of[name], name):
            del outcome.repeated[name]
            outcome.instead[name] = suspects[name]
            outcome.shared[name] = _others(of[name], suspects[name]) or _others(suspects[name], of[name])


def _acquit_in_company(
    outcome: Retrial,
    suspects: Iterable[str],
    of: Mapping[str, Answer],
    mates: Mapping[str, frozenset[str]],
    attempt: Try,
) -> None:
    """Acquits operators that had company if they make what was recorded alone, or as they were called in the run."""
    for name in suspects:
        for trial in Trial(frozenset({name}), {name: None}), Trial(mates[name], {name: None}, wired=True):
            try:
                answer = _try(outcome, [trial], attempt)[name]
            except RunFailed as failure:
                if failure.interrupted:
                    raise
                continue  # it needs the company that it had
            found = Verification.from_wire(answer["operators"][name])
            if found.first is None and found.tainted is None and found.whole:
                del outcome.repeated[name]
                outcome.instead[name] = answer
                outcome.shared[name] = _others(of[name], answer) or tuple(sorted(mates[name] - {name}))
                break


def _confirm(
    outcome: Retrial, suspects: Mapping[str, Answer], mates: Mapping[str, frozenset[str]], attempt: Try
) -> None:
    """Takes the differences of operators in the process that they had for theirs, if they differ alike once more."""
    trials = [Trial(operators) for operators in dict.fromkeys(mates[name] for name in suspects)]
    for trial, answer in zip(trials, attempt(trials) if trials else (), strict=True):
        for name in trial.operators & suspects.keys():
            if _alike(answer, suspects[name], name):
                outcome.repeated[name] = True
                outcome.instead[name] = answer


def _acquit_overwritten(outcome: Retrial, told: Mapping[str, Answer], of: Mapping[str, Answer]) -> None:
    """Acquits those that were given what an operator of the process that they had has written into by then."""
    for name in [name for name in outcome.repeated if name not in outcome.wrote]:
        writer, since = told[name]["reached"].get(name, ("", 0))
        if writer and since <= of[name]["operators"][name]["first"]["stamp"]:
            del outcome.repeated[name]
            outcome.overwritten[name] = writer


def _grouped(first: Mapping[str, First | None], mates: Mapping[str, frozenset[str]]) -> list[Trial]:
    """One trial for all that share a process. `first`: how each differed first."""
    groups: dict[frozenset[str], dict[str, First | None]] = {}
    for name, found in first.items():
        groups.setdefault(mates[name], {})[name] = found
    return [Trial(operators, asked) for operators, asked in groups.items()]


def _try(outcome: Retrial, trials: Sequence[Trial], attempt: Try) -> dict[str, Answer]:
    """The answer for each operator that is asked for."""
    told: dict[str, Answer] = {}
    for trial, answer in zip(trials, attempt(trials) if trials else (), strict=True):
        outcome.wrote.update((name, found["wrote"]) for name, found in answer["operators"].items() if found["wrote"])
        told |= dict.fromkeys(trial.asked, answer)
    return told


def _others(answer: Answer, than: Answer) -> tuple[str, ...]:
    """Returns the operators of an answer that are not in another one."""
    return tuple(name for name in answer["operators"] if name not in than["operators"])


def _alike(answer: Answer, other: Answer, name: str) -> bool:
    """Returns whether an operator made the same twice: the same first difference, and the same to the end."""
    return _first(answer, name) == _first(other, name) and _made(answer, name) == _made(other, name)


def _first(answer: Answer, name: str) -> First | None:
    """The first difference of an operator in an answer; None where there is none."""
    first = answer["operators"][name]["first"]
    return None if first is None else (first["incarnation"], first["index"], first["got"])


def _made(answer: Answer, name: str) -> Any:
    """All that an operator made otherwise than recorded, in an answer: how much, its digest, and the calls of them."""
    values = answer["operators"][name]
    return [values[key] for key in ("verified", "differing", "states", "differences")]


def mates_of(placed: Mapping[str, str], operators: Collection[str]) -> dict[str, frozenset[str]]:
    """By operator, those of `operators` that shared its process, itself included. `placed`: their processes' labels;
    one of which that is not known was alone."""
    return {
        name: frozenset({name, *(o for o in operators if name in placed and placed.get(o) == placed[name])})
        for name in operators
    }
