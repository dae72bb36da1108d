"""Prints why operators do not repeat: causes, the lines that led to them, and what to use instead."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from dataflow.causes.sources import (
    ENTROPY,
    FILE,
    FOLDER,
    HEAP,
    IDENTITY,
    MONOTONIC,
    NUMPY,
    PROCESS,
    RANDOM,
    SOURCES,
    THREADS,
    UUID,
    WALL,
    kind_of,
)
from dataflow.causes.why import Cause, CauseReport
from dataflow.cli.support.output import count, plural, seconds, table

OUTSIDE = "files that C libraries read, files that are gone, devices, services"
"""Sources that --why does not see."""
_READS = {
    WALL: "reads the wall clock",
    MONOTONIC: "reads the monotonic clock",
    ENTROPY: "reads the entropy of the system",
    PROCESS: "reads the number of its process",
    RANDOM: "draws from a generator that nothing seeded",
    NUMPY: "draws from a generator of numpy that nothing seeded",
    UUID: "makes random identifiers",
    IDENTITY: "calls id()",
    THREADS: "starts threads",
    HEAP: "takes fresh memory",
}
"""The words for what an operator does with a source of chance."""


def as_recorded(*, code_known: bool) -> str:
    """Returns what may have changed where all that the recording holds is as it was then."""
    if code_known:
        return (
            "its code, parameters, libraries and machine are as recorded: what it reads from outside may have changed"
        )
    return (
        "its parameters, libraries and machine are as recorded: its code, of which the recording has no digests, or "
        "what it reads from outside may have changed"
    )


def print_reasons(console: Console, recording: str, reasons: Sequence[CauseReport]) -> None:
    """A table of all causes, then a line for each operator about what was tried."""
    causes = table("operator", "depends on", "where", "calls", "instead", right=("calls",))
    for found in reasons:
        for cause in found.causes:
            first, *more = [f"{Path(site.file).name}:{site.line} {site.call}".rstrip() for site in cause.sites] or ["–"]
            calls = count(cause.calls) if cause.sites else ""
            causes.add_row(*map(Text, (found.operator, cause.what, first, calls, cause.instead)))
            for line in more:
                causes.add_row("", "", Text(line), "", "")
    if recording:
        console.print(Text(recording, style="bold"))
    if causes.row_count:
        console.print(causes)
    for found in reasons:
        for line in _lines(found):
            console.print(Text(line), soft_wrap=True)


def _lines(found: CauseReport) -> Iterator[str]:
    if found.refused:
        yield f"{found.operator}: no cause looked for: {found.refused}"
        return
    if not found.causes and not found.changed:
        for read in found.reads:
            tried = f"no effect seen in {plural(found.reruns, 're-run')}"
            yield f"{found.operator}: {_READS.get(read.kind, f'reads {read.kind}')} at {_lines_of(read)}; {tried}"
    yield f"{found.operator}: {_outcome(found)} ({plural(found.reruns, 're-run')}, {seconds(found.seconds)})"
    if found.repeats:
        for fact in found.changed:
            yield f"{found.operator}: not as it was recorded: {fact}"
    for cause in found.also:
        yield f"{found.operator}: its results also depend on {_also(cause)}"
    for group in found.open:
        yield f"{found.operator}: not tried by itself, re-runs were used up: {_list(group)}"
    for source, reason in (found.left_out or {}).items():
        yield f"{found.operator}: not tried: {source}: {reason}"


def _also(cause: Cause) -> str:
    where = f" ({_lines_of(cause)})" if cause.sites else ""
    return f"{cause.what}{where}, {'older than' if cause.kind in (FILE, FOLDER) else 'not known for'} the recording"


def _lines_of(cause: Cause) -> str:
    return ", ".join(f"{Path(site.file).name}:{site.line}" for site in cause.sites)


def _outcome(found: CauseReport) -> str:
    if found.repeats and found.changed and found.causes:
        return "it repeats here; besides the causes above, this is not as it was recorded"
    if found.causes:
        return "each cause shown by its effect: with it alone free or changed, the results differ"
    if found.repeats and found.changed:
        return "it repeats here, and this is not as it was recorded"
    if found.repeats:
        rare = "what it reads, as above, may show in few runs; " if found.reads else ""
        return f"it repeats here, and {as_recorded(code_known=found.code_known)} ({rare}{OUTSIDE})"
    if found.settled is False:
        return "it does not repeat even with all known sources of chance fixed (a device, a service, a thread?)"
    freed = "those that were tried" if found.open else "each of them"
    return f"with all known sources of chance fixed it repeats, and with {freed} free, too"


def _list(sources: Sequence[str]) -> str:
    return ", ".join(f"{kind_of(source)} ({SOURCES[kind_of(source)].meaning})" for source in sources)
