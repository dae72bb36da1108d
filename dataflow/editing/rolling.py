"""Joins files of a recording that goes on, and cuts a span out of them: what a flight recorder keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dataflow.editing.part import Part, copy_messages, decodable, kept_stamps, masks_of, outputs_of
from dataflow.editing.report import WrittenFile
from dataflow.editing.spans import RunRecords, listed
from dataflow.editing.spool import Spool
from dataflow.graph.model import Graph
from dataflow.recording.layout import CUT, DIGESTS, ENDS, OUTCOME, Kind
from dataflow.recording.parts import OWNER_ONLY
from dataflow.recording.streams.copying import Copy, Mask, Origin, framing
from dataflow.recording.streams.cutting import Cut
from dataflow.records.cuts import held_by
from dataflow.records.firing import FiringRecord

Seen = dict[tuple[str, str, int], npt.NDArray[np.int64]]


def keep_span(
    files: Sequence[Path],
    records: Mapping[str, Sequence[FiringRecord]],
    graph: Graph,
    part: Part,
    out: Path,
    *,
    metadata: Mapping[str, Mapping[str, str]],
    mode: int = OWNER_ONLY,
) -> WrittenFile:
    """Writes the span of a run whose messages lie in `files`, one after the other, and whose firing records are given.

    Messages that several files hold are taken once; those that no firing record names yet, since it is on its way,
    are left out. `metadata` is added to that of the files; `mode`: permissions of the new file.
    """
    done = WrittenFile(str(out))
    with ExitStack() as stack:
        origins = [stack.enter_context(Origin(file)) for file in files]
        part = decodable(origins, part, done)
        stored = {origin.stream(c) for origin in origins for c in origin.of_kind(Kind.STREAM).values()}
        run = RunRecords({name: listed(known) for name, known in records.items()}, outputs_of(graph))
        chosen = run.of_span(stored, part.start, part.end, part.span)
        told = _told(records, outputs_of(graph))
        kept = once(origins, [_until(origin, masks_of(origin, part, chosen.needed), told) for origin in origins])
        written = {name: dict(values) for origin in origins for name, values in origin.metadata.items()}
        for name in (DIGESTS, ENDS, OUTCOME):
            written.pop(name, None)
        written[CUT] = Cut("what ran", part.start, part.end).metadata()
        with Copy(out, origins[0], mode=mode) as copy:
            for name, values in {**written, **metadata}.items():
                copy.writer.add_metadata(name, values)
            with Spool(out.parent, chosen.records) as spool:
                spool.write(copy, origins)
            for origin, masks in zip(origins, kept, strict=True):
                copy_messages(copy, origin, masks)
            stamps = [(origin, kept_stamps(origin, masks)) for origin, masks in zip(origins, kept, strict=True)]
            copy.frames(graph.namespace, (m for origin, found in stamps for m in framing(origin.path, found)))
    done.firings, done.bytes, done.lead = spool.calls, out.stat().st_size, chosen.lead
    with Origin(out) as made:
        done.streams, done.span = {s: n for s, n in sorted(made.counts().items()) if n}, made.span()
    return done


def _told(
    records: Mapping[str, Sequence[FiringRecord]], outputs: Mapping[str, Sequence[str]]
) -> dict[str, tuple[int, int]]:
    """By stream, the last incarnation with records, and the last stamp in it."""
    told: dict[str, tuple[int, int]] = {}
    for operator, known in records.items():
        for record in known:
            for stream, emission in zip(outputs.get(operator, ()), record.outputs, strict=False):
                if emission is not None:
                    told[stream] = max(told.get(stream, (0, 0)), (record.incarnation, emission.stamp))
            for held in held_by(record):
                told[held.stream] = max(told.get(held.stream, (0, 0)), (held.incarnation, held.stamp))
    return told


def _until(origin: Origin, masks: Mapping[int, Mask], told: Mapping[str, tuple[int, int]]) -> dict[int, Mask]:
    """Of the messages of operators, those up to the last one that a record names."""
    found = dict(masks)
    for channel in origin.of_kind(Kind.STREAM, Kind.COMPANION).values():
        stream, incarnation = origin.stream(channel), origin.incarnation(channel)
        if channel.id not in masks or "operator" not in _metadata_of(origin, stream) or origin.is_static(channel):
            continue
        last, stamp = told.get(stream, (-1, -1))
        if incarnation > last:
            found[channel.id] = np.zeros(len(masks[channel.id]), bool)
        elif incarnation == last:
            found[channel.id] = masks[channel.id] & (origin.entries(channel.id).times <= stamp)
    return found


def _metadata_of(origin: Origin, stream: str) -> Mapping[str, str]:
    return next((c.metadata for c in origin.channels.values() if c.topic == stream), {})


def once(origins: Sequence[Origin], masks: Sequence[Mapping[int, Mask]]) -> list[dict[int, Mask]]:
    """Of messages that several files hold, those of the first one."""
    seen: Seen = {}
    kept: list[dict[int, Mask]] = []
    for origin, chosen in zip(origins, masks, strict=True):
        found = dict(chosen)
        for channel in origin.of_kind(Kind.STREAM, Kind.COMPANION).values():
            if channel.id not in chosen:
                continue
            place = origin.kind(channel), channel.topic, origin.incarnation(channel)
            times = origin.entries(channel.id).times
            before = seen.get(place, np.empty(0, np.int64))
            mask = chosen[channel.id] & ~np.isin(times, before)
            found[channel.id] = mask
            seen[place] = np.union1d(before, times[mask])
        kept.append(found)
    return kept
