"""Execution of a graph by a command: outputs checked before, progress meanwhile, the report afterwards."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape

from dataflow.cli.support.arguments import output_file
from dataflow.cli.support.output import DIFFERENT, INTERRUPTED, about_a_file, err, fail, out, print_json, say, size
from dataflow.cli.support.run_options import TIMEOUT, PlacementOptions
from dataflow.cli.support.storage import named, recording_file

if TYPE_CHECKING:
    from dataflow.cli.support.run_options import ReportOptions, ViewOptions
    from dataflow.cli.support.storage import RecordOptions
    from dataflow.graph import Graph
    from dataflow.recording.parts import Storage
    from dataflow.supervision.core.report import RunFailed, RunReport, Watch


@dataclass(frozen=True, slots=True)
class Outputs:
    """Outputs of a run, checked before anything starts."""

    record: Path | None
    view_file: Path | None
    live_view: str | None
    open_file: bool
    overwrite: bool
    storage: Storage | None = None
    compression: str | None = None


def checked_outputs(recorded: RecordOptions, viewed: ViewOptions, *, overwrite: bool, flight: bool = False) -> Outputs:
    """Checks the options that name outputs; ends the command where they contradict each other or a file is there."""
    storage, record, view = recorded.storage(flight=flight), recorded.record, viewed.view
    saves = view is not None and view.endswith(".rrd")
    if view is not None and view not in ("spawn", "serve") and not saves:
        raise fail(f"--view {view!r}: expected spawn, serve, or a file name that ends in .rrd")
    if view is not None:
        import_module("rerun")  # before a run begins whose viewer could not
    if viewed.open_saved and not saves:
        raise fail("--open opens a saved file: it needs --view FILE.rrd")
    if view == "spawn":
        from dataflow.cli.support.viewers import require_display

        require_display()
    if record is not None:
        record = recording_file(named(record), storage.splitting, overwrite=overwrite, option="--record")
    view_file = Path(view) if view is not None and saves else None
    if view_file is not None:
        output_file(view_file, ".rrd", overwrite=overwrite, option="--view")
    live_view = None if saves else view
    return Outputs(record, view_file, live_view, viewed.open_saved, overwrite, storage, recorded.compression)


def plan_options(
    graph: Graph,
    outputs: Outputs,
    placement: PlacementOptions | None = None,
    *,
    rate: float | None = None,
    paranoid: bool = False,
    timeout: float = TIMEOUT,
) -> dict[str, Any]:
    """Returns the fields of a `RunPlan` that the options give."""
    stored: dict[str, Any] = {}
    if outputs.storage is not None:
        on_failure = outputs.storage.on_failure or graph.record.on_failure
        stored["storage"] = replace(outputs.storage, on_failure=on_failure)
    if outputs.compression is not None:
        stored["compression"] = outputs.compression
    return {
        **stored,
        "placement": (placement or PlacementOptions()).placement(graph),
        "record": outputs.record,
        "overwrite": outputs.overwrite,
        "view_file": outputs.view_file,
        "rate": rate,
        "paranoid": paranoid,
        "stall_timeout": timeout,
        "start_timeout": timeout,
    }


def execute(
    start: Callable[[Watch | None], RunReport],
    graph: Graph,
    outputs: Outputs,
    shown_span: tuple[int, int] | None,
    told: ReportOptions,
    *,
    began: float,
) -> RunReport:
    """Runs it; ends the command where it was interrupted, or where its recording lacks something."""
    from dataflow.cli.support.progress import RunDisplay, shown
    from dataflow.cli.support.report import is_lacking, print_report, report_json
    from dataflow.cli.support.viewers import attached_viewer, open_saved
    from dataflow.supervision.core.report import RunFailed

    before = {file: _written(file) for file in _files_of(outputs)}
    display = RunDisplay(err, sources=[node.name for node in graph.sources()], span=shown_span)
    try:
        with attached_viewer(outputs.live_view), shown(err, display, quiet=told.quiet) as watch:
            report = start(watch)
    except RunFailed as failure:
        before = dict.fromkeys(_files_of(outputs)) | before
        _say_what_is_left(before, "end" if failure.interrupted else "failure")
        if about_a_file(failure.details) and (parameter := _named_by(failure, graph)) is not None:
            failure.add_note(f"name another with --set {parameter}=...")
        raise
    if told.json:
        print_json({**report_json(report), "total_s": time.monotonic() - began})
    else:
        print_report(out, report, total=time.monotonic() - began, verbose=told.verbose)
    if outputs.open_file and outputs.view_file is not None:
        open_saved(outputs.view_file)
    if report.interrupted:
        raise typer.Exit(INTERRUPTED)
    if any(map(is_lacking, report.files.values())):
        raise typer.Exit(DIFFERENT)
    return report


def _named_by(failure: RunFailed, graph: Graph) -> str | None:
    """The parameter, such as `camera.path`, whose value stands in a failure; the one with the longest value.

    Where a parameter of the graph fills it, that one.
    """
    node = graph.nodes.get(failure.operator or "")
    texts = {name: value for name, value in (node.params if node else {}).items() if isinstance(value, str) and value}
    # `imu` names neither the file imu.csv nor my_imu; what a full stop follows is named
    whole = r"(?<![\w.-])%s(?!\.?[\w-])"
    named = [name for name, value in texts.items() if re.search(whole % re.escape(str(Path(value))), str(failure))]
    if node is None or not named:
        return None
    from dataflow.graph.load import filled_by

    found = max(named, key=lambda name: len(texts[name]))
    return filled_by(graph, node.name, found) or f"{node.name}.{found}"


def _files_of(outputs: Outputs) -> list[Path]:
    """The files that outputs name, and the parts that there are of a recording."""
    from dataflow.recording.parts import parts_of

    parts = [] if outputs.record is None else parts_of(outputs.record)
    return [file for file in (outputs.record, *parts, outputs.view_file) if file is not None]


def _written(file: Path) -> tuple[int, int] | None:
    """Identifies the content of a file; None where there is no such file."""
    return (found.st_ino, found.st_mtime_ns) if file.exists() and (found := file.stat()) else None


def _say_what_is_left(before: dict[Path, tuple[int, int] | None], end: str) -> None:
    """After an `end` out of turn: which files hold what came before it, other than those that were there already."""
    for file, earlier in before.items():
        if file.exists() and _written(file) != earlier:
            say(f"[dim]{escape(str(file))} ({size(file.stat().st_size)}) holds what came before the {end}[/]")
