"""Splits a recording into parts of a duration or a size, each of which is a recording by itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from dataflow.editing.key_frames import key_frames
from dataflow.editing.part import Firings, Part, write_part
from dataflow.editing.report import Watch, WrittenFile, unwatched
from dataflow.recording.errors import RecordingError
from dataflow.recording.mcap.packing import Compression
from dataflow.recording.streams.copying import Origin

MOST_PARTS = 10_000


def split(
    origin: Origin,
    folder: Path,
    *,
    every: int | None = None,
    size: int | None = None,
    compression: Compression = "zstd",
    overwrite: bool = False,
    watch: Watch = unwatched,
) -> Iterator[WrittenFile]:
    """Writes the parts, `NAME_000.mcap` and so on, into `folder`; yields what each holds.

    `every`: event time of a part (ns); `size`: bytes in the file that a part takes of this one, what a part holds
    besides for its firings aside. Raises `RecordingError`.
    """
    parts = _parts(origin, by_time(origin, every) if every is not None else by_size(origin, size or 1))
    if len(parts) > MOST_PARTS:
        raise RecordingError(f"{origin.path} would become {len(parts):,} parts; at most {MOST_PARTS:,} are written")
    width = max(3, len(str(len(parts) - 1)))
    names = [folder / f"{origin.path.stem}_{k:0{width}}.mcap" for k in range(len(parts))]
    if not overwrite and (there := [name for name in names if name.exists()]):
        raise RecordingError(f"{there[0]} exists already; choose another folder or ask to overwrite it")
    folder.mkdir(parents=True, exist_ok=True)
    with Firings(origin) as firings:
        for name, part in zip(names, parts, strict=True):
            yield write_part(
                origin, part, name, firings=firings, compression=compression, overwrite=overwrite, watch=watch
            )


def _parts(origin: Origin, spans: list[tuple[int, int]]) -> list[Part]:
    """Returns parts that begin with the earliest of the last key frames of all video before the spans, where there is
    some, and each stream of video with its own; fewer where key frames are rare."""
    starts = [start for start, _ in spans[1:]]
    begins: dict[int, Mapping[str, int]] = {}
    for start, keys in zip(starts, key_frames([origin], starts), strict=True):
        begin = min([start, *keys.values()])
        if begin > spans[0][0]:
            begins.setdefault(begin, keys)
    bounds: list[tuple[int | None, Mapping[str, int]]] = [(None, {}), *begins.items(), (None, {})]
    parts = []
    for (first, firsts), (end, ends) in pairwise(bounds):
        own = {stream: (firsts.get(stream, first), _before(ends.get(stream, end))) for stream in {**firsts, **ends}}
        parts.append(Part(first, _before(end), spans=own))
    return parts


def _before(stamp: int | None) -> int | None:
    return None if stamp is None else stamp - 1


def by_time(origin: Origin, every: int) -> list[tuple[int, int]]:
    """Spans of `every` ns from the first message on, the last one shorter; what holds nothing is part of the one
    before."""
    first, last = _span(origin)
    times, _ = origin.file.weights()
    places = np.unique((times[(times >= first) & (times <= last)] - first) // every)
    starts = [first + place * every for place in places.tolist()]
    return [*((a, b - 1) for a, b in pairwise(starts)), (starts[-1], last)]


def by_size(origin: Origin, size: int) -> list[tuple[int, int]]:
    """Spans whose messages take at most `size` bytes of the file, or hold a single stamp."""
    first, last = _span(origin)
    times, weights = origin.file.weights()
    order = np.argsort(times, kind="stable")
    stamps, starts = np.unique(np.maximum(times[order], first), return_index=True)
    loads = np.add.reduceat(weights[order], starts)
    spans, begin, load = [], first, 0.0
    for stamp, one in zip(stamps.tolist(), loads.tolist(), strict=True):
        if load and load + one > size:
            spans.append((begin, stamp - 1))
            begin, load = stamp, 0.0
        load += one
    return [*spans, (begin, last)]


def _span(origin: Origin) -> tuple[int, int]:
    span = origin.span()
    if span is None:
        raise RecordingError(f"{origin.path} holds no messages: there is nothing to split")
    return span
