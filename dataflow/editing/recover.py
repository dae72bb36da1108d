"""Recovers what can be read of a torn or damaged MCAP file, and reports the losses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.editing.part import copy_messages, graph_of, outputs_of
from dataflow.editing.report import Watch, WrittenFile, unwatched
from dataflow.recording import Recording
from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import DIGESTS, RECOVERED, Kind
from dataflow.recording.mcap.packing import Compression
from dataflow.recording.streams.copying import Copy, Mask, Origin, places
from dataflow.recording.streams.cutting import cut_of
from dataflow.records.firing import WITHHELD
from dataflow.records.reading import FiringLog


@dataclass(slots=True)
class LostMessages:
    """Messages of a stream that are known to have been there, by their numbers or an index, and cannot be read.

    `after`: the stamp (ns) of the last saved message before the first of them; None where there is none, or it is not
    known.
    """

    stream: str
    messages: int
    after: int | None


@dataclass(slots=True)
class RecoveryReport:
    """Summarises what was saved into a file, and what is lost.

    `torn`: the broken file had no proper end; `lost_bytes`: of the unfinished record there. `damage`: for people.
    """

    saved: WrittenFile
    torn: bool
    lost_bytes: int
    damage: list[str] = field(default_factory=list)
    lost: list[LostMessages] = field(default_factory=list)

    @property
    def whole(self) -> bool:
        """Returns whether nothing is known to be lost."""
        return not (self.lost or self.lost_bytes or self.torn)

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "saved": self.saved.as_json(),
            "torn": self.torn,
            "lost_bytes": self.lost_bytes,
            "damage": self.damage,
            "lost": [asdict(loss) for loss in self.lost],
            "whole": self.whole,
        }


def recover(
    path: Path, out: Path, *, compression: Compression = "zstd", overwrite: bool = False, watch: Watch = unwatched
) -> RecoveryReport:
    """Writes everything that can be read of `path` into a file with a proper end and an index.

    Chunks that fail their checksum are left out. Raises `RecordingError` for what is no MCAP file at all.
    """
    if out.exists() and out.samefile(path):
        raise RecordingError(f"{out} is the file to be recovered; name another one")
    with Origin(path, lenient=True) as origin:
        attached = origin.file.attachments
        damage = list(origin.file.damage)
        broken = origin.file.broken_chunks()
        damage += [f"{where}: {why}" for where, why in broken.values()]
        kept = {c: ~np.isin(origin.entries(c).chunks, list(broken)) for c in origin.channels}
        with Copy(out, origin, compression=compression, overwrite=overwrite) as copy:
            for name, values in origin.records():
                if name != DIGESTS:
                    copy.writer.add_metadata(name, values)
            if origin.own:
                told = {"of": path.name, "lost_bytes": str(origin.file.lost_bytes), "damage": "\n".join(damage)}
                copy.writer.add_metadata(RECOVERED, told)
            copy.attachments(origin)
            copy_messages(copy, origin, kept, watch)
        saved = WrittenFile(str(out), {n: k for n, k in sorted(origin.counts(kept).items()) if k}, out.stat().st_size)
        saved.attachments = len(attached)
        lost = list(_by_numbers(origin, kept, out) if origin.own else _by_index(origin, kept))
        return RecoveryReport(saved, origin.file.torn, origin.file.lost_bytes, damage, lost)


def _by_index(origin: Origin, kept: Mapping[int, Mask]) -> Iterator[LostMessages]:
    """Yields the messages that an index lists in chunks that cannot be read."""
    for channel, mask in sorted(kept.items(), key=lambda item: origin.channels[item[0]].topic):
        if not mask.all():
            times = origin.entries(channel).times
            before = times[mask][times[mask] < times[~mask].min()]
            topic = origin.channels[channel].topic
            yield LostMessages(topic, int((~mask).sum()), int(before.max()) if len(before) else None)


def _by_numbers(origin: Origin, kept: Mapping[int, Mask], saved: Path) -> Iterator[LostMessages]:
    """The numbers that are missing in streams, up to the last one that is saved or that a firing record names."""
    found: dict[tuple[str, int], dict[int, int]] = {}
    streams = origin.of_kind(Kind.STREAM)
    for raw in places(origin, {c: m for c, m in kept.items() if c in streams}):
        channel = streams[raw.channel]
        base = channel.metadata.get("sequence_base", "0")
        place = (channel.topic, origin.incarnation(channel))
        found.setdefault(place, {})[int(base) + raw.sequence] = raw.log_time
    told = _told(saved)
    part = cut_of(origin.metadata)
    static = {c.topic for c in streams.values() if origin.is_static(c)}
    recorded = {c.topic for c in streams.values()} - static
    for stream, incarnation in sorted({p for p in found.keys() | told.keys() if p[0] in recorded}):
        numbers = found.get((stream, incarnation), {})
        last = max([*numbers, told.get((stream, incarnation), -1)])
        within = [n for n, stamp in numbers.items() if part is not None and stamp >= (part.start or 0)]
        first = 0 if part is None else min(within, default=last + 1)  # what a part holds from before it has gaps
        missing = [n for n in range(first, last + 1) if n not in numbers]
        if missing:
            before = [stamp for number, stamp in numbers.items() if number < missing[0]]
            yield LostMessages(stream, len(missing), max(before, default=None))


def _told(path: Path) -> dict[tuple[str, int], int]:
    """By stream and incarnation, the largest number that a firing record names."""
    told: dict[tuple[str, int], int] = {}
    with Recording(path) as recording:
        outputs = outputs_of(graph_of(recording))
        log = FiringLog.read(recording)
        for operator in log.operators:
            streams = outputs.get(operator, ())
            for record in log.records(operator):
                for stream, emission in zip(streams, record.outputs, strict=False):
                    if emission is not None and emission.seq != WITHHELD:
                        place = stream, record.incarnation
                        told[place] = max(told.get(place, -1), emission.seq)
    return told
