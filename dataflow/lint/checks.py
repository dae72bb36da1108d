"""The whole look at a recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from dataflow.lint.cameras import check_cameras
from dataflow.lint.clocks import NONE, ClockDifference, agreed, clock_difference
from dataflow.lint.contract import Contract, StreamTerms, means
from dataflow.lint.frames import FrameTree, check_frames
from dataflow.lint.inputs import Finding, LintInput
from dataflow.lint.motion import check_motion
from dataflow.lint.publishers import check_publishers
from dataflow.lint.quantities import check_quantities
from dataflow.lint.readings import check_readings
from dataflow.lint.timing import Timing, check_ends, check_gaps, check_order, check_unit, timing_of
from dataflow.lint.turning import Turning, turning_of

SIGMAS = 3.0
"""Standard deviations that a clock has to be off by, besides what is tolerated."""
DRIFTED = 0.005
"""Seconds that a drift must reach over the recording to be reported."""


@dataclass(slots=True)
class Report:
    """All findings. `clocks`: lateness of each stream against `reference`, as far as its turning determines it."""

    findings: list[Finding] = field(default_factory=list)
    timings: dict[str, Timing] = field(default_factory=dict)
    clocks: dict[str, ClockDifference] = field(default_factory=dict)
    reference: str = ""
    root: str | None = None

    @property
    def sound(self) -> bool:
        """Returns whether nothing but notes was found."""
        return all(finding.severity == "note" for finding in self.findings)

    def to_json(self) -> dict[str, Any]:
        return {
            "sound": self.sound,
            "findings": [finding.to_json() for finding in self.findings],
            "streams": {
                name: {"messages": t.count, "hz": t.rate, "steady": t.steady, "longest_interval_s": t.longest}
                for name, t in self.timings.items()
            },
            "reference_clock": self.reference,
            "clocks": {
                name: {
                    "offset_s": c.offset,
                    "offset_deviation_s": c.offset_deviation,
                    "drift_s_per_s": c.drift,
                    "drift_deviation_s_per_s": c.drift_deviation,
                    "likeness": c.likeness,
                }
                for name, c in self.clocks.items()
            },
        }


def lint(data: LintInput, contract: Contract | None = None, *, clocks: bool = True) -> Report:
    """Looks at everything. `clocks` False leaves clocks and motion out, which take all messages."""
    terms = contract or Contract()
    report = Report()
    report.findings += data.file_findings(whole=clocks)
    for name, facts in data.streams.items():
        if facts.count and not facts.static:
            stamps = data.stamps(name)
            timing = timing_of(stamps)
            if timing is None:
                text = f"{facts.count:,} messages are promised, and none is there"
                report.findings.append(Finding("missing", name, "error", text))
                continue
            report.timings[name] = timing
            wanted = terms.terms_of(name, data.namespace)
            if facts.type != "Transforms":  # several may publish transforms on one topic, each by its own clock
                report.findings += check_order(name, stamps)
            report.findings += check_unit(name, timing)
            report.findings += check_gaps(name, stamps, timing, None if wanted is None else wanted.max_gap)
    report.findings += check_ends(report.timings)
    report.findings += check_quantities(data, report.timings)
    report.findings += check_readings(data)
    report.findings += check_cameras(data)
    report.findings += check_publishers(data)
    tree = _frames_of(data)
    report.findings += check_frames(tree, terms.frames.root, terms.frames.required)
    report.root = tree.roots()[0] if tree.parents else None
    report.findings += _kept(data, terms, report.timings)
    if clocks:
        report.findings += check_motion(data)
        report.reference, report.clocks = compare_clocks(data, report.timings, terms)
        report.findings += check_clocks(report, terms)
    report.findings = [f for f in report.findings if not _accepted(f, terms, data.namespace)]
    report.findings.sort(key=lambda f: ("error", "warning", "note").index(f.severity))
    return report


def _accepted(finding: Finding, terms: Contract, namespace: str) -> bool:
    wanted = terms.terms_of(finding.stream, namespace) if finding.stream else None
    return wanted is not None and finding.check in wanted.allow


def _frames_of(data: LintInput) -> FrameTree:
    """Takes all transforms and odometry, of other streams one message: their frame does not change."""
    tree = FrameTree()
    for name, facts in data.streams.items():
        if facts.readable and facts.count:
            for message in data.messages(name):
                tree.see(name, message)
                if facts.type != "Transforms":
                    break
    return tree


def _kept(data: LintInput, contract: Contract, timings: dict[str, Timing]) -> Iterator[Finding]:
    """The terms of the contract that are not kept."""
    for word, terms in contract.streams.items():
        meant = [name for name in data.streams if means(word, name, data.namespace)]
        if not any(data.streams[name].count for name in meant):
            if not terms.optional:
                yield Finding("contract", word, "error", "has no message" if meant else "is missing")
            continue
        for name in meant:
            if contract.terms_of(name, data.namespace) is terms and data.streams[name].count:
                yield from _kept_by(data, name, terms, timings.get(name))


def _kept_by(data: LintInput, stream: str, terms: StreamTerms, timing: Timing | None) -> Iterator[Finding]:
    found = data.streams[stream].type
    if terms.type is not None and found != terms.type:
        yield Finding("contract", stream, "error", f"is of type {found}; the contract wants {terms.type}")
    if terms.rate is None or timing is None:
        return
    low, high = terms.rate
    span = (timing.last - timing.first) * 1e-9
    mean = (timing.count - 1) / span if span > 0 else 0.0
    for what, rate in (("median", timing.rate), ("mean", mean)):
        if not low <= rate <= high:
            text = f"its {what} rate is {rate:.4g} Hz; the contract wants {low:g} to {high:g}"
            yield Finding("rate", stream, "error", text, None, {"hz": rate, "least": low, "most": high})
            return


def compare_clocks(
    data: LintInput, timings: dict[str, Timing], contract: Contract
) -> tuple[str, dict[str, ClockDifference]]:
    """The reference, and the lateness of each stream that shows turning is against it."""
    origin = min((timing.first for timing in timings.values()), default=0)
    turnings: dict[str, Turning] = {}
    for name, facts in data.streams.items():
        ignored = any(means(word, name, data.namespace) for word in contract.clocks.ignore)
        if facts.readable and name in timings and not ignored:
            turning = turning_of(data.messages(name), facts.type, origin)
            turnings |= {} if turning is None else {name: turning}
    if len(turnings) < 2:
        return "", {}
    finest = _reference(data, turnings, contract)
    found = {finest: NONE}
    for name, turning in turnings.items():
        if name != finest and (difference := clock_difference(turning, turnings[finest])) is not None:
            found[name] = difference
    if contract.clocks.reference is None:
        reference = agreed(found, contract.clocks.max_offset)
        moved = {name: difference.minus(found[reference]) for name, difference in found.items()}
        return reference, moved | {reference: NONE}
    return finest, found


def _reference(data: LintInput, turnings: dict[str, Turning], contract: Contract) -> str:
    """The contract's reference, else the gyroscope with most samples, else the stream with most of them."""
    if (word := contract.clocks.reference) is not None:
        named = next((name for name in turnings if means(word, name, data.namespace)), None)
        if named is not None:
            return named
    gyros = [name for name in turnings if data.streams[name].type == "Imu"]
    return max(gyros or turnings, key=lambda name: len(turnings[name].ends))


def check_clocks(report: Report, contract: Contract) -> Iterator[Finding]:
    """Clocks that are off by more than the contract tolerates and the estimate is uncertain by."""
    for name, difference in report.clocks.items():
        values: dict[str, float | int | str] = {
            "reference": report.reference,
            "offset_ms": difference.offset * 1e3,
            "drift_ms_per_s": difference.drift * 1e3,
        }
        drift, allowed = difference.drift, contract.clocks.max_drift
        over = abs(drift) * difference.duration
        drifts = abs(drift) > allowed + SIGMAS * difference.drift_deviation and over > DRIFTED
        offset = difference.at_beginning() if drifts else difference.offset
        deviation = difference.offset_deviation + (difference.drift_deviation * difference.duration / 2) * drifts
        if abs(offset) > contract.clocks.max_offset + SIGMAS * deviation:
            text = f"its timestamps are {_late(offset)} against {report.reference}, ± {deviation * 1e3:.2g} ms"
            text += " at the beginning" if drifts else ""
            yield Finding("clock offset", name, "warning", text, None, {**values, "offset_ms": offset * 1e3})
        if drifts:
            way = "later" if drift > 0 else "earlier"
            text = (
                f"its timestamps get {way} by {abs(drift) * 1e3:.3g} ± {difference.drift_deviation * 1e3:.2g} ms every "
                f"second against {report.reference}: {over * 1e3:.3g} ms over the recording"
            )
            yield Finding("clock drift", name, "warning", text, None, values)


def _late(offset: float) -> str:
    return f"{abs(offset) * 1e3:.3g} ms {'late (+)' if offset > 0 else 'early (−)'}"
