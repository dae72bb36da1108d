"""`dataflow lint`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from dataflow.cli.support.arguments import AnyRecording, Json, Overwrite, existing, existing_recording, output_file
from dataflow.cli.support.options import option
from dataflow.cli.support.output import DIFFERENT, count, out, plural, print_json, shown, table

if TYPE_CHECKING:
    from dataflow.lint.checks import Report
    from dataflow.lint.inputs import LintInput

_STYLES = {"error": "bold red", "warning": "yellow", "note": "dim"}


def lint(
    recording: AnyRecording,
    contract: Annotated[
        Path | None, option("--contract FILE.yaml", "What the recording has to hold, kept with your code.")
    ] = None,
    write: Annotated[
        Path | None, option("--write-contract FILE.yaml", "Write a contract that this recording keeps.")
    ] = None,
    quick: Annotated[bool, option("--quick", "Leave the clocks out, for which images are decoded.")] = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Look for what is wrong with recorded data.

    Gaps, timestamps that repeat or go back, rates, streams that begin late or end early, frames that hang on nothing or
    have two parents. Clocks: gyroscopes, wheels, odometry, poses and images all show how the robot turns; where their
    timestamps do not fit, the offset is reported with its sign (+: the timestamps are late) and its drift. The clock
    that most streams have is taken for right, unless the contract names one.

    Exit codes:

      0    nothing was found (notes aside)
      1    something was
      2    could not run: no such file, a contract that cannot be read

    Examples:

      dataflow lint run.mcap
      dataflow lint run.mcap --write-contract robot.yaml
      dataflow lint run.mcap --contract robot.yaml --json
      dataflow lint rosbag2_folder --quick
    """
    from dataflow.lint.checks import lint as look
    from dataflow.lint.contract import load_contract, proposed

    if write is not None:
        output_file(write, ".yaml", overwrite=overwrite, option="--write-contract")
    terms = None if contract is None else load_contract(existing(contract, "a contract"))
    with _input(existing_recording(recording)) as data:
        report = look(data, terms, clocks=not quick)
        shown(finding.text for finding in report.findings)
        if write is not None:
            name, namespace = recording.stem, data.namespace
            text = proposed(name, namespace, data.streams, report.timings, report.root)
            write.write_text(text, encoding="utf-8")
    if json:
        print_json(report.to_json())
    else:
        _print(report, f"{data.namespace}/" if data.namespace else "", write)
    if not report.sound:
        raise typer.Exit(DIFFERENT)


@contextmanager
def _input(path: Path) -> Iterator[LintInput]:
    """A recording of ours, or a bag."""
    from dataflow.interop.opening import is_foreign, open_bag
    from dataflow.lint.bags import BagInput
    from dataflow.lint.inputs import RecordingInput
    from dataflow.recording import Recording

    if is_foreign(path):
        with closing(open_bag(path)) as bag:
            yield BagInput(bag)
    else:
        with Recording(path) as opened:
            yield RecordingInput(opened)


def _print(report: Report, prefix: str, written: Path | None) -> None:
    numbers = ("messages", "Hz", "longest ms", "clock ms", "drift ms/s")
    shown = table("stream", *numbers, right=numbers)
    for name, timing in report.timings.items():
        clock = report.clocks.get(name)
        reference = name == report.reference
        shown.add_row(
            Text(name.removeprefix(prefix)),
            count(timing.count),
            f"{timing.rate:.4g}" if timing.steady else "",
            f"{timing.longest * 1e3:,.1f}" if timing.longest else "",
            "reference" if reference else "" if clock is None else _deviating(clock.offset, clock.offset_deviation),
            "" if reference or clock is None else _deviating(clock.drift, clock.drift_deviation),
        )
    out.print(shown)
    for finding in report.findings:
        line = Text.assemble((f"{finding.severity:<8}", _STYLES[finding.severity]), (f"{finding.check}  ", "dim"))
        if finding.stream:
            line.append(f"{finding.stream.removeprefix(prefix)}: ", style="bold")
        line.append(finding.text)
        if finding.at is not None:
            from dataflow.sync.stamps import format_stamp

            line.append(f"; first at {format_stamp(finding.at)}", style="dim")
        out.print(line, soft_wrap=True)
    if report.findings:
        out.print(Text(plural(len(report.findings), "finding"), style="bold"))
    elif report.timings:
        out.print(Text("nothing was found", style="green"))
    else:
        out.print(Text("there is no stream that could be looked at", style="yellow"))
    if written is not None:
        out.print(Text(f"wrote {written}: look it over, and keep it with your code"), soft_wrap=True)


def _deviating(value: float, deviation: float) -> str:
    return f"{value * 1e3:+.1f} ± {deviation * 1e3:.1f}"
