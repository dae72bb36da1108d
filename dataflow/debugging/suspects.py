"""Lines that can have made a call other than recorded: those that differ from the recorded code, and that ran in it."""

from __future__ import annotations

import difflib
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType

from dataflow.debugging.debugger import Debugger
from dataflow.debugging.fired import Call, RepeatedCall
from dataflow.debugging.lines import Lines, homes_of, is_own
from dataflow.debugging.reduce import needed, smallest
from dataflow.execution.failure import OperatorFailure
from dataflow.graph.code import ReloadError, code_now, digest_of, other_texts, stored
from dataflow.graph.model import Node, OperatorImportError
from dataflow.operator import Operator, ParameterError, validate_parameters
from dataflow.recording import Recording
from dataflow.records.cuts import code_in
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import ReplayError

BEFORE = 8
"""Calls in front of the one that is looked at, in which its lines are looked for."""
MOST_TRIED = 32
"""Changes that are undone, one at a time."""
REVISIONS = 200
"""Commits of a file in which its recorded text is looked for."""
GIT_WITHIN = 30.0
"""Seconds after which the search of them is given up."""

Place = tuple[str, int]
"""A file, and the number of a line in it."""


@dataclass(frozen=True)
class Change:
    """Lines `first` to `last` of a file, which hold `here` and held `recorded`; `last` is before `first` where lines
    are missing in front of `first`. `ran`: one of them ran in the call. `mends`: without this change alone the call
    gives what was recorded; None where it was not tried, or cannot be without it. `together`: it is one of a smallest
    set without which the call gives what was recorded, where no change does alone."""

    module: str
    file: str
    first: int
    last: int
    here: str
    recorded: str
    ran: bool
    mends: bool | None = None
    together: bool = False


@dataclass(frozen=True)
class Suspects:
    """Holds what can have made a call other than recorded.

    `raised`: where its error was raised, the innermost line of the operator's source. `modules`: of each one that
    differs, where its recorded text was found; None where it was not. `changes`: those that mend the call, alone or
    together, first, then those that ran. `ran`: the lines that ran in the call; `alone`: those that ran in none of the
    `BEFORE` calls before.
    """

    number: int
    same: bool
    raised: Place | None
    modules: Mapping[str, str | None]
    changes: tuple[Change, ...]
    ran: frozenset[Place]
    alone: frozenset[Place]


def suspects(recording: Recording, debugger: Debugger, number: int) -> Suspects:
    """Makes a call, and those before it, by the line, then the call again without each change of the code since it was
    recorded. Raises as `Debugger.goto` does."""
    homes = homes_of(debugger.node.operator.__module__)
    ran: list[frozenset[Place]] = []
    for each in range(max(0, number - BEFORE), number + 1):
        places = set[Place]()

        def at_line(frame: FrameType, _: int, places: set[Place] = places) -> None:
            places.add((frame.f_code.co_filename, frame.f_lineno))

        fired = debugger.goto(each, Lines(at_line, homes).through, touched=lambda: False)
        ran.append(frozenset(places))
    modules, texts, changes = _changes(recording, debugger, fired.call, ran[-1])
    tried = _tried(changes, lambda undone: _mends(recording, debugger, fired, _without(undone, texts)))
    return Suspects(
        number=fired.number,
        same=fired.same,
        raised=_raised(fired, homes),
        modules=modules,
        changes=tuple(sorted(tried, key=lambda c: (not c.mends, not c.together, not c.ran))),
        ran=ran[-1],
        alone=ran[-1].difference(*ran[:-1]),
    )


def ranges(places: Iterable[Place]) -> dict[str, list[list[int]]]:
    """Returns places as the first and last lines of what follows one another, by file."""
    found: dict[str, list[list[int]]] = {}
    for file, line in sorted(places):
        spans = found.setdefault(file, [])
        if spans and spans[-1][1] + 1 == line:
            spans[-1][1] = line
        else:
            spans.append([line, line])
    return found


def _changes(
    recording: Recording, debugger: Debugger, call: Call, ran: frozenset[Place]
) -> tuple[dict[str, str | None], dict[str, list[str]], list[Change]]:
    """Returns where the recorded text of each module that differs was found, the lines here, and what differs."""
    then = recorded_code(recording, debugger.node.name, call)
    modules: dict[str, str | None] = {}
    texts: dict[str, list[str]] = {}
    changes: list[Change] = []
    for name, text in code_now(debugger.node.operator, then).texts.items():
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is None or name not in then or then[name] == digest_of(text):
            continue
        found = recorded_text(then[name], Path(file))
        modules[name] = None if found is None else found[1]
        if found is not None:
            texts[name] = text.decode().splitlines(keepends=True)
            changes += _differing(name, file, found[0].decode().splitlines(keepends=True), texts[name], ran)
    return modules, texts, changes


def recorded_code(recording: Recording, operator: str, call: Call | None = None) -> Mapping[str, str]:
    """Returns the digests of the code that made a call, or the last one, by module; empty where none is recorded."""
    found: Mapping[str, str] = {}
    for record in FiringLog.read(recording).records(operator):
        if call is not None and (record.incarnation, record.index) > (call.incarnation, call.record):
            break
        found = code_in(record) or found
    return found


def _differing(name: str, file: str, then: list[str], here: list[str], ran: frozenset[Place]) -> Iterator[Change]:
    for tag, i, j, first, last in difflib.SequenceMatcher(None, then, here, autojunk=False).get_opcodes():
        if tag != "equal":
            lines = range(first + 1, last + 1)
            touched = any((file, line) in ran for line in lines)
            yield Change(name, file, first + 1, last, "".join(here[first:last]), "".join(then[i:j]), touched)


def _tried(changes: list[Change], mends: Callable[[Sequence[Change]], bool | None]) -> list[Change]:
    """Returns the changes, those that ran first, with what the call gives without each; where it gives what was
    recorded without none of them alone, with the smallest set that is found."""
    ordered = sorted(changes, key=lambda each: not each.ran)
    found = [replace(each, mends=mends([each])) for each in ordered[:MOST_TRIED]] + ordered[MOST_TRIED:]
    if len(found) < 2 or any(each.mends for each in found):
        return found
    left = MOST_TRIED

    def shows(undone: Sequence[Change]) -> bool:
        nonlocal left
        left -= 1
        return left >= 0 and bool(undone) and mends(undone) is True

    if not shows(found):
        return found
    together = smallest(needed(found, shows), shows)
    return [replace(each, together=left >= 0 and each in together) for each in found]


def _without(undone: Iterable[Change], texts: Mapping[str, list[str]]) -> dict[str, bytes]:
    """Returns the texts of modules without some changes."""
    found = {change.module: list(texts[change.module]) for change in undone}
    for change in sorted(undone, key=lambda each: each.first, reverse=True):
        found[change.module][change.first - 1 : change.last] = [change.recorded]
    return {module: "".join(lines).encode() for module, lines in found.items()}


def _mends(recording: Recording, debugger: Debugger, fired: RepeatedCall, texts: Mapping[str, bytes]) -> bool | None:
    """Returns whether the call gives what was recorded with other texts of modules."""
    node, here = debugger.node, debugger.node.operator
    try:
        with other_texts(node, texts):
            nodes = {**debugger.graph.nodes, node.name: _with_defaults(node, here)}
            with closing(Debugger(recording, node.name, replace(debugger.graph, nodes=nodes))) as again:
                return again.goto(fired.number).same
    except (ParameterError, ReloadError, OperatorImportError, ReplayError, OperatorFailure):  # it cannot be made so
        return None


def _with_defaults(node: Node, before: type[Operator]) -> Node:
    """Returns a node with the defaults of its class as it is now where it has those of the class before."""
    fields = before.spec.parameters.model_fields
    needed = {name: value for name, value in node.params.items() if fields[name].is_required()}
    defaults = validate_parameters(before, needed).model_dump(mode="json")
    given = {name: value for name, value in node.params.items() if name in needed or value != defaults[name]}
    return replace(node, params=validate_parameters(node.operator, given).model_dump(mode="json"))


def _raised(fired: RepeatedCall, homes: tuple[Path, ...]) -> Place | None:
    if fired.raised is None:
        return None
    frames = traceback.extract_tb(fired.raised.__traceback__)
    own = [(f.filename, f.lineno) for f in frames if f.lineno is not None and is_own(f.filename, homes)]
    return own[-1] if own else None


def recorded_text(digest: str, file: Path) -> tuple[bytes, str] | None:
    """Returns the text with a digest, and where it was: the store of reloads, or a commit of the file; None where it
    is in neither. Of the file's commits the newest `REVISIONS` are looked at."""
    if (text := stored(digest)) is not None:
        return text, "a reload"
    deadline = time.monotonic() + GIT_WITHIN

    def git(*words: str) -> bytes:
        left = max(0.0, deadline - time.monotonic())
        command = ["git", "-C", str(file.parent), *words]
        return subprocess.run(command, capture_output=True, timeout=left, check=False).stdout

    try:
        for commit in git("log", f"-n{REVISIONS}", "--format=%H", "--", file.name).decode().split():
            shown = git("show", f"{commit}:./{file.name}")
            if digest_of(shown) == digest:
                return shown, f"commit {commit[:12]}"
    except (OSError, subprocess.TimeoutExpired):  # there is no git here, or it takes too long
        return None
    return None
