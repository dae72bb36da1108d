"""`dataflow verify`: are these recordings what the code makes of them?"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.text import Text

from dataflow.cli.support.arguments import Json, check_offset, existing, offset, output_file
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import COULD_NOT_RUN, DIFFERENT, err, fail, out, own_traceback, print_json, say
from dataflow.cli.support.repeated_calls import CodeOptions
from dataflow.cli.support.run_options import MakeEffects, Paranoid, Quiet

if TYPE_CHECKING:
    from collections.abc import Callable

    from dataflow.causes.why import CauseReport
    from dataflow.graph import Graph
    from dataflow.verification.gate import Baseline, Checked
    from dataflow.verification.report import VerifyReport
    from dataflow.verification.workers.prestart import EarlyWorkers

_GATE = "Regression gate"
MOST_JOBS = 1024
MOST_RUNS = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class VerifyOptions:
    """The options of `dataflow verify`, in the order of its help."""

    code: CodeOptions
    first: Annotated[str | None, option("--from OPERATOR", "Only this operator and what follows from it.")] = None
    only: Annotated[list[str] | None, option("--only OPERATOR", "Only this operator; may be given several times.")] = (
        None
    )
    tolerance: Annotated[
        float | None,
        option(
            "--tolerance T",
            "Let floating-point values differ by up to T, absolutely, when operators are given the recorded "
            "inputs. Reported as within tolerance, never as identical.",
        ),
    ] = None
    start: Annotated[
        float | None,
        option(
            "--start TIME",
            "Begin so long after the recording's first message (seconds, or 500ms, 2min), from the states that it "
            "holds there.",
            parser=offset,
        ),
    ] = None
    baseline: Annotated[
        Path | None,
        option("--baseline FILE.json", "Outcomes that are accepted although they are not what was recorded.", _GATE),
    ] = None
    accept: Annotated[bool, option("--accept", "Write what differs now into the --baseline file.", _GATE)] = False
    junit: Annotated[Path | None, option("--junit FILE.xml", "Write the results as JUnit XML (replaced).", _GATE)] = (
        None
    )
    jobs: Annotated[
        int | None, option("--jobs -j N", "Worker processes. Default: one for each core, fewer where little is to do.")
    ] = None
    repeat: Annotated[int, option("--repeat N", "Verify up to N times, until something differs; gives the odds.")] = 1
    make_effects: MakeEffects = False
    paranoid: Paranoid = False
    why: Annotated[bool, option("--why", "Find the causes: run each culprit alone, 8 times at most.")] = False
    quiet: Quiet = False
    json: Json = False

    def check(self) -> None:
        """Ends the command where options exclude each other, or lie outside their bounds."""
        if self.jobs is not None and not 1 <= self.jobs <= MOST_JOBS:
            raise fail(f"--jobs {self.jobs}: expected 1 to {MOST_JOBS}")
        if not 1 <= self.repeat <= MOST_RUNS:
            raise fail(f"--repeat {self.repeat}: expected 1 to {MOST_RUNS}")
        if self.first is not None and self.only:
            raise fail("--from and --only exclude each other")
        self.code.check()
        if self.tolerance is not None and not 0 <= self.tolerance < float("inf"):
            raise fail(f"--tolerance {self.tolerance:g}: expected a finite number, 0 or more")
        check_offset("--start", self.start)
        if self.start is not None and self.baseline is not None:
            raise fail("--start and --baseline exclude each other: a baseline is of whole recordings")
        if self.accept and self.baseline is None:
            raise fail("--accept writes a baseline: name the file with --baseline FILE.json")
        if self.accept and (self.first is not None or self.only):
            raise fail("--accept takes whole recordings: leave --from and --only out")


def verify(
    recordings: Annotated[list[Path], argument("RECORDING", "Recordings (.mcap), or folders of them.")],
    options: VerifyOptions,
) -> None:
    """Re-execute recorded runs by their firing records, and compare every output.

    Every operator is fed from the recording, in worker processes that use no network. Its outputs, and the stored
    messages, are compared with the recorded digests. A culprit (same inputs, other output) is shown with the field that
    differs, and run once more, to see whether it differs alike each time.

    Of a folder, every .mcap in it is verified, at any depth; one that cannot be read does not keep the others from it.

    Exit codes:

      0    identical, or within --tolerance, or as --baseline accepts
      1    different, not wholly verifiable, or nothing verified
      2    could not run (of several recordings: at least one), or an operator is not here any more
      130  interrupted with Ctrl-C

    Examples:

      dataflow verify run.mcap
      dataflow verify run.mcap --only odometry --json
      dataflow verify run.mcap --only odometry --why
      dataflow verify run.mcap --only odometry --only mapper
      dataflow verify run.mcap --from odometry --graph changed.yaml
      dataflow verify run.mcap --tolerance 1e-5
      dataflow verify run.mcap --start 60
      dataflow verify run.mcap --repeat 40
      dataflow verify runs/ --junit verify.xml
      dataflow verify runs/ --baseline runs/accepted.json --accept
    """
    from dataflow.verification.workers.prestart import early_workers

    options.check()
    _check_files(recordings, options.junit, options.baseline)
    with early_workers(options.jobs) as early:  # while this process imports what it needs itself
        from dataflow.verification import gate

        known = None if options.baseline is None else gate.Baseline.load(options.baseline)
        graph = options.code.load()
        found = gate.recordings_in(recordings)
        single = len(recordings) == 1 and recordings[0] == found[0][0]
        checked = _check(found, known, graph, early, options, single=single)
        reasons = [_reasons(c, options.only, graph, quiet=options.quiet) for c in checked] if options.why else []
        _report(checked, reasons, options, single=single)
        if known is not None:
            _mind_baseline(known, checked, accept=options.accept, whole=not single)
    raise typer.Exit(_exit_code(checked, known if options.accept else None))


def _check_files(recordings: list[Path], junit: Path | None, baseline: Path | None) -> None:
    for target in recordings:
        if not target.is_dir():
            existing(target, "a recording")
    if junit is not None:
        output_file(junit, ".xml", overwrite=True, option="--junit")
    if baseline is not None:
        output_file(baseline, ".json", overwrite=True, option="--baseline")


def _check(
    targets: list[tuple[Path, str]],
    known: Baseline | None,
    graph: Graph | None,
    early: EarlyWorkers,
    options: VerifyOptions,
    *,
    single: bool,
) -> list[Checked]:
    from dataflow.verification.gate import check

    checked = []
    for number, (path, name) in enumerate(targets, start=1):
        if not options.quiet and not single:
            say(f"[dim]{number} of {len(targets)}: {escape(name)}[/]")
        accepted = {} if known is None else known.of(path)
        one = check(path, name, _verifier(graph, early, options), accepted, graph, options.repeat)
        if one.not_in_graph:
            names = escape(", ".join(one.not_in_graph))
            say(f"[yellow]note:[/] {escape(name)}: recorded operators that the graph does not have: {names}")
        checked.append(one)
    return checked


def _verifier(graph: Graph | None, early: EarlyWorkers, options: VerifyOptions) -> Callable[[Path], VerifyReport]:
    from dataflow.verification.verify import verify as verify_recording

    verify_one = partial(
        verify_recording,
        early=early,
        graph=graph,
        first=options.first,
        only=options.only or None,
        tolerance=options.tolerance,
        start=options.start,
        jobs=options.jobs,
        paranoid=options.paranoid,
        make_effects=options.make_effects,
    )
    if options.quiet:  # nothing is shown: what would show it is not imported
        return verify_one
    from dataflow.cli.support.progress import RunDisplay, shown

    def verifier(path: Path) -> VerifyReport:
        with shown(err, RunDisplay(err), quiet=False) as watch:
            return verify_one(path, watch=watch)

    return verifier


def _reasons(
    checked: Checked, only: list[str] | None, graph: Graph | None, *, quiet: bool = False
) -> list[CauseReport]:
    from dataflow.causes.ladder import MOST
    from dataflow.causes.why import reasons

    if checked.report is None:
        return []
    if not (names := only or checked.report.culprits):
        say("[dim]no causes to look for: there is no culprit[/]")
        return []
    say(f"[dim]looking for causes in {escape(', '.join(names))}: at most {MOST} re-runs of each[/]")
    if quiet or not err.is_terminal:
        return reasons(checked.path, checked.report, only or (), graph)
    with err.status("") as line:

        def progress(operator: str, number: int, tried: str) -> None:
            line.update(Text(f"{operator}: re-run {number}, {tried}"))

        return reasons(checked.path, checked.report, only or (), graph, progress)


def _report(checked: list[Checked], reasons: list[list[CauseReport]], options: VerifyOptions, *, single: bool) -> None:
    from dataflow.cli.support.causes import print_reasons
    from dataflow.cli.support.verdicts import print_many, print_one

    found = [{"why": [one.as_json() for one in each]} for each in reasons] or [{}] * len(checked)

    if single and checked[0].report is None:
        [one] = checked
        fail(one.error, details=own_traceback(one.details) if one.internal else one.details)
    elif single and options.json:
        print_json(checked[0].as_json() | found[0])
    elif single:
        print_one(out, checked[0])
        for name in checked[0].culprits[:1]:
            path, code = str(checked[0].path), options.code.words
            if checked[0].report is not None and _may_be_a_test(checked[0].report, name, reasons):
                words = ["dataflow", "capture", path, "--op", name, *code]
                out.print(Text(f"as a test: {shlex.join(words)}", style="dim"), soft_wrap=True)
            words = ["dataflow", "debug", path, name, *code, "--do", "diff"]
            out.print(Text(f"next: {shlex.join(words)}", style="dim"), soft_wrap=True)
    elif options.json:
        values = [c.as_json() | more for c, more in zip(checked, found, strict=True)]
        print_json({"passed": all(c.passed for c in checked), "recordings": values})
    else:
        print_many(out, checked)
    if not options.json:
        for one, each in zip(checked, reasons, strict=False):
            print_reasons(out, "" if single else one.name, each)
    if options.junit is not None:
        from dataflow.cli.support.junit import write_junit

        write_junit(options.junit, checked)


def _may_be_a_test(report: VerifyReport, operator: str, reasons: list[list[CauseReport]]) -> bool:
    """Returns whether a call of an operator that differs can be a test: it differs alike each time, and not by chance.

    One that is as it was recorded depends on something else: without the reasons it is not known whether that stays.
    """
    told = [why for each in reasons for why in each if why.operator == operator and not why.refused]
    if report.repeats(operator) is False or any(why.chance for why in told):
        return False
    known = next(v.code_known for v in report.operators if v.operator == operator)
    return bool(told) or not known or bool(report.altered(operator))


def _mind_baseline(known: Baseline, checked: list[Checked], *, accept: bool, whole: bool) -> None:
    """Reports what the baseline names in vain; with `accept`, takes over the differences and lists them."""
    if not accept:
        if whole and (unused := known.unused(checked)):
            names = escape(", ".join(unused))
            say(f"[yellow]note:[/] {escape(str(known.file))} names recordings that were not verified: {names}")
        return
    news = []
    for one in checked:
        if one.report is None:
            continue
        changed, refused = known.accept(one)
        news += [f"{one.name}: {name}" for name in changed]
        for name in refused:
            say(
                f"[yellow]not accepted:[/] {escape(one.name)}: {name} (not wholly verifiable, or different each time: "
                "it could not be recognised again)"
            )
    known.save()
    say(escape(f"accepted into {known.file}: " + ("; ".join(news) if news else "nothing new")))


def _exit_code(checked: list[Checked], accepted: Baseline | None) -> int:
    if any(c.report is None or c.report.absent for c in checked):
        return COULD_NOT_RUN
    if accepted is None or any(c.report is not None and (c.report.empty or c.report.changed) for c in checked):
        return 0 if all(c.passed for c in checked) else DIFFERENT
    left = [
        j
        for c in checked
        for j in c.judged
        if not j.passed and (not j.firm or accepted.of(c.path).get(j.operator) != j.outcome)
    ]
    return DIFFERENT if left else 0
