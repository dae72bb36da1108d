"""Judges what a fix has changed: calls of the mended operator, and other operators, by their verification.

A fix edits the operator's modules, which others may share, or its parameters. An operator whose code, parameters and
files are the recorded ones is none that it has changed: where that does not repeat, it did not before the fix either.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from sys import modules
from typing import TYPE_CHECKING

from dataflow.debugging.debugger import Debugger
from dataflow.debugging.fired import RepeatedCall
from dataflow.debugging.suspects import recorded_code, recorded_text
from dataflow.environments import EnvError
from dataflow.execution.failure import OperatorFailure, readable
from dataflow.graph.code import ReloadError, other_texts
from dataflow.graph.model import Graph, OperatorImportError
from dataflow.graph.reach import downstream
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import ReplayError, graph_that_is_here

if TYPE_CHECKING:
    from dataflow.records.comparison import Verification
    from dataflow.verification.report import VerifyReport

EQUAL = ("use", "params", "inputs", "env")
"""Of a node in the graph, what its results depend on."""


@dataclass
class OtherOperators:
    """The operators besides the mended one, and what that is given. `reasons`: why the fix is not proven, by operator;
    `unrepeated`: those that do not repeat with the code that was recorded either, and why that is known."""

    reasons: dict[str, str] = field(default_factory=dict)
    unrepeated: dict[str, str] = field(default_factory=dict)


@dataclass
class Changes:
    """The calls of the mended operator that do not give what was recorded, by number; `refused`: those that may not
    change; `raised`: those that raise an error that is not the recorded one, and must not, with it."""

    changed: list[int] = field(default_factory=list)
    refused: list[int] = field(default_factory=list)
    raised: list[tuple[int, str]] = field(default_factory=list)


def changes_of(
    debugger: Debugger, may: Callable[[RepeatedCall], bool], may_raise: Callable[[RepeatedCall], bool]
) -> Changes:
    """Makes all calls of an operator. `may` and `may_raise` say of one that differs whether that is allowed."""
    found = Changes()

    def visit(each: RepeatedCall) -> bool:
        if not each.same:
            found.changed.append(each.number)
            if each.raised is not None and not may_raise(each):
                found.raised.append((each.number, readable(each.raised)))
            elif not may(each):
                found.refused.append(each.number)
        return False

    debugger.until(visit, first=0)
    return found


def unmade(verification: Verification) -> str:
    """Returns which calls of an operator could not be repeated; empty where all were."""
    count = verification.unverifiable + verification.lost_records + verification.unknown
    if not count:
        return ""
    why = "records before them are missing" if verification.lost_records else "their state is not known"
    if verification.missing:
        why = f"{verification.missing} is not recorded"
    return f"{count:,} of {verification.firings:,} calls could not be made again ({why})"


def judge(recording: Recording, report: VerifyReport, graph: Graph, mended: str) -> OtherOperators:
    """Judges a verification of all operators with a fix, in the code or the graph, of the one that is `mended`."""
    recorded = graph_that_is_here(recording)[0]
    others = OtherOperators(dict.fromkeys(report.absent, "not re-executed"))
    following = list[str]()
    for v in report.operators:
        name = v.operator
        if name == mended:
            if v.tainted is not None and name not in downstream(graph, {name}):
                others.reasons[name] = "is given other messages than recorded, which are made again"
        elif told := unmade(v):
            others.reasons[name] = told
        elif (verdict := report.verdict(v)) == "downstream":
            following.append(name)
        elif verdict == "culprit" and v.first is not None and not v.wrote:
            _judge_culprit(others, recording, report, recorded, graph, v)
        elif verdict != "identical":
            others.reasons[name] = verdict
    behind = downstream(graph, {mended, *others.unrepeated})
    others.reasons |= {name: "downstream" for name in following if name not in behind}
    return others


def _judge_culprit(
    others: OtherOperators, recording: Recording, report: VerifyReport, recorded: Graph, graph: Graph, v: Verification
) -> None:
    """Judges an operator that differs although it was given what was recorded."""
    how = {False: "differs each time", True: "differs alike each time", None: "differs"}[report.repeats(v.operator)]
    touched = _touched(recording, recorded, graph, v)
    if not touched and (how == "differs each time" or report.facts):
        machine = ", ".join(f"{fact} {then} -> {now}" for fact, then, now in report.facts[:3])
        by = "" if how == "differs each time" else f", on another machine than the recorded one ({machine})"
        others.unrepeated[v.operator] = f"{how} with the code that was recorded{by}"
        return
    before = _differs_as_recorded(recording, recorded, v) if v.code_changed else None
    baseline = {None: "", True: "; with the recorded code too", False: "; not with the recorded code"}[before]
    others.reasons[v.operator] = (
        f"culprit: {how} ({'; '.join(touched) or 'nothing that the recording holds of it has changed'}){baseline}"
    )


def _touched(recording: Recording, recorded: Graph, graph: Graph, v: Verification) -> list[str]:
    """Returns what of an operator a fix may have changed, in words."""
    was, now = recorded.nodes.get(v.operator), graph.nodes[v.operator]
    code = recorded_code(recording, v.operator)
    other = [name for name in EQUAL if was is None or getattr(was, name) != getattr(now, name)]
    changed = {
        "code changed": v.code_changed,
        "files changed": v.files_changed,
        "packages changed": v.packages_changed,
        "in the graph changed": other,
        "no recorded code of": [] if now.operator.__module__ in code else [now.operator.__module__],
    }
    return [f"{what}: {', '.join(names)}" for what, names in changed.items() if names]


def _differs_as_recorded(recording: Recording, graph: Graph, v: Verification) -> bool | None:
    """Returns whether an operator differs with the code that was recorded, too; None where that is not found, or does
    not run."""
    then, node = recorded_code(recording, v.operator), graph.nodes[v.operator]
    texts = dict[str, bytes]()
    for name in v.code_changed:
        file = getattr(modules.get(name), "__file__", None)
        found = None if file is None or name not in then else recorded_text(then[name], Path(file))
        if found is None:
            return None
        texts[name] = found[0]
    try:
        with other_texts(node, texts), closing(Debugger(recording, v.operator, graph)) as debugger:
            return debugger.first_difference() is not None
    except (EnvError, ReloadError, OperatorImportError, ReplayError, OperatorFailure):
        return None
