"""Writes a part of an MCAP file, by span and by streams: the one way for cut, filter and split."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from dataflow.editing.key_frames import key_frames
from dataflow.editing.report import Watch, WrittenFile, unwatched
from dataflow.editing.spans import RunRecords, Span, SpanRecords, Stamps
from dataflow.editing.spool import Spool
from dataflow.graph import GraphError
from dataflow.graph.model import Graph, Node, OperatorImportError
from dataflow.interop.bag import is_latched
from dataflow.recording import Recording
from dataflow.recording.layout import CUT, DIGESTS, ENDS, Kind
from dataflow.recording.mcap.packing import Compression
from dataflow.recording.streams.copying import RUN_KINDS, Copy, Mask, Origin, framing, places
from dataflow.recording.streams.cutting import Cut, cut_of
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog, Maker
from dataflow.reexecution.recorded_run import ReplayError, recorded_graph, resolved_graph


@dataclass(frozen=True, slots=True)
class Part:
    """Names what is to be taken over: the span (ns, inclusive; None: not cut there), and streams (None: all).

    A file that is written of it begins with the key frames of its video, which may be earlier. `bare`: exactly the
    messages of the span, without firing records. `spans`: those of streams of video that are chosen already.
    """

    start: int | None = None
    end: int | None = None
    streams: Collection[str] | None = None
    bare: bool = False
    spans: Mapping[str, Span] = field(default_factory=dict)

    @property
    def cuts(self) -> bool:
        """Returns whether it leaves out anything before or after the span."""
        return self.start is not None or self.end is not None

    def span(self, stream: str) -> Span:
        """Returns the span of a stream."""
        return self.spans.get(stream, (self.start, self.end))


class Firings:
    """The firing records of a recording and its graph, for all parts written of it. A context manager: the records are
    read whenever they are needed, until it ends."""

    def __init__(self, origin: Origin) -> None:
        self._origin = origin
        self._stack = ExitStack()

    @cached_property
    def _recording(self) -> Recording:
        return self._stack.enter_context(Recording(self._origin.path))

    @cached_property
    def graph(self) -> Graph | None:
        """The graph of the recording, where it is available."""
        return graph_of(self._recording)

    @cached_property
    def all(self) -> Mapping[str, Iterable[FiringRecord]]:
        """All records by operator, in the order of the file."""
        return as_stored(self._recording)

    @cached_property
    def run(self) -> RunRecords:
        """The records, of which those of spans are chosen."""
        log = FiringLog.read(self._recording)
        makers = makers_of(self.graph, log)
        return RunRecords({name: partial(log.since, maker) for name, maker in makers.items()}, outputs_of(self.graph))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


@dataclass(frozen=True, slots=True)
class Reading:
    """Firing records that are read whenever they are iterated over."""

    read: Callable[[], Iterator[FiringRecord]]

    def __iter__(self) -> Iterator[FiringRecord]:
        return self.read()


class _Maker(NamedTuple):
    """An operator of which no more is known than its name."""

    name: str
    outputs: Mapping[str, str]


def as_stored(recording: Recording) -> dict[str, Iterable[FiringRecord]]:
    """The firing records of a recording by operator, in the order of the file: read when they are iterated over."""
    log = FiringLog.read(recording)
    return {operator: Reading(partial(log.records, operator)) for operator in sorted(log.operators)}


def makers_of(graph: Graph | None, log: FiringLog) -> dict[str, Maker]:
    """The operators that left records, sorted by name."""
    nodes = {} if graph is None else graph.nodes
    return {name: nodes.get(name) or _Maker(name, {}) for name in sorted(log.operators)}


def write_part(
    origin: Origin,
    part: Part,
    out: Path,
    *,
    firings: Firings | None = None,
    compression: Compression = "zstd",
    overwrite: bool = False,
    watch: Watch = unwatched,
) -> WrittenFile:
    """Writes a part of `origin` into a separate file. `firings`: those of `origin`. Raises `RecordingError`."""
    if firings is None:
        with Firings(origin) as read:
            return write_part(
                origin, part, out, firings=read, compression=compression, overwrite=overwrite, watch=watch
            )
    done = WrittenFile(str(out))
    origin.lost.clear()
    part = decodable([origin], part, done)
    chosen = _chosen(origin, part, firings, done)
    needed = {} if chosen is None else chosen.needed
    kept = masks_of(origin, part, needed)
    _describe(origin, kept, part, done)
    with Copy(out, origin, compression=compression, overwrite=overwrite) as copy:
        for name, values in _metadata(origin, kept, part):
            copy.writer.add_metadata(name, values)
        done.attachments = copy.attachments(origin)
        if chosen is not None:
            with Spool(out.parent, chosen.records) as spool:
                spool.write(copy, [origin])
            done.firings, done.lead = spool.calls, chosen.lead
        copy_messages(copy, origin, kept, watch)
        if origin.own:
            copy.frames(origin.namespace, framing(origin.path, kept_stamps(origin, kept)))
    done.bytes = out.stat().st_size
    for stream, number in origin.lost.items():
        done.streams[stream] -= number
    done.lose(origin)
    return done


def decodable(origins: Sequence[Origin], part: Part, done: WrittenFile) -> Part:
    """Returns the part from the key frames on with which the video in it can be decoded; notes that in `done`."""
    if part.start is None or part.bare or part.spans:
        return part
    [keys] = key_frames(origins, [part.start], part.streams)
    start = min([part.start, *keys.values()])
    if start < part.start:
        done.notes.append(f"it begins {(part.start - start) * 1e-9:.3f} s earlier, with a key frame of its video")
    return replace(part, start=start)


def copy_messages(
    copy: Copy,
    origin: Origin,
    kept: Mapping[int, Mask],
    watch: Watch = unwatched,
    names: Mapping[int, str] | None = None,
) -> None:
    """Copies the kept messages and records of `origin`. `names`: the topics of channels that get another."""
    total, done = sum(int(mask.sum()) for mask in kept.values()), 0
    run = origin.of_kind(*RUN_KINDS)
    for channel in kept:
        copy.channel(origin, channel, (names or {}).get(channel))
    for raw in places(origin, kept):
        channel = copy.channel(origin, raw.channel)
        if raw.channel in run:
            copy.record(channel, raw.log_time, raw.sequence, bytes(raw.data))
        else:
            copy.message(channel, raw)
        done += 1
        if done % 64 == 0:
            watch(done, total)
    watch(done, total)


def graph_of(recording: Recording) -> Graph | None:
    """The graph of a recording, its operators not imported where that can be avoided; None where it cannot be had."""
    graph = resolved_graph(recording)
    if graph is None:
        try:
            graph = recorded_graph(recording)
        except (ReplayError, GraphError, OperatorImportError):
            return None
    return graph


def outputs_of(graph: Graph | None) -> dict[str, Sequence[str]]:
    """The streams of each operator by its ports."""
    return {} if graph is None else {node.name: tuple(node.outputs.values()) for node in graph.nodes.values()}


def keeps_state(node: Node) -> bool:
    """Returns whether an operator's calls depend on those before, as far as it can be known here."""
    try:
        return not (node.source or node.external or node.operator.stateless)
    except OperatorImportError:
        return True


def _chosen(origin: Origin, part: Part, firings: Firings, done: WrittenFile) -> SpanRecords | None:
    """The firing records of the part; None where there are none, or they cannot be kept."""
    if not origin.own or not origin.of_kind(Kind.FIRINGS):
        return None
    if part.bare:
        done.notes.append("without firing records: it replays with fresh operators, and cannot be verified")
        return None
    if not part.cuts:
        return SpanRecords(firings.all, {}, (), None)
    graph = firings.graph
    if graph is None:
        done.notes.append(
            "its graph is not in it, or its operators cannot be imported: firing records are left out, so it "
            "cannot be verified"
        )
        return None
    stored = {origin.stream(c) for c in origin.of_kind(Kind.STREAM).values()}
    if part.streams is not None:
        stored &= set(part.streams)
    found = firings.run.of_span(stored, part.start, part.end, part.span)
    done.unknown = tuple(n for n in found.unknown if n not in graph.nodes or keeps_state(graph.nodes[n]))
    return found


def masks_of(origin: Origin, part: Part, needed: Stamps) -> dict[int, Mask]:
    """The messages to copy, by channel."""
    kept: dict[int, Mask] = {}
    for channel in origin.of_kind(Kind.STREAM, Kind.COMPANION, Kind.EVENTS, Kind.LOGS).values():
        times = origin.entries(channel.id).times
        stream = origin.stream(channel)
        if (
            origin.kind(channel) in (Kind.STREAM, Kind.COMPANION)
            and part.streams is not None
            and stream not in part.streams
        ):
            continue
        mask = np.ones(len(times), bool)
        if not origin.is_static(channel):
            start, end = part.span(stream)
            if start is not None and not latched(origin, channel.topic):
                mask &= times >= start
            if end is not None:
                mask &= times <= end
            extra = needed.get(stream, {}).get(origin.incarnation(channel), ())
            if extra and origin.kind(channel) in (Kind.STREAM, Kind.COMPANION):
                mask |= np.isin(times, np.fromiter(extra, np.int64, len(extra)))
        kept[channel.id] = mask
    return kept


def latched(origin: Origin, topic: str) -> bool:
    """Returns whether another program's topic keeps its messages for late subscribers: they hold for the part too."""
    profiles = [c.metadata.get("offered_qos_profiles", "") for c in origin.channels.values() if c.topic == topic]
    return not origin.own and any(is_latched(topic, text) for text in profiles)


def _describe(origin: Origin, kept: Mapping[int, Mask], part: Part, done: WrittenFile) -> None:
    """Counts what is kept."""
    done.streams = {name: n for name, n in sorted(origin.counts(kept).items()) if n}
    firsts, lasts = [], []
    for channel in origin.of_kind(Kind.STREAM).values():
        if channel.id not in kept or origin.is_static(channel) or latched(origin, channel.topic):
            continue
        times = origin.entries(channel.id).times[kept[channel.id]]
        if len(times):
            start, end = part.span(channel.topic)
            outside = (times < (times.min() if start is None else start)) | (
                times > (times.max() if end is None else end)
            )
            done.beyond += int(outside.sum())
            inside = times[~outside]
            if len(inside):
                firsts.append(int(inside.min()))
                lasts.append(int(inside.max()))
    done.span = (min(firsts), max(lasts)) if firsts else None


def _metadata(origin: Origin, kept: Mapping[int, Mask], part: Part) -> list[tuple[str, dict[str, str]]]:
    """The metadata of the part: stream digests only of what is whole, ends within it, and what it was cut from."""
    if not origin.own:
        return origin.records()
    metadata = {name: dict(values) for name, values in origin.metadata.items()}
    before, after = origin.counts(), origin.counts(kept)
    digests = metadata.pop(DIGESTS, {})
    metadata[DIGESTS] = {s: d for s, d in digests.items() if after.get(s) == before.get(s)}
    ends = {s: json.loads(text) for s, text in metadata.get(ENDS, {}).items() if s in after}
    for stream, end in ends.items():
        _, last = part.span(stream)
        if end["final"] is not None and last is not None:
            end["final"] = min(end["final"], last)
    if ends:
        metadata[ENDS] = {stream: json.dumps(end) for stream, end in ends.items()}
    if part.cuts:
        known = cut_of(metadata) or Cut(origin.path.name, None, None)
        start = known.start if part.start is None else part.start
        end = known.end if part.end is None else part.end
        metadata[CUT] = Cut(known.of, start, end).metadata()
    return list(metadata.items())


def kept_stamps(origin: Origin, kept: Mapping[int, Mask]) -> dict[str, dict[int, np.ndarray]]:
    """The kept stamps of each stream, by incarnation, sorted."""
    found: dict[str, dict[int, list[np.ndarray]]] = {}
    for channel in origin.of_kind(Kind.STREAM).values():
        if channel.id in kept:
            times = origin.entries(channel.id).times[kept[channel.id]]
            found.setdefault(channel.topic, {}).setdefault(origin.incarnation(channel), []).append(times)
    return {s: {i: np.sort(np.concatenate(t)) for i, t in found[s].items()} for s in found}
