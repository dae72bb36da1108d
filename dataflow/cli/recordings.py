"""`dataflow info` and `diff`: what a recording holds, and where two differ."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dataflow.cli.execution import Json
from dataflow.cli.output import DIFFERENT, friendly_errors, out, print_json


def info(
    recording: Annotated[Path, typer.Argument(help="Any MCAP file.")],
    digests: Annotated[bool, typer.Option("--digests", help="Read everything and print each stream's digest.")] = False,
    json: Json = False,
) -> None:
    """Describe a recording: streams, types, counts, rates, firings, what made it.

    \b
    dataflow info recordings/demo.mcap
    dataflow info recordings/demo.mcap --digests --json
    """
    from dataflow.recording import Recording
    from dataflow.recording.info import describe

    with friendly_errors(), Recording(recording) as opened:
        described = describe(opened)
        computed = dict(opened.digests()) if digests else None
        if json:
            print_json(described.as_json() | ({} if computed is None else {"digests": computed}))
            return
        out.print(described.render())
        for stream, digest in (computed or {}).items():
            out.print(f"{digest}  {stream}", markup=False)


def diff(
    a: Annotated[Path, typer.Argument(help="A recording.")],
    b: Annotated[Path, typer.Argument(help="Another one.")],
    streams: Annotated[list[str] | None, typer.Option("--stream", help="Only these streams. May be repeated.")] = None,
    tolerance: Annotated[
        float | None, typer.Option(min=0, help="Numbers may differ by so much. Default: bit for bit.")
    ] = None,
    json: Json = False,
) -> None:
    """Compare two recordings stream by stream. Exit code 0: the same, 1: different, 2: could not compare.

    \b
    dataflow diff out/run.mcap out/replayed.mcap
    dataflow diff a.mcap b.mcap --stream robot1/odometry/odometry --tolerance 1e-6
    """
    from dataflow.recording import Recording
    from dataflow.recording.diff import diff as compare

    with friendly_errors(), Recording(a) as first, Recording(b) as second:
        report = compare(first, second, streams=streams, tolerance=tolerance)
        if json:
            print_json(report.as_json())
        else:
            out.print(report.table())
    if not report.same:
        raise typer.Exit(DIFFERENT)
