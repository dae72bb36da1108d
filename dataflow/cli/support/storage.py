"""Storage of a recording, as options say it: its name by the time, its parts, limits, and readers."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from dataflow.cli.support.arguments import output_file
from dataflow.cli.support.options import option
from dataflow.cli.support.output import fail
from dataflow.cli.support.quantities import parsed_duration, parsed_size

if TYPE_CHECKING:
    from dataflow.recording.parts import Splitting, Storage

OUTPUT, RECORDING = "Results", "Recording"
PARTS_KEPT = 10
"""Parts into which the bytes to keep are divided, where no size of one is given."""

SplitEvery = Annotated[
    str | None,
    option("--split-every TIME", "A new file, NAME_000.mcap and so on, after this event time: 60s, 5min.", RECORDING),
]
SplitSize = Annotated[str | None, option("--split-size SIZE", "A new file after so many bytes: 500MB, 2GB.", RECORDING)]
Readable = Annotated[
    Literal["owner", "group", "all"],
    option("--readable owner|group|all", "Who may read the files that are written. Default: you alone.", RECORDING),
]
MODES = {"owner": 0o600, "group": 0o640, "all": 0o644}


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """The recording of a run, and how its files are stored."""

    record: Annotated[Path | None, option("--record FILE.mcap", "Record the graph's streams and firings.", OUTPUT)] = (
        None
    )
    compression: Annotated[
        Literal["zstd", "lz4", "none"] | None,
        option(
            "--compression zstd|lz4|none",
            "How the recording is compressed: zstd gives the smallest file, lz4 takes less CPU time. Default: zstd.",
            OUTPUT,
        ),
    ] = None
    split_every: SplitEvery = None
    split_size: SplitSize = None
    keep_disk: Annotated[
        str | None,
        option(
            "--keep-disk SIZE",
            "Delete the oldest files of this recording while all of them take more than this: 20GB. It is split "
            "by a tenth of that, or by --split-size.",
            RECORDING,
        ),
    ] = None
    record_failure: Annotated[
        Literal["go_on", "end"] | None,
        option(
            "--record-failure go_on|end",
            "When the disk is full or the recorder fails: the run goes on, and what is lost is counted (default "
            "of a live run), or it ends (default of any other).",
            RECORDING,
        ),
    ] = None
    readable: Readable = "owner"

    def storage(self, *, flight: bool = False) -> Storage:
        """Storage of the recording; ends the command where nothing is recorded. `flight`: a flight recorder does."""
        from dataflow.recording.parts import Storage

        whole = {"--split-every": self.split_every, "--split-size": self.split_size, "--keep-disk": self.keep_disk}
        either = {"--record-failure": self.record_failure, "--compression": self.compression}
        for name, given in (whole if flight else {**whole, **either}).items():
            if given is not None and self.record is None:
                raise fail(f"{name} is of a recording: name one with --record")
        kept = None if self.keep_disk is None else parsed_size("--keep-disk", self.keep_disk)
        splitting = splitting_of(self.split_every, self.split_size, self.keep_disk)
        return Storage(splitting, kept, self.record_failure, MODES[self.readable])


def named(path: Path) -> Path:
    """A file name with `{time}` replaced by the date and time now (UTC), such as 2026-11-28T211030Z."""
    if "{time}" not in path.name:
        return path
    now = time.strftime("%Y-%m-%dT%H%M%SZ", time.gmtime())
    suffixes = ("", *(f"-{k}" for k in range(2, 1000)))  # for a clock that stands still: a machine without a battery
    names = (path.with_name(path.name.replace("{time}", now + suffix)) for suffix in suffixes)
    return next(name for name in names if not _taken(name))


def _taken(path: Path) -> bool:
    from dataflow.recording.parts import parts_of

    return path.exists() or bool(parts_of(path))


def recording_file(path: Path, splitting: Splitting | None, *, overwrite: bool, option: str) -> Path:
    """`path`, checked as a recording to write, which may be split: none of its parts may be there unasked."""
    from dataflow.recording.parts import parts_of

    splits = splitting is not None and splitting.splits
    if splits and not overwrite and (there := parts_of(path)):
        raise fail(f"{there[0]} exists; name another file, or replace its parts with --overwrite")
    return output_file(path, ".mcap", overwrite=overwrite or splits, option=option)


def splitting_of(every: str | None, size: str | None, keep: str | None = None) -> Splitting:
    """The limits of one file, by the options."""
    from dataflow.recording.parts import Splitting

    time_ns = None if every is None else parsed_duration("--split-every", every)
    if time_ns == 0:
        raise fail(f"--split-every {every}: expected more than nothing")
    most = None if size is None else parsed_size("--split-size", size)
    if keep is not None:
        whole = parsed_size("--keep-disk", keep)
        if most is not None and most > whole // 2:
            raise fail(f"--keep-disk {keep} holds less than two files of --split-size {size}")
        most = most or max(whole // PARTS_KEPT, 1)
    return Splitting(most, time_ns)
