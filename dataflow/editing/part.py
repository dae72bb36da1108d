"""Writes a part of an MCAP file, by span and by streams: the one way for cut, filter and split."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from dataflow.editing.key_frames import key_frames
from dataflow.editing.report import Edited, Watch, unwatched
from dataflow.editing.spans import RunRecords, Span, SpanRecords, Stamps
from dataflow.graph import GraphError
from dataflow.graph.model import Graph, Node, OperatorImportError
from dataflow.interop.bag import is_latched
from dataflow.recording import Recording
from dataflow.recording.layout import CUT, DIGESTS, ENDS, Kind
from dataflow.recording.mcap.index import NO_END
from dataflow.recording.mcap.packing import Compression
from dataflow.recording.streams.copying import RUN_KINDS, Copy, Mask, Origin, framing, places
from dataflow.recording.streams.cutting import Cut, cut_of
from dataflow.records.firing import CALLS, FiringRecord, consecutive, encode_batch
from dataflow.records.reading import FiringLog
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
        """Tells whether it leaves out anything before or after the span."""
        return self.start is not None or self.end is not None

    def span(self, stream: str) -> Span:
        """Returns the span of a stream."""
        return self.spans.get(stream, (self.start, self.end))


class Firings:
    """The firing records of a recording and its graph: read when they are needed, once for all parts written of it."""

    def __init__(self, origin: Origin) -> None:
        self._origin = origin

    @cached_property
    def read(self) -> tuple[Mapping[str, Sequence[FiringRecord]], Graph | None]:
        """The records by operator, in memory, and the graph where it is available."""
        with Recording(self._origin.path) as recording:
            log = FiringLog.read(recording)
            return {operator: log.of(operator) for operator in sorted(log.operators)}, graph_of(recording)

    @cached_property
    def run(self) -> RunRecords:
        """The records, of which those of spans are chosen."""
        records, graph = self.read
        return RunRecords(records, outputs_of(graph))


def write_part(
    origin: Origin,
    part: Part,
    out: Path,
    *,
    firings: Firings | None = None,
    compression: Compression = "zstd",
    overwrite: bool = False,
    watch: Watch = unwatched,
) -> Edited:
    """Writes a part of `origin` into a separate file. `firings`: those of `origin`. Raises `RecordingError`."""
    done = Edited(str(out))
    part = decodable([origin], part, done)
    chosen = _chosen(origin, part, firings or Firings(origin), done)
    needed = {} if chosen is None else chosen.needed
    kept = masks_of(origin, part, needed)
    _describe(origin, kept, part, done)
    with Copy(out, origin, compression=compression, overwrite=overwrite) as copy:
        for name, values in _metadata(origin, kept, part):
            copy.writer.add_metadata(name, values)
        done.attachments = copy.attachments(origin)
        if chosen is not None:
            write_firings(copy, [origin], chosen.records)
            done.firings = sum(r.kind in CALLS for records in chosen.records.values() for r in records)
            done.lead = chosen.lead
        copy_messages(copy, origin, kept, watch)
        if origin.own:
            copy.frames(origin.namespace, framing(origin.path, kept_stamps(origin, kept)))
    done.bytes = out.stat().st_size
    if origin.file.torn:
        done.notes.append(f"{origin.path} {NO_END}")
    done.notes += [f"{origin.path}: {note}" for note in origin.file.damage]
    return done


def decodable(origins: Sequence[Origin], part: Part, done: Edited) -> Part:
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


def write_firings(copy: Copy, origins: Sequence[Origin], records: Mapping[str, Sequence[FiringRecord]]) -> None:
    """Writes firing records anew, those of all operators in the order of stamps."""
    first = max(1, min((span[0] for origin in origins if (span := origin.span()) is not None), default=1))
    batches = []
    for operator, listed in records.items():
        for part in consecutive(listed):
            for at in range(0, len(part), BATCH):
                batch = part[at : at + BATCH]
                batches.append((max(batch[-1].stamp, first), operator, encode_batch(batch)))
    channels = {operator: copy.firings_channel(origins[0].namespace, operator) for operator in records}
    sequences: dict[str, int] = {}
    for stamp, operator, data in sorted(batches, key=lambda b: (b[0], b[1])):
        sequence = sequences.get(operator, 0)
        copy.record(channels[operator], min(stamp, 2**63 - 1), sequence, data)
        sequences[operator] = sequence + 1


BATCH = 64
"""Firing records that are written together."""


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
    """Tells whether an operator's calls depend on those before, as far as it can be known here."""
    try:
        return not (node.source or node.external or node.operator.stateless)
    except OperatorImportError:
        return True


def _chosen(origin: Origin, part: Part, firings: Firings, done: Edited) -> SpanRecords | None:
    """The firing records of the part; None where there are none, or they cannot be kept."""
    if not origin.own or not origin.of_kind(Kind.FIRINGS):
        return None
    if part.bare:
        done.notes.append("without firing records: it replays with fresh operators, and cannot be verified")
        return None
    records, graph = firings.read
    if not part.cuts:
        return SpanRecords(records, {}, (), None)
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
    """Tells whether another program's topic keeps its messages for late subscribers: they hold for the part too."""
    profiles = [c.metadata.get("offered_qos_profiles", "") for c in origin.channels.values() if c.topic == topic]
    return not origin.own and any(is_latched(topic, text) for text in profiles)


def _describe(origin: Origin, kept: Mapping[int, Mask], part: Part, done: Edited) -> None:
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
