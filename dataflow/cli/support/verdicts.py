"""Prints what verification found: one recording in full, many in a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from rich.console import Console
from rich.text import Text

from dataflow.cli.support.causes import as_recorded
from dataflow.cli.support.output import count, plural, seconds, size, table
from dataflow.recording.streams.diff import FieldDifference
from dataflow.records.comparison import Difference, Verification
from dataflow.records.firing import CALLS
from dataflow.sync.stamps import format_stamp
from dataflow.verification.compare import OutputComparison
from dataflow.verification.complete import Completion
from dataflow.verification.gate import Checked, Judged
from dataflow.verification.report import StandIn, VerifyReport
from dataflow.verification.stored import StoredStream

STYLES = {
    "identical": "green",
    "identical up to the cut": "yellow",
    "within tolerance": "cyan",
    "accepted": "cyan",
    "culprit": "bold red",
    "different": "bold red",
    "not as accepted": "bold red",
    "changed": "bold red",
    "nothing verified": "bold red",
    "could not run": "bold red",
    "downstream": "yellow",
    "unverifiable": "yellow",
    "not here": "bold red",
    "not wholly verified": "yellow",
}
FIELDS_SHOWN = 6


def print_one(console: Console, checked: Checked) -> None:
    """Operators with their verdicts, what there is to say about each, what differs between the machines, the end."""
    report = checked.report
    assert report is not None
    numbers = ("firings", "repeated", "out", "differing")
    verdicts = table("operator", *numbers, "verdict", right=numbers)
    by_name = {v.operator: v for v in report.operators}
    for judged in checked.judged:
        v = by_name.get(judged.operator)
        cells = [] if v is None else [count(n) for n in (v.firings, v.verified, v.outputs, v.differing)]
        row = cells or [""] * len(numbers)  # a source is not repeated
        verdicts.add_row(Text(judged.operator), *row, Text(judged.verdict, style=STYLES[judged.verdict]))
    console.print(verdicts)
    told = [line for judged in checked.judged for line in explain(checked, judged)]
    _print(console, dict.fromkeys([*told, *_notes(report)]))
    _print(console, filter(None, [_cut(report)]), "yellow")
    if not report.identical:
        _print(console, fact_lines(report), "dim")
    if checked.runs > 1:
        console.print(Text(_runs(checked)))
    console.print(Text.assemble((checked.verdict, STYLES[checked.verdict]), _conclusion(checked, report)))


def print_many(console: Console, all_checked: Sequence[Checked]) -> None:
    """A table of recordings, then what there is to say about those that did not pass."""
    numbers = ("messages", "× real time")
    summary = table("recording", "verdict", *numbers, "look at", right=numbers)
    for checked in all_checked:
        report = checked.report
        summary.add_row(
            Text(checked.name),
            Text(checked.verdict, style=STYLES[checked.verdict]),
            "" if report is None else count(report.messages),
            f"{report.span / report.wall:.1f}" if report is not None and report.wall and report.span else "",
            Text(", ".join((*checked.culprits, *checked.changed))),
        )
    console.print(summary)
    for checked in all_checked:
        told = [line for judged in checked.judged if not judged.passed for line in explain(checked, judged)]
        lines = dict.fromkeys([*told, *reservations(checked)]) if checked.report is not None else [checked.error]
        if lines or not checked.passed:
            console.print(Text(checked.name, style="bold"))
        _print(console, (f"  {line}" for line in lines))
        if checked.report is not None and not checked.passed:
            _print(console, (f"  {line}" for line in fact_lines(checked.report)), "dim")
    passed = sum(c.passed for c in all_checked)
    failed = {verdict: sum(c.verdict == verdict for c in all_checked) for verdict in STYLES}
    rest = [f"{n} {verdict}" for verdict, n in failed.items() if n and verdict not in ("identical",)]
    style = "green" if passed == len(all_checked) else "bold red"
    total = plural(len(all_checked), "recording")
    console.print(Text.assemble((f"{passed} of {total} passed", style), f" ({', '.join(rest)})" if rest else ""))


def _print(console: Console, lines: Iterable[str], style: str = "") -> None:
    for line in lines:
        console.print(Text(line, style=style), soft_wrap=True)


def reservations(checked: Checked) -> Iterator[str]:
    """Returns what is to be known of a recording besides verdicts: where it was cut, and what it lacks."""
    if checked.report is None:
        return
    if said := _cut(checked.report):
        yield said
    for v in checked.report.operators:
        yield from _left_out(v)
    yield from _notes(checked.report)
    if checked.runs > 1:
        yield _runs(checked)


def print_completion(console: Console, made: Completion) -> None:
    """Prints what was computed and stored; or which operator differs, and where."""
    for v in made.operators:
        if v.first is not None:
            _print(console, _difference(v, v.first, None))
            _print(console, [f"  {v.operator} is {'the culprit' if v.verdict == 'culprit' else 'downstream'}"])
        _print(console, _left_out(v))
    if not made.stored:
        culprits = [v.operator for v in made.operators if v.verdict == "culprit"]
        at = f"look at {', '.join(culprits)}" if culprits else "see above"
        console.print(Text.assemble(("different", "bold red"), f": nothing written; {at}"))
        return
    written = f"{made.path} ({plural(made.messages, 'message')}, {size(made.nbytes)}, {seconds(made.wall)})"
    console.print(
        Text.assemble(
            ("complete" if made.whole else "not wholly complete", "green" if made.whole else "yellow"),
            f": wrote {written}",
        ),
        soft_wrap=True,
    )
    if made.kept:
        told = f"{plural(made.kept, 'message')} could not be made again and were taken over as recorded"
        _print(console, [told], "yellow")
    _print(console, [f"computed again: {', '.join(made.added) or 'nothing that was not recorded'}"])


def explain(checked: Checked, judged: Judged) -> Iterator[str]:
    """Returns what there is to say about one operator besides its verdict."""
    report = checked.report
    assert report is not None
    yield from _changed(s for s in report.stored if s.maker == judged.operator)
    if judged.verdict == "not here":
        yield f"{judged.operator}: it is not here ({report.absent[judged.operator]}): what it made is taken as recorded"
        return
    v = next((v for v in report.operators if v.operator == judged.operator), None)
    if v is None:
        yield from _stand_in(next(s for s in report.stand_ins if s.operator == judged.operator))
        return
    compared = report.comparisons.get(v.operator)
    if judged.verdict == "accepted":
        yield f"{v.operator}: differs from the recording as the baseline accepts"
    elif judged.verdict == "not as accepted":
        yield f"{v.operator}: as recorded, but the baseline accepts another outcome (--accept takes this one)"
    elif judged.verdict == "within tolerance":
        assert compared is not None
        yield _tolerated(compared, report.tolerance)
    elif v.first is not None:
        yield from _difference(v, v.first, compared)
        if compared is not None and report.tolerance is not None:
            counts = f"{count(compared.equal)} identical, {count(compared.within)} within {report.tolerance:g}"
            more = f", {count(compared.unpaired)} missing, uncalled for or in error" if compared.unpaired else ""
            yield f"{v.operator}: given the recorded inputs, {counts}, {count(compared.beyond)} beyond it{more}"
    repeats = report.repeats(v.operator)
    if repeats is False and judged.verdict != "within tolerance":
        yield (
            f"{v.operator}: run a second time, it differed in another way: it does not repeat "
            "(it may read the clock, draw numbers that are not self.rng's, or use threads; --why finds the cause)"
        )
    elif repeats and judged.verdict == "culprit":
        yield f"{v.operator}: run a second time, it differed alike: {_since(report, v)}"
    if v.wrote:
        yield f"{v.operator}: it changed the memory of {v.wrote}; messages are immutable: copy before writing"
    elif writer := report.overwritten.get(v.operator):
        yield f"{v.operator}: {writer}, which ran in its process, wrote into a message that it was given"
    elif judged.verdict == "culprit" and (mates := report.mates.get(v.operator)):
        yield (
            f"{v.operator}: in the run it shared a process with {', '.join(mates)}; what operators keep in a module or "
            "set in a library reaches others of their process: keep it in self"
        )
    if report.start is not None and v.began == "start" and not v.unknown:
        yield f"{v.operator}: keeps state and the recording has no snapshot of it there: repeated from its beginning"
    yield from _left_out(v)
    for file in v.files_changed:
        yield f"{v.operator}: file {file} is not the one that was read then"
    if v.code_changed:
        yield f"{v.operator}: its code is not what it was: {', '.join(v.code_changed)}"


def _since(report: VerifyReport, v: Verification) -> str:
    """Returns what changed since an operator was recorded, as far as the recording holds it."""
    if not report.altered(v.operator):
        return f"it repeats here, and {as_recorded(code_known=v.code_known)} (--why looks for it)"
    found = list(report.changes.get(v.operator, ()))
    found += ["its code"] * bool(v.code_changed) + ["a file that it read"] * bool(v.files_changed)
    found += ["libraries or the machine"] * bool(report.facts or v.packages_changed)
    unknown = "" if v.code_known else "; perhaps its code, of which the recording has no digests"
    return f"changed since the recording: {', '.join(found)}{unknown}"


def _cut(report: VerifyReport) -> str:
    """Returns why a recording covers its run only up to a cut; empty where it covers all of it."""
    if report.part is not None:
        span = " ".join(
            f"{word} {format_stamp(stamp)}"
            for word, stamp in (("from", report.part.start), ("to", report.part.end))
            if stamp is not None
        )
        return f"the recording is a part of {report.part.of}, {span or 'all of it'}: verified is what it holds"
    if report.torn:
        return "the recording has no proper end: verified is what its writer had stored when it died"
    return "the run did not end in order: verified is what was recorded until then" if report.cut else ""


def _changed(streams: Iterable[StoredStream]) -> Iterator[str]:
    """The stored messages that are not what their firing records say."""
    for s in streams:
        if s.first_changed is not None:
            more = f" ({plural(s.changed, 'message')} of that stream)" if s.changed > 1 else ""
            yield f"{s.stream} {_number(s.first_changed)} is not what was recorded{more}: the file was changed"


def _stand_in(s: StandIn) -> Iterator[str]:
    """Lists what is not in order in the books of a source, and what its streams lack."""
    if s.lost_records:
        yield f"{s.operator}: {plural(s.lost_records, 'firing')} after a gap in its firing records: records are lost"
    if s.unaccounted:
        told = ", after the cut" if s.cut else ": records are lost, or messages were added"
        yield f"{s.operator}: {plural(s.unaccounted, 'message')} that no firing record accounts for{told}"
    elif s.unfinished:
        yield f"{s.operator}: its firing records end before the run did: records are lost"


def _notes(report: VerifyReport) -> Iterator[str]:
    """Returns what is to be known of operators that share state, and of the streams that were not made again."""
    for name, beside in report.shared.items():
        yield (
            f"{name}: it makes what was recorded, but in one process with {', '.join(beside)} not always: something "
            "that they share changes it (the state of a module, a setting of a library, the memory of a message)"
        )
    for stand_in in report.stand_ins:
        yield from _stand_in(stand_in)
        if stand_in.missing:
            lost = [s for s in report.stored if s.maker == stand_in.operator and s.first_missing is not None]
            first = f", the first {lost[0].stream} {_number(lost[0].first_missing)}" if lost else ""
            made = f"{plural(stand_in.missing, 'message')} that it made, not in the recording"
            yield f"{stand_in.operator}: {made} (never sent, or lost{first})"
    for v in report.operators:
        for change in v.packages_changed:
            yield f"{v.operator}: {change} in its environment"
        yield from _effects(v)
    for stream in report.unchecked:
        yield f"{stream}: not compared with its records: messages of its type are not read as they were written"


def _effects(v: Verification) -> Iterator[str]:
    """Returns what of an operator's calls to what cannot repeat was taken from the recording."""
    for name, done in v.effects.items():
        line = f"{v.operator}: {plural(done['given'], 'answer')} of {name} given as recorded"
        if done["again"]:
            line += f"; made again {plural(done['again'], 'time')}, {count(done['same'])} answered as recorded"
        if done["missed"]:
            line += f"; {plural(done['missed'], 'call')} not recorded"
        yield line


def _runs(checked: Checked) -> str:
    """Returns what repeated verifications show."""
    if checked.unseen is None:
        return f"a difference in run {checked.runs}; the {plural(checked.runs - 1, 'run')} before passed"
    return f"a difference was not seen in {checked.runs} runs: at most {checked.unseen:.1%} of runs, at 95 % confidence"


def _number(place: tuple[int, int] | None) -> str:
    if place is None:
        return ""
    incarnation, number = place
    return f"#{number}" if not incarnation else f"#{number} of incarnation {incarnation}"


def _left_out(v: Verification) -> Iterator[str]:
    """Returns what could not be repeated, and what the recording lacks."""
    if v.lost_records:
        yield f"{v.operator}: {plural(v.lost_records, 'firing')} could not be repeated (records before them are lost)"
    if v.unknown:
        yield (
            f"{v.operator}: {plural(v.unknown, 'firing')} could not be repeated: the recording was cut there, and "
            "holds no state of it at or before the cut (`record: {snapshots: 10s}` records an operator's `state`; an "
            "operator without a state sets `stateless = True`)"
        )
    if v.unaccounted:
        yield f"{v.operator}: {plural(v.unaccounted, 'message')} that no firing record accounts for: records are lost"
    elif v.unfinished:
        yield f"{v.operator}: its firing records end before the run did: records are lost"
    if v.unverifiable:
        missing = v.missing or "input"
        after = ", after the cut" if v.cut and v.beyond else ""
        yield f"{v.operator}: {plural(v.unverifiable, 'firing')} could not be repeated (missing {missing}{after})"
    if v.after_cut:
        yield f"{v.operator}: {plural(v.after_cut, 'message')} after the cut, in no firing record"
    if v.not_stored:
        yield f"{v.operator}: {plural(v.not_stored, 'message')} made again, not in the recording (never sent, or lost)"


def fact_lines(report: VerifyReport) -> Iterator[str]:
    """Returns what differs between the machine that recorded and this one, for beside a difference."""
    if not report.facts:
        yield "machine, libraries, threads and devices are as when it was recorded"
    for fact, then, now in report.facts:
        yield f"{fact}: {then or 'none'} when recorded, {now or 'none'} here"


def _difference(v: Verification, first: Difference, compared: OutputComparison | None) -> Iterator[str]:
    port = f", port {first.port}" if first.port else ""
    where = _call(first.call, first.kind)
    if first.kind != "setup":
        where += f" at {format_stamp(first.stamp)} ({first.stamp})"
    yield f"{v.operator}: first difference in {where}{port}"
    yield f"  recorded  {first.expected}"
    yield f"  here      {first.got}"
    if compared is None:
        return
    for output in compared.first:
        if (output.index, output.incarnation) != (first.index, first.incarnation):
            yield f"  compared in {_call(output.call, output.kind)} at {format_stamp(output.firing)}:"
        if output.note:
            yield f"  {output.port}: {output.note}, so only digests can be compared"
        for found in output.fields[:FIELDS_SHOWN]:
            yield f"  {output.port}.{difference_text(found)}"
        if len(output.fields) > FIELDS_SHOWN:
            yield f"  {output.port}: {len(output.fields) - FIELDS_SHOWN} more fields differ"


def _call(number: int | None, kind: str) -> str:
    """The place of a record among an operator's calls, in words."""
    if kind in CALLS:
        return f"call {number} ({kind})"
    return kind if number is None else f"{kind} behind call {number}"


def difference_text(found: FieldDifference) -> str:
    """A field that differs, in words."""
    largest = "" if found.max_difference is None else f", by at most {found.max_difference:.3g}"
    if found.index is None:
        return f"{found.field}: recorded {found.a}, here {found.b}{largest}"
    where = ", ".join(map(str, found.index))
    elements = f"{count(found.count)} of {count(found.size)} elements differ"
    return f"{found.field}[{where}]: recorded {found.a}, here {found.b}; {elements}{largest}"


def _tolerated(compared: OutputComparison, tolerance: float | None) -> str:
    if not compared.within:
        return f"{compared.operator}: differs with its inputs; given the recorded ones it is identical"
    return (
        f"{compared.operator}: given the recorded inputs, {plural(compared.within, 'message')} "
        f"differ from the recorded ones by at most {compared.max_difference:.3g}, within {tolerance:g}; "
        f"{count(compared.equal)} identical"
    )


def _conclusion(checked: Checked, report: VerifyReport) -> str:
    pace = f", {seconds(report.span)} of event time in {seconds(report.wall)}" if report.wall and report.span else ""
    what = f"{plural(report.messages, 'message')} of {plural(report.streams, 'stream')}"
    if report.wall and report.span:
        pace += f", {report.span / report.wall:.1f} × real time"
    pace += f" ({seconds(checked.wall)} in all)"
    match checked.verdict:
        case "identical" | "identical up to the cut":
            return f": {what}{pace}"
        case "within tolerance":
            return f" of {report.tolerance:g}, not identical: {what}{pace}"
        case "nothing verified":
            return f": the recording ends before any operator was called{pace}"
        case "different" if checked.culprits or checked.changed:
            return f": look at {', '.join((*checked.culprits, *checked.changed))}{pace}"
    return pace
