"""The regression gate: many recordings verified, each judged against itself or against an accepted baseline."""

from __future__ import annotations

import json
import os
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from dataflow.graph.model import Graph
from dataflow.recording import Recording, RecordingError
from dataflow.recording.streams.part_folder import parts_in
from dataflow.records.comparison import Verification
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.supervision.core.report import RunFailed
from dataflow.verification.errors import WRONG_INPUT
from dataflow.verification.report import VerifyReport

FORMAT = 2

OperatorVerdict = Literal[
    "identical",
    "within tolerance",
    "accepted",
    "culprit",
    "downstream",
    "not as accepted",
    "changed",
    "unverifiable",
    "not here",
]
RecordingVerdict = Literal[
    "identical",
    "identical up to the cut",
    "within tolerance",
    "accepted",
    "different",
    "not wholly verified",
    "nothing verified",
    "could not run",
]
PASSES = ("identical", "identical up to the cut", "within tolerance", "accepted")
"""The verdicts with which the gate lets pass."""

Outcome = Mapping[str, Any]
"""The outcome of an operator that differs: digests of its streams, how much differs, and the first difference."""


class BaselineError(ValueError):
    """Raised when a baseline file cannot be read; the message names the reason."""


@dataclass(frozen=True, slots=True)
class Judged:
    """One operator of one recording, measured by what is expected of it: the recording, or the accepted outcome.

    Sources and other stand-ins are judged only where their records and their stored messages do not agree.
    `firm`: every call was repeated, and neither it nor what it depends on differed again when run a second time. Only
    that can be accepted.
    """

    operator: str
    verdict: OperatorVerdict
    outcome: Outcome | None = None
    firm: bool = True

    @property
    def passed(self) -> bool:
        return self.verdict in PASSES


@dataclass(frozen=True, slots=True)
class Checked:
    """One recording: its report and the verdicts, or why there is none. `wall`: seconds in all.

    `runs`: how often it was verified, of which only the last one may not have passed.
    `internal`: `details` is a traceback of the runtime's own code. `not_in_graph`: recorded operators that the graph
    lacks.
    """

    path: Path
    name: str
    report: VerifyReport | None
    judged: tuple[Judged, ...] = ()
    error: str = ""
    details: str = ""
    wall: float = 0.0
    internal: bool = False
    not_in_graph: tuple[str, ...] = ()
    runs: int = 1

    @property
    def unseen(self) -> float | None:
        """The largest share of runs that may differ although none of these did, at 95 % confidence; None where one did.

        (1 - share) ** runs = 0.05: the exact binomial bound.
        """
        return 1 - 0.05 ** (1 / self.runs) if self.passed else None

    @property
    def verdict(self) -> RecordingVerdict:
        found = {j.verdict for j in self.judged}
        if self.report is None:
            return "could not run"
        if found & {"culprit", "downstream", "not as accepted", "changed"}:
            return "different"
        if self.report.empty:
            return "nothing verified"
        if found & {"unverifiable", "not here"}:
            return "not wholly verified"
        if "accepted" in found:
            return "accepted"
        if "within tolerance" in found:
            return "within tolerance"
        return "identical up to the cut" if self.report.cut else "identical"

    @property
    def passed(self) -> bool:
        return self.verdict in PASSES

    @property
    def culprits(self) -> tuple[str, ...]:
        """The operators to look at."""
        return tuple(j.operator for j in self.judged if j.verdict in ("culprit", "not as accepted"))

    @property
    def changed(self) -> tuple[str, ...]:
        """The first of the stored messages that are not what was recorded, by stream and number."""
        found = () if self.report is None else self.report.changed
        return tuple(f"{s.stream} #{s.first_changed[1]}" for s in found if s.first_changed is not None)

    def as_json(self) -> dict[str, Any]:
        value = {"recording": self.name, "verdict": self.verdict, "passed": self.passed, "total_wall_s": self.wall}
        if self.report is None:
            return value | {"error": self.error}
        report = self.report.as_json()
        verdicts = {j.operator: j.verdict for j in self.judged}
        for node in [*report["operators"], *report["sources"]]:
            node["verdict"] = verdicts.get(node["operator"], "identical")
        more = {"culprits": list(self.culprits), "changed": list(self.changed), "not_in_graph": list(self.not_in_graph)}
        return value | report | more | {"runs": self.runs, "unseen": self.unseen}


@dataclass(slots=True)
class Baseline:
    """The outcomes that were accepted although they are not what was recorded: recording → operator → outcome.

    Recordings go by their path from the baseline file's folder, so the file can be kept beside them under version
    control and used from anywhere.
    """

    file: Path
    accepted: dict[str, dict[str, Outcome]] = field(default_factory=dict)

    @staticmethod
    def load(file: Path) -> Baseline:
        """Raises `BaselineError`, `OSError`. A file that does not exist accepts nothing."""
        if not file.exists():
            return Baseline(file)
        try:
            value = json.loads(file.read_text(encoding="utf-8"))
            if value["format"] != FORMAT:
                raise BaselineError(f"{file}: a baseline of format {value['format']!r}; this version reads {FORMAT}")
            accepted = {str(name): dict(operators) for name, operators in value["accepted"].items()}
        except BaselineError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise BaselineError(
                f"{file} is not a baseline: {type(error).__name__}: {error}; `dataflow verify ... --accept` writes one"
            ) from error
        return Baseline(file, accepted)

    def save(self) -> None:
        text = json.dumps({"format": FORMAT, "accepted": self.accepted}, indent=2, sort_keys=True, ensure_ascii=False)
        self.file.parent.mkdir(parents=True, exist_ok=True)
        part = self.file.with_name(f"{self.file.name}.part")
        part.write_text(text + "\n", encoding="utf-8")
        part.replace(self.file)

    def name_of(self, recording: Path) -> str:
        return Path(os.path.relpath(recording.resolve(), self.file.parent.resolve())).as_posix()

    def of(self, recording: Path) -> Mapping[str, Outcome]:
        return self.accepted.get(self.name_of(recording), {})

    def accept(self, checked: Checked) -> tuple[list[str], list[str]]:
        """Takes over what a recording came to. (operators accepted anew or otherwise, operators that cannot be)."""
        outcomes = {j.operator: j.outcome for j in checked.judged if j.outcome is not None and j.firm}
        refused = [
            j.operator
            for j in checked.judged
            if not j.firm and (j.outcome is not None or j.verdict in ("unverifiable", "culprit"))
        ]
        before = self.of(checked.path)
        changed = [name for name in {**before, **outcomes} if before.get(name) != outcomes.get(name)]
        name = self.name_of(checked.path)
        if outcomes:
            self.accepted[name] = outcomes
        else:
            self.accepted.pop(name, None)
        return sorted(changed), refused

    def unused(self, checked: Iterable[Checked]) -> list[str]:
        """Recordings that the baseline names and that were not among those verified."""
        return sorted(self.accepted.keys() - {self.name_of(c.path) for c in checked})


def recordings_in(targets: Sequence[Path]) -> list[tuple[Path, str]]:
    """Files and folders of the parts of a recording, as they are; of other folders all of these in them, at any depth:
    (path, name to show).

    Raises `ReplayError` for what is not there, and for a folder that holds no recording.
    """
    found: dict[Path, str] = {}
    for target in targets:
        if target.is_dir() and parts_in(target):
            found.setdefault(target, target.name)
        elif target.is_dir():
            inside = sorted(p for p in target.rglob("*.mcap") if p.is_file())
            folders = {folder for folder in {p.parent for p in inside} if _holds_parts(folder)}
            inside = sorted({p.parent if p.parent in folders else p for p in inside})
            if not inside:
                raise ReplayError(f"folder {target} holds no recording (no .mcap file, at any depth)")
            found |= {path: path.relative_to(target).as_posix() for path in inside if path not in found}
        elif target.exists():
            found.setdefault(target, target.name)
        else:
            raise ReplayError(f"no file or folder {target}")
    names = Counter(found.values())
    return [(path, name if names[name] == 1 else str(path)) for path, name in found.items()]


def _holds_parts(folder: Path) -> bool:
    try:
        return bool(parts_in(folder))
    except RecordingError:  # one is missing: opening it gives the error, and keeps no other recording from its verdict
        return True


def check(
    path: Path,
    name: str,
    verify: Callable[[Path], VerifyReport],
    accepted: Mapping[str, Outcome] | None = None,
    graph: Graph | None = None,
    runs: int = 1,
) -> Checked:
    """Verifies one recording and judges it; whatever prevents that becomes its `error`.

    `graph`: the one that it is verified against, where that is not the recorded one. `runs`: how often, until it does
    not pass.

    Raises only `RunFailed` for a run that was interrupted.
    """
    checked = _check_once(path, name, verify, accepted, graph)
    while checked.passed and checked.runs < runs:
        checked = replace(_check_once(path, name, verify, accepted, graph), runs=checked.runs + 1)
    return checked


def _check_once(
    path: Path,
    name: str,
    verify: Callable[[Path], VerifyReport],
    accepted: Mapping[str, Outcome] | None,
    graph: Graph | None,
) -> Checked:
    started = time.monotonic()

    def could_not(error: str, details: str = "", *, internal: bool = False) -> Checked:
        return Checked(path, name, None, (), error, details, time.monotonic() - started, internal)

    try:
        report = verify(path)
    except RunFailed as failure:
        if failure.interrupted:
            raise
        return could_not(str(failure), failure.details, internal=failure.internal)
    except WRONG_INPUT as error:
        return could_not(str(error).strip())
    except Exception as error:  # a fault of this program's in one file must not keep the others from being looked at
        return could_not(f"{type(error).__name__}: {error}", traceback.format_exc(), internal=True)
    missing = () if graph is None else recorded_but_not_in(graph, path)
    judged = judge(report, accepted or {})
    return Checked(path, name, report, judged, wall=time.monotonic() - started, not_in_graph=missing)


def recorded_but_not_in(graph: Graph, path: Path) -> tuple[str, ...]:
    """The operators with firing records in a recording that a graph does not have."""
    with Recording(path) as recording:
        return tuple(name for name in recording.firing_batches() if name not in graph.nodes)


def judge(report: VerifyReport, accepted: Mapping[str, Outcome]) -> tuple[Judged, ...]:
    """The verdict on each operator, given what has been accepted, and on each source whose books are not in order.

    The first row that applies, where *here* is what the operator made, *led astray* that it depends on one that differs
    from what is accepted for it, and *whole* that every call was repeated:

    | here | accepted | | verdict |
    | --- | --- | --- | --- |
    | as recorded, or within tolerance | another outcome | whole | not as accepted |
    | as recorded, or within tolerance | anything | not whole | unverifiable |
    | as recorded | | a stored message differs from its record | changed |
    | as recorded, or within tolerance | | | identical, within tolerance |
    | otherwise | that outcome | whole | accepted |
    | otherwise | that outcome | not whole | unverifiable |
    | otherwise, given what was recorded | another, or none | | culprit |
    | otherwise, given something else | something, for any operator | not led astray | culprit |
    | otherwise, given something else | | | downstream |
    """
    outcomes = {v.operator: outcome_of(report, v) for v in report.operators}
    unexpected = {
        v.operator
        for v in report.operators
        if outcomes[v.operator] is not None and outcomes[v.operator] != accepted.get(v.operator)
    }
    unsteady = {v.operator for v in report.operators if report.repeats(v.operator) is False}
    judged = []
    for v in report.operators:
        own, outcome = report.verdict(v), outcomes[v.operator]
        verdict: OperatorVerdict = own
        if v.operator in accepted and outcome is None and v.whole and not v.wrote:
            verdict = "not as accepted"
        elif outcome is not None and v.operator not in unexpected and not v.wrote:
            verdict = "accepted"
        elif own == "downstream" and accepted and not _led_astray(v.operator, unexpected, report.producers):
            verdict = "culprit"
        if verdict in (*PASSES, "changed") and not v.whole:
            verdict = "unverifiable"
        steady = unsteady.isdisjoint({v.operator} | _upstream(v.operator, report.producers))
        judged.append(Judged(v.operator, verdict, outcome, v.whole and steady and not v.wrote))
    absent = (Judged(name, "not here", firm=False) for name in report.absent)
    changed = {s.maker for s in report.changed}
    stand_ins = (
        Judged(s.operator, "changed" if s.operator in changed else "unverifiable", firm=False)
        for s in report.stand_ins
        if s.operator in changed or not s.whole
    )
    return (*judged, *absent, *stand_ins)


def outcome_of(report: VerifyReport, verification: Verification) -> Outcome | None:
    """Returns what an operator made here, where that is not what was recorded."""
    first = verification.first
    if first is None or report.verdict(verification) == "within tolerance":
        return None
    streams = {s: report.digests[s] for s in report.outputs.get(verification.operator, ()) if s in report.digests}
    return {
        "streams": {stream: {"messages": count, "digest": digest} for stream, (count, digest) in streams.items()},
        "differing": verification.differing,
        "first": {"call": first.call, "stamp": first.stamp, "port": first.port, "got": first.got},
    }


def _led_astray(operator: str, unexpected: Collection[str], producers: Mapping[str, frozenset[str]]) -> bool:
    """Returns whether an operator depends on an unexpected one that does not in turn depend on it."""
    return any(
        other != operator and operator not in _upstream(other, producers)
        for other in _upstream(operator, producers) & set(unexpected)
    )


def _upstream(operator: str, producers: Mapping[str, frozenset[str]]) -> set[str]:
    found: set[str] = set()
    left = [operator]
    while left:
        new = producers.get(left.pop(), frozenset()) - found
        found |= new
        left += new
    return found
