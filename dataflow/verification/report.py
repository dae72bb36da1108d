"""The report of a verification: what was re-executed and compared, and the verdict on the recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from dataflow.recording.streams.cutting import Cut
from dataflow.records.comparison import Verification
from dataflow.supervision.core.report import OperatorCounts
from dataflow.verification.compare import OutputComparison
from dataflow.verification.ledger import Ledger
from dataflow.verification.stored import StoredStream

Verdict = Literal["identical", "within tolerance", "culprit", "downstream", "changed", "unverifiable"]


@dataclass(frozen=True, slots=True)
class StandIn:
    """A source, or another operator whose recorded streams were used: its streams against its firing records.

    `unaccounted` stored messages are of no record; `lost_records` calls follow a gap in the records; `unfinished`: they
    end before the run did. `missing` messages are in the records and not in the recording: never sent, or lost. `cut`:
    the recording itself ends before the run did; `part`: it was cut out of another, in which all is accounted for.
    """

    operator: str
    unaccounted: int = 0
    lost_records: int = 0
    unfinished: bool = False
    missing: int = 0
    cut: bool = False
    part: bool = False

    @staticmethod
    def of(operator: str, ledger: Ledger) -> StandIn:
        account, part = ledger.accounts[operator], ledger.part is not None
        cut = not ledger.ended and (part or not account.finished or (ledger.torn and account.not_stored > 0))
        return StandIn(
            operator, account.unaccounted, account.lost, not account.finished and not cut, account.not_stored, cut, part
        )

    @property
    def whole(self) -> bool:
        """Its records have every stored message, as far as the recording goes. Missing messages are only noted."""
        return not (self.lost_records or self.unfinished or (self.unaccounted and (self.part or not self.cut)))


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """The result of verifying one recording.

    `stood_in` are the operators whose recorded streams were used instead, `stand_ins` those and the sources, with what
    their records say; `stored` the streams whose stored messages were compared with the records, `unchecked` those that
    could not be. `facts` are what differs between the machine that recorded and this one: (fact, then, now). `wall`:
    seconds of re-execution, operators' set-up not included; `total`: of everything; `span`: seconds of event time.
    `comparisons` hold, for the operators that differ, how their messages compare with the recorded ones; `repeated`,
    for culprits that were run twice, whether they made the same. `digests` are (messages, stream digest) of what was
    made here, by stream; `outputs` the streams of each operator, `producers` the nodes that it takes from.
    `start`: seconds into the recording, where it began there. `torn`: the recording has no proper end, so only
    its stored part is verified. `part`: the recording is a part of another, cut out of it. `work` is how long each
    operator worked, `reading` the CPU seconds for which that worker read the recording that read most of it.
    `absent` are operators whose code is not here, and why: their messages are taken from the recording.
    `changes` are, by operator, what the graph has otherwise than the recorded one.
    `shared` are operators that make what was recorded, but not always in one process with those named; `overwritten`
    are, by operator, the one of its process that wrote into what it was given; `mates`, those that ran in its process.
    """

    operators: tuple[Verification, ...]
    stood_in: tuple[str, ...]
    facts: tuple[tuple[str, str, str], ...]
    messages: int
    streams: int
    wall: float
    span: float
    total: float = 0.0
    stand_ins: tuple[StandIn, ...] = ()
    stored: tuple[StoredStream, ...] = ()
    unchecked: tuple[str, ...] = ()
    tolerance: float | None = None
    comparisons: Mapping[str, OutputComparison] = field(default_factory=dict)
    repeated: Mapping[str, bool] = field(default_factory=dict)
    digests: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    outputs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    producers: Mapping[str, frozenset[str]] = field(default_factory=dict)
    start: float | None = None
    torn: bool = False
    part: Cut | None = None
    work: Mapping[str, OperatorCounts] = field(default_factory=dict)
    reading: float = 0.0
    absent: Mapping[str, str] = field(default_factory=dict)
    changes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    shared: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    overwritten: Mapping[str, str] = field(default_factory=dict)
    mates: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def identical(self) -> bool:
        """True only when every firing of the run was repeated, every output was the same, bit for bit, and every
        stored message is the one in the firing records."""
        return (
            not self.cut
            and not self.absent
            and all(self.verdict(v) == "identical" for v in self.operators)
            and not self.changed
            and all(s.whole for s in self.stand_ins)
        )

    @property
    def cut(self) -> bool:
        """The recording ends before its run did: what it was verified up to is all that can be said of it."""
        return any(v.cut for v in self.operators) or any(s.cut for s in self.stand_ins)

    @property
    def empty(self) -> bool:
        """A run that was cut holds no calls but the end of operators: nothing was verified."""
        if not self.operators:
            return True
        repeated = sum(self.work[v.operator].firings if v.operator in self.work else v.verified for v in self.operators)
        return self.cut and not (repeated or any(v.unverifiable or v.unknown for v in self.operators))

    @property
    def changed(self) -> tuple[StoredStream, ...]:
        """The streams in which stored messages are not what was recorded."""
        return tuple(s for s in self.stored if s.changed)

    @property
    def within_tolerance(self) -> bool:
        """Every operator is identical or, given the recorded inputs, stays within the tolerance."""
        return all(self.verdict(v) in ("identical", "within tolerance") for v in self.operators)

    @property
    def culprits(self) -> tuple[str, ...]:
        return tuple(v.operator for v in self.operators if self.verdict(v) == "culprit")

    def verdict(self, verification: Verification) -> Verdict:
        """The verdict on an operator: its own, what the tolerance makes of it, or `changed` where only what was stored
        of it is not what it made."""
        compared = self.comparisons.get(verification.operator)
        if verification.first is None:
            changed = any(s.maker == verification.operator for s in self.changed)
            return "changed" if changed else verification.verdict
        if self.tolerance is None or compared is None or verification.wrote:
            return verification.verdict
        own = compared.own and verification.operator not in self.overwritten
        return "within tolerance" if compared.tolerated else "culprit" if own else "downstream"

    def repeats(self, operator: str) -> bool | None:
        """Returns whether a culprit differed twice alike; None where it was not run twice."""
        return self.repeated.get(operator)

    def altered(self, operator: str) -> tuple[str, ...]:
        """Returns the facts in the recording, of an operator and its machine, that are not as they were then."""
        machine = (f"{fact}: {then or 'none'} → {now or 'none'}" for fact, then, now in self.facts)
        return (*self.revised(operator), *machine)

    def revised(self, operator: str) -> tuple[str, ...]:
        """Returns what is not as it was recorded of an operator itself: its parameters, code, files, packages."""
        v = next(v for v in self.operators if v.operator == operator)
        return (
            *self.changes.get(operator, ()),
            *(f"code of {module}" for module in v.code_changed),
            *(f"file {file}" for file in v.files_changed),
            *v.packages_changed,
        )

    def as_json(self) -> dict[str, Any]:
        operators = []
        for v in self.operators:
            compared = self.comparisons.get(v.operator)
            operators.append(
                v.to_wire()
                | {"verdict": self.verdict(v), "repeats": self.repeats(v.operator)}
                | {"comparison": None if compared is None else compared.as_json()}
                | {"cpu_ms": self.work[v.operator].cpu_ns / 1e6 if v.operator in self.work else None}
            )
        return {
            "identical": self.identical,
            "tolerance": self.tolerance,
            "within_tolerance": None if self.tolerance is None else self.within_tolerance,
            "culprits": list(self.culprits),
            "start_s": self.start,
            "torn": self.torn,
            "cut": self.cut,
            "part": None if self.part is None else asdict(self.part),
            "messages": self.messages,
            "streams": self.streams,
            "wall_s": self.wall,
            "reading_cpu_ms": self.reading * 1e3,
            "real_time_factor": self.span / self.wall if self.wall else None,
            "operators": operators,
            "stood_in": list(self.stood_in),
            "sources": [asdict(s) | {"whole": s.whole} for s in self.stand_ins],
            "stored": [s.to_wire() for s in self.stored if not s.as_recorded or s.missing],
            "unchecked": list(self.unchecked),
            "absent": dict(self.absent),
            "changes": {name: list(changes) for name, changes in self.changes.items()},
            "overwritten": dict(self.overwritten),
            "shared": {name: list(beside) for name, beside in self.shared.items()},
            "differing_facts": [{"fact": f, "recorded": a, "here": b} for f, a, b in self.facts],
        }
