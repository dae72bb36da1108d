"""How a simulated run is recorded: whole or thin, in one file or in parts, or by a flight recorder; and what must hold
of its files."""

from __future__ import annotations

import random
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dataflow.editing.merge import merge
from dataflow.recording import Recording
from dataflow.recording.parts import WHOLE, OnFailure, Splitting, Storage, parts_of
from dataflow.recording.streams.copying import Origin
from dataflow.supervision.core.report import RunReport
from simulation.flights import RECORDED
from simulation.world import Violation

EVERYTHING = ""
ONE_FILE = Storage(on_failure="end")
SOURCES = "topics: ['*/fast', '*/slow', '*/constant']"
CHOICES = (SOURCES, "topics: []", "exclude: ['*/y']", "exclude: ['left/fast']", "exclude: ['**/y', '*/half']")
STATES = ("", "", "snapshots: 60ms", "snapshots: cpu")
MILLISECONDS = 1_000_000


@dataclass(frozen=True, slots=True)
class Keeping:
    """`topics`, `states`: fields of the graph's `record:`; `storage`: of the files; `flight`: the run has a flight
    recorder instead of a recording."""

    topics: str = EVERYTHING
    states: str = ""
    storage: Storage = ONE_FILE
    flight: bool = False

    @property
    def section(self) -> str:
        """The line of the graph's file."""
        fields = [RECORDED] if self.flight else [field for field in (self.topics, self.states) if field]
        return f"record: {{{', '.join(fields)}}}\n" if fields else ""

    @property
    def has_parts(self) -> bool:
        return self.storage.splitting.splits or self.storage.on_failure == "go_on"

    def __str__(self) -> str:
        if self.flight:
            return ", flight recorder"
        storage = self.storage
        words = [field for field in (self.topics, self.states) if field]
        words += [f"split by {storage.splitting}"] if storage.splitting.splits else []
        words += [f"{storage.keep} bytes kept"] if storage.keep is not None else []
        words += ["goes on without a recording"] if storage.on_failure == "go_on" else []
        return "".join(f", {word}" for word in words)


PLAIN = Keeping()


def keeping_of(r: random.Random, plain: Keeping) -> Keeping:
    """Returns how a run is recorded: most are recorded whole, in one file."""
    states = r.choice(STATES) or plain.states
    match r.choices(("whole", "thin", "parts", "flight"), (50, 20, 22, 8))[0]:
        case "thin":
            return Keeping(r.choice((SOURCES, *CHOICES)), states)
        case "parts":
            every = r.choice((None, 50, 100, 400))
            size = r.choice((None, 4_000, 60_000)) if every is not None else r.choice((4_000, 60_000))
            splitting = Splitting(size, None if every is None else every * MILLISECONDS) if r.random() < 0.8 else WHOLE
            kept = r.choice((30_000, 200_000)) if splitting.splits and r.random() < 0.2 else None
            goes_on: OnFailure = "go_on" if not splitting.splits or r.random() < 0.5 else "end"
            return Keeping(EVERYTHING, states, Storage(splitting, kept, goes_on))
        case "flight":
            return Keeping(storage=Storage(on_failure=r.choice(("go_on", "end"))), flight=True)
    return Keeping(EVERYTHING, states)


def thinner(keeping: Keeping, r: random.Random) -> Keeping:
    """Returns a recording in parts that holds fewer streams; some are left as they are, and all others."""
    if not keeping.has_parts or keeping.flight or r.random() < 0.7:
        return keeping
    return replace(keeping, topics=r.choice((SOURCES, *CHOICES)))


def files_of(path: Path) -> list[Path]:
    """Returns the files of a recording, in order."""
    return [each for each in (path, *parts_of(path)) if each.exists()]


def joined(files: list[Path], out: Path) -> Path:
    """Joins the files of a recording into one, as `dataflow merge` does."""
    if len(files) == 1:
        return files[0]
    with ExitStack() as stack:
        origins = [stack.enter_context(Origin(file)) for file in files if file.stat().st_size]
        merge(origins, out, overwrite=True)
    return out


def check_losses_of_files(report: RunReport, path: Path, recorded: Iterable[str]) -> None:
    """Every message that was made is in the files, or counted as lost by the recorder or on the way to it."""
    facts = report.files["@recorder"]
    lost: dict[str, int] = facts.get("lost", {}).get("streams", {})
    missed = sum(n for _, why, n in report.drops.get("@recorder", ()) if why == "missed")
    with Recording(path) as recording:
        stored = {name: stream.count for name, stream in recording.streams.items()}
    for stream in recorded:
        made, _ = report.streams.get(stream, (0, ""))
        maker = stream.rpartition("/")[0].partition("/")[2]
        if report.restarts.get(maker):
            continue
        there = stored.get(stream, 0) + lost.get(stream, 0)
        if not made - missed <= there <= made:
            raise Violation(
                f"of {made} messages of {stream} {stored.get(stream, 0)} are stored, and {lost.get(stream, 0)} are "
                f"counted as lost"
            )


def kept_by_flight(report: RunReport, *, full: bool) -> list[dict[str, Any]]:
    """What a flight recorder says that it has kept. Raises `Violation` where it could not, and no disk was `full`."""
    kept: list[dict[str, Any]] = list(report.files["@recorder"]["kept"])
    for one in kept:
        if "error" in one and not full:
            raise Violation(f"the flight recorder could not keep what was asked for: {one['error']}")
    return [one for one in kept if "error" not in one]
