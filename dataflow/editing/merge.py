"""Merges recordings: the parts of one run into one again, or streams of several into one file."""

from __future__ import annotations

import json
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.editing.joins import Joined
from dataflow.editing.part import Reading, as_stored, copy_messages, graph_of, kept_stamps, makers_of
from dataflow.editing.report import Watch, WrittenFile, unwatched
from dataflow.editing.rolling import once
from dataflow.editing.spool import Spool
from dataflow.recording import Recorded, Recording
from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import CUT, DIGESTS, ENDS, GRAPH, RECORDING, RUN, Kind
from dataflow.recording.mcap.attachments import names_once, tells_of_run
from dataflow.recording.mcap.packing import Compression
from dataflow.recording.streams.copying import Copy, Mask, Origin, framing
from dataflow.recording.streams.cutting import Cut, cut_of
from dataflow.recording.streams.part_folder import NOTHING_IN_IT, holds_nothing
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.sync.stamps import format_stamp

Records = Mapping[str, Iterable[FiringRecord]]
Items = list[tuple[str, Hashable]]


def merge(
    origins: Sequence[Origin],
    out: Path,
    *,
    prefixes: Sequence[str] = (),
    compression: Compression = "zstd",
    overwrite: bool = False,
    watch: Watch = unwatched,
) -> WrittenFile:
    """Writes what all of `origins` hold into one file.

    Parts of one run are joined: what several hold is taken once, and their firing records become one log. Of other
    recordings the run of the first one counts, with its graph and firing records; the others give their streams.
    `prefixes` are put before the names of the streams of each. Attachments and metadata of all go along
    (`_take_over`). Files without a message whose writer died are passed over. Raises `RecordingError` for names
    that clash.
    """
    done = WrittenFile(str(out))
    prefixes = [*prefixes, *[""] * (len(origins) - len(prefixes))]
    if bare := [origin for origin in origins if holds_nothing(origin.file)]:
        done.notes += [f"{origin.path} {NOTHING_IN_IT}" for origin in bare]
        prefixes = [p for origin, p in zip(origins, prefixes, strict=True) if origin not in bare]
        origins = [origin for origin in origins if origin not in bare]
    if not origins:
        raise RecordingError("nothing is in any of these files")
    one_run = not any(prefixes) and are_of_one_run(origins)
    with ExitStack() as stack:
        if one_run:
            origins = sorted(origins, key=_begin)
        copy = stack.enter_context(Copy(out, origins[0], compression=compression, overwrite=overwrite))
        if one_run:
            kept = _taken_once(origins)
            spool = stack.enter_context(Spool(out.parent, _joined_records(origins)))
            facts = _joined_metadata(origins, done, left_out=spool.left_out)
        else:
            _refuse_clashes(origins, prefixes)
            kept = [_all_of(origin, run=not k and not prefixes[0]) for k, origin in enumerate(origins)]
            spool = stack.enter_context(Spool(out.parent, {} if prefixes[0] else _records_of(origins[0])))
            facts = {name: dict(v) for name, v in origins[0].metadata.items() if _is_fact(origins[0], name)}
            _tell_clocks(origins, done)
            _tell_runs(origins, prefixes, done)
        done.firings = spool.calls
        total = sum(int(mask.sum()) for masks in kept for mask in masks.values())
        for name, values in facts.items():
            copy.writer.add_metadata(name, values)
        _take_over(copy, origins, [p.rstrip("/") for p in prefixes], done, joined=one_run)
        spool.write(copy, origins)
        before = 0
        for origin, masks, prefix in zip(origins, kept, prefixes, strict=True):
            topics = {c: prefixed(prefix, origin.channels[c].topic) for c in masks} if prefix else {}
            copy_messages(copy, origin, masks, _further(watch, before, total), topics)
            before += sum(int(mask.sum()) for mask in masks.values())
            done.lose(origin)
        copy.frames(prefixes[0] + origins[0].namespace, _framing(origins, kept))
    done.bytes = out.stat().st_size
    with Origin(out) as made:
        done.streams, done.span = {s: n for s, n in sorted(made.counts().items()) if n}, made.span()
    return done


def _is_fact(origin: Origin, name: str) -> bool:
    """Returns whether a metadata record of `origin` describes its run, rather than being added later."""
    return origin.own and tells_of_run(name)


def _take_over(
    copy: Copy, origins: Sequence[Origin], labels: Sequence[str], done: WrittenFile, *, joined: bool = False
) -> None:
    """Writes the attachments of all files, and their metadata records but for those that describe the first one's run.

    What two files hold equally is taken once. Of one name and other content, the later file's is kept as `LABEL/NAME`,
    with the label of that file, or its stem where that is empty. So are records that describe a later file's run,
    unless the files are parts of one (`joined`). Renamed ones are noted.
    """
    called = [label or origin.path.stem for label, origin in zip(labels, origins, strict=True)]
    attached: list[Items] = [
        [(found.name, found.key) for found in map(origin.file.attachment, origin.file.attachments)]
        for origin in origins
    ]
    names = names_once(list(zip(called, attached, strict=True)))
    for origin, items, chosen in zip(origins, attached, names, strict=True):
        copy.attachments(origin, chosen)
        _note_renamed("attachment", origin, [name for name, _ in items], chosen, done)
    done.attachments = copy.attached

    records = [
        [
            (f"{label}/{name}" if _is_fact(origin, name) else name, values)
            for name, values in origin.records()
            if not _is_fact(origin, name) or (number and not joined)
        ]
        for number, (origin, label) in enumerate(zip(origins, called, strict=True))
    ]
    contents: list[Items] = [[(name, tuple(sorted(values.items()))) for name, values in listed] for listed in records]
    names = names_once(list(zip(called, contents, strict=True)))
    for origin, listed, chosen in zip(origins, records, names, strict=True):
        for (_, values), name in zip(listed, chosen, strict=True):
            if name is not None:
                copy.writer.add_metadata(name, values)
        _note_renamed("metadata", origin, [name for name, _ in listed], chosen, done)


def _note_renamed(
    what: str, origin: Origin, names: Sequence[str], chosen: Sequence[str | None], done: WrittenFile
) -> None:
    for name, given in zip(names, chosen, strict=True):
        if given not in (name, None):
            done.notes.append(
                f"{what} {name!r} of {origin.path.name} differs from that of a file before it: kept as {given!r}"
            )


def prefixed(prefix: str, name: str) -> str:
    """A stream's name behind a prefix; ROS's absolute names stay absolute: `/imu` behind `rear/` is `/rear/imu`."""
    return f"/{prefix.strip('/')}{name}" if prefix.endswith("/") and name.startswith("/") else prefix + name


def are_of_one_run(origins: Sequence[Origin]) -> bool:
    """Returns whether recordings hold parts of one run: the same run of the same graph, by what they say of it."""
    said = [[o.metadata.get(name) for name in (RUN, GRAPH, RECORDING)] for o in origins]
    return len(origins) > 1 and said[0][0] is not None and all(one == said[0] for one in said)


def _begin(origin: Origin) -> tuple[int, int]:
    part, span = cut_of(origin.metadata), origin.span() or (0, 0)
    return (span[0], span[1]) if part is None or part.start is None else (part.start, span[1])


def _further(watch: Watch, before: int, total: int) -> Watch:
    return lambda done, _: watch(before + done, total)


def _records_of(origin: Origin) -> Records:
    """The firing records of a file, read from it as long as it is open."""
    return as_stored(Recording(origin.path, file=origin.file)) if origin.of_kind(Kind.FIRINGS) else {}


def _joined_records(origins: Sequence[Origin]) -> Records:
    """Those of all parts of a run, each once, read from them as long as they are open."""
    recordings = [Recording(origin.path, file=origin.file) for origin in origins]
    graph = graph_of(recordings[0])
    logs = [FiringLog.read(recording) for recording in recordings]
    makers = {name: maker for log in logs for name, maker in makers_of(graph, log).items()}
    return {
        name: Joined([Reading(partial(log.repeated, maker)) for log in logs], tuple(maker.outputs.values()))
        for name, maker in sorted(makers.items())
    }


def _joined_metadata(origins: Sequence[Origin], done: WrittenFile, *, left_out: bool) -> dict[str, dict[str, str]]:
    """The run's metadata: streams end where they end in the last part; a part stays one unless all of it is there, and
    no calls are `left_out`."""
    metadata = {n: dict(values) for o in origins for n, values in o.metadata.items() if _is_fact(o, n)}
    metadata.pop(DIGESTS, None)
    ends: dict[str, dict[str, Any]] = {}
    for origin in origins:
        for stream, text in origin.metadata.get(ENDS, {}).items():
            end, known = json.loads(text), ends.get(stream)
            if known is None or (end["final"] or 0) >= (known["final"] or 0):
                ends[stream] = end
    if ends:
        metadata[ENDS] = {stream: json.dumps(end) for stream, end in ends.items()}
    parts = [cut_of(o.metadata) or Cut(o.path.name, None, None) for o in origins]
    gaps = list(_gaps(parts))
    done.notes += [f"nothing is known of {format_stamp(end)} to {format_stamp(start)}" for end, start in gaps]
    start = None if any(p.start is None for p in parts) else min(p.start for p in parts if p.start is not None)
    end_stamp = None if any(p.end is None for p in parts) else max(p.end for p in parts if p.end is not None)
    metadata.pop(CUT, None)
    if gaps or left_out or start is not None or end_stamp is not None:
        metadata[CUT] = Cut(parts[0].of, start, end_stamp).metadata()
    return metadata


def _gaps(parts: Sequence[Cut]) -> Iterator[tuple[int, int]]:
    """Yields from where to where (stamps, ns) no part reaches, of parts in the order of their beginnings.

    A part may lie within another: its stamps were new again after a jump of the clock, or it was cut out besides. One
    without an end reaches to that of the run.
    """
    reached: int | None = None
    for part in parts:
        if reached is not None and part.start is not None and part.start > reached + 1:
            yield reached, part.start
        if part.end is None:
            return
        reached = part.end if reached is None else max(reached, part.end)


def _taken_once(origins: Sequence[Origin]) -> list[dict[int, Mask]]:
    """The messages of each part that none before it holds."""
    kept = once(origins, [_all_of(origin, run=True) for origin in origins])
    reached: dict[str, int] = {}
    for origin, masks in zip(origins, kept, strict=True):
        said = origin.of_kind(Kind.EVENTS, Kind.LOGS)
        for channel in said.values():
            masks[channel.id] = origin.entries(channel.id).times > reached.get(channel.topic, -1)
        for channel in said.values():
            reached[channel.topic] = max(reached.get(channel.topic, -1), _begin(origin)[1])
    return kept


def _all_of(origin: Origin, *, run: bool) -> dict[int, Mask]:
    """All messages of streams; `run`: what happened in the run, too."""
    kinds = (Kind.STREAM, Kind.COMPANION, *((Kind.EVENTS, Kind.LOGS) if run else ()))
    return {c: np.ones(len(origin.entries(c)), bool) for c in origin.of_kind(*kinds)}


def _framing(origins: Sequence[Origin], kept: Sequence[Mapping[int, Mask]]) -> Iterator[Recorded]:
    for origin, masks in zip(origins, kept, strict=True):
        if origin.own:
            yield from framing(origin.path, kept_stamps(origin, masks))


def _refuse_clashes(origins: Sequence[Origin], prefixes: Sequence[str]) -> None:
    known: dict[str, Origin] = {}
    clashing: list[str] = []
    files: tuple[Origin, Origin] | None = None
    for origin, prefix in zip(origins, prefixes, strict=True):
        for name in origin.counts():
            other = known.setdefault(prefixed(prefix, name), origin)
            if other is not origin:
                clashing.append(prefixed(prefix, name))
                files = files or (other, origin)
    if files is not None:
        more = f" and {len(clashing) - 4} more" if len(clashing) > 4 else ""
        first, second = (origin.path for origin in files)
        raise RecordingError(
            f"{first} and {second} are not parts of one run, and both hold {', '.join(clashing[:4])}{more}: put"
            " something before the names of one of them (--prefix FILE=NAME/), or leave streams out with "
            "`dataflow filter`"
        )


def _tell_clocks(origins: Sequence[Origin], done: WrittenFile) -> None:
    """Prints when each was recorded, and that streams of different times or clocks do not meet."""
    spans = [(origin, span) for origin in origins if (span := origin.span()) is not None]
    for origin, (first, last) in spans:
        done.notes.append(f"{origin.path.name}: {format_stamp(first)} to {format_stamp(last)}")
    for (one, a), (other, b) in pairwise(sorted(spans, key=lambda s: s[1])):
        if b[0] > a[1]:
            gap = (b[0] - a[1]) * 1e-9
            done.notes.append(
                f"{one.path.name} ends {gap:.3g} s before {other.path.name} begins: recorded one after the other, or "
                "by clocks that differ; nothing is shifted"
            )


def _tell_runs(origins: Sequence[Origin], prefixes: Sequence[str], done: WrittenFile) -> None:
    left_out = [o.path.name for k, o in enumerate(origins) if (k or prefixes[0]) and o.of_kind(Kind.FIRINGS)]
    if left_out:
        done.notes.append(f"of {', '.join(left_out)}: streams alone, without graph, firing records and log")
