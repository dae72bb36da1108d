"""Copies messages of MCAP files into another one as they are, byte for byte: what cuts, filters and merges rest on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt
from mcap.records import Channel

from dataflow.messages import Odometry, Transforms
from dataflow.recording.errors import DamagedError, RecordingError
from dataflow.recording.layout import RECORDING, Kind, firings_topic
from dataflow.recording.mcap.container import ContainerWriter
from dataflow.recording.mcap.contents import Entries
from dataflow.recording.mcap.index import McapFile, RawMessage
from dataflow.recording.mcap.packing import Compression
from dataflow.recording.parts import OWNER_ONLY
from dataflow.recording.streams.entries import Recorded
from dataflow.recording.streams.frames import FrameChannel
from dataflow.recording.streams.ordering import in_file_order
from dataflow.recording.streams.reader import Recording, merged_metadata

Mask = npt.NDArray[np.bool_]
RUN_KINDS = (Kind.FIRINGS, Kind.EVENTS, Kind.LOGS)
"""Channels that lie in separate chunks."""

TIMES = 2**64
"""Times in a file are unsigned; those that are read from 2^63 on stand before the epoch."""


class Origin:
    """An MCAP file to copy from: a context manager.

    `lenient`: what cannot be read is left out, with a note in `file.damage`. `own`: this program's recording;
    `namespace`: its namespace; `metadata`: of one name and key the latest counts. `lost`: of another program's file, by
    topic how many messages `places` had to leave out, and in `reasons` why the first.
    """

    def __init__(self, path: Path, *, lenient: bool = False) -> None:
        self.path = path
        self.file = McapFile(path, lenient=lenient)
        self.metadata = merged_metadata(self.file.metadata)
        self.own = RECORDING in self.metadata
        self.lost: dict[str, int] = {}
        self.reasons: dict[str, str] = {}
        self.namespace = self.metadata.get(RECORDING, {}).get("namespace", "")
        self.channels: Mapping[int, Channel] = self.file.channels

    def kind(self, channel: Channel) -> str:
        """The kind of a channel; every topic of another program is a stream."""
        return channel.metadata.get("kind", Kind.STREAM) if self.own else Kind.STREAM

    def stream(self, channel: Channel) -> str:
        """The stream that a channel belongs to, as its companion or itself."""
        return channel.metadata.get("companion_of", channel.topic) if self.own else channel.topic

    def incarnation(self, channel: Channel) -> int:
        """The incarnation of its stream that a channel holds."""
        text = channel.metadata.get("incarnation", "0") if self.own else "0"
        return int(text) if text.isdecimal() else 0

    def is_static(self, channel: Channel) -> bool:
        """Returns whether the stream of a channel is one message, valid always."""
        return self.own and any(
            c.metadata.get("static") == "true" for c in self.channels.values() if c.topic == self.stream(channel)
        )

    def of_kind(self, *kinds: str) -> dict[int, Channel]:
        """The channels of some kinds, by id."""
        return {c.id: c for c in self.channels.values() if self.kind(c) in kinds}

    def entries(self, channel: int) -> Entries:
        """The messages of a channel."""
        return self.file.index.entries(channel)

    def counts(self, kept: Mapping[int, Mask] | None = None) -> dict[str, int]:
        """Messages by stream, companions aside: all, or those that are kept."""
        found: dict[str, int] = {}
        for channel in self.of_kind(Kind.STREAM).values():
            mask = None if kept is None else kept.get(channel.id)
            number = self.file.index.count(channel.id) if kept is None else 0 if mask is None else int(mask.sum())
            found[channel.topic] = found.get(channel.topic, 0) + number
        return found

    def span(self) -> tuple[int, int] | None:
        """The first and the last time (ns) in streams that are not static; None where there is no message."""
        found = [self.file.index.span(c.id) for c in self.of_kind(Kind.STREAM).values() if not self.is_static(c)]
        spans = [span for span in found if span is not None]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    def records(self) -> list[tuple[str, dict[str, str]]]:
        """The metadata records: another program's as they stand, ours with the latest of each name and key."""
        return list(self.metadata.items()) if self.own else self.file.metadata

    def pass_over(self, channel: int, reason: str) -> None:
        """Counts a message that cannot be read."""
        topic = self.channels[channel].topic
        self.lost[topic] = self.lost.get(topic, 0) + 1
        self.reasons.setdefault(topic, reason)

    def close(self) -> None:
        """Closes the file. Idempotent."""
        self.file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Copy:
    """A new MCAP file that takes over what others hold. A context manager: nothing is left at `path` when it fails.

    The file appears under its name when it is complete. `library` and `profile` are those of the first origin, so that
    another program's file stays one.
    """

    def __init__(
        self,
        path: Path,
        origin: Origin,
        *,
        overwrite: bool = False,
        compression: Compression = "zstd",
        mode: int = OWNER_ONLY,
    ) -> None:
        if path.exists() and not overwrite:
            raise RecordingError(f"{path} exists already; choose another name or ask to overwrite it")
        self.path = path
        self._part = path.with_name(f"{path.name}.part")
        header = origin.file.header
        self.writer = ContainerWriter(
            self._part,
            library=str(header.library) or "unknown",
            profile=str(header.profile),
            compression=compression,
            chunk_seconds=float("inf"),
            overwrite=True,
            mode=mode,
        )
        self._channels: dict[tuple[int, int], int] = {}
        self._alike: dict[tuple[object, ...], list[tuple[int, int]]] = {}
        self.attached = 0

    def channel(self, origin: Origin, channel: int, topic: str | None = None) -> int:
        """The id in this file of a channel of `origin`, which is declared when it is first asked for.

        Channels of several origins that say the same of themselves become one.
        """
        known = self._channels.get((id(origin), channel))
        if known is None:
            record = origin.channels[channel]
            schema = origin.file.schemas.get(record.schema_id)
            schema_id = 0 if schema is None else self.writer.add_schema(schema.name, schema.encoding, schema.data)
            metadata = renamed(record.metadata, topic)
            name = topic or record.topic
            about = (name, record.message_encoding, schema_id, *sorted(metadata.items()))
            alike = self._alike.setdefault(about, [])
            known = next((there for owner, there in alike if owner != id(origin)), None)
            if known is None:
                known = self.writer.add_channel(name, record.message_encoding, schema_id, metadata)
            alike.append((id(origin), known))
            self._channels[id(origin), channel] = known
        return known

    def firings_channel(self, namespace: str, operator: str) -> int:
        """A new channel for the firing records of one operator."""
        metadata = {"kind": str(Kind.FIRINGS), "operator": operator}
        return self.writer.add_channel(firings_topic(namespace, operator), "msgpack", 0, metadata)

    def attachments(self, origin: Origin, names: Sequence[str | None] | None = None) -> int:
        """Takes over the attachments of `origin`, renamed where `names` gives a name (None: not); returns how many."""
        before = self.attached
        for place, name in zip(origin.file.attachments, names or repeat(""), strict=False):
            if name is not None:
                found = origin.file.attachment(place)
                self.writer.add_attachment(replace(found, name=name) if name else found)
                self.attached += 1
        return self.attached - before

    def message(self, channel: int, raw: RawMessage) -> None:
        """Adds a message of a stream."""
        self.writer.add_copied(channel, raw.log_time % TIMES, raw.publish_time, raw.sequence, raw.data)

    def record(self, channel: int, log_time: int, sequence: int, data: bytes) -> None:
        """Adds a record of the run: firing records, an event, a line of the log."""
        self.writer.add_record(channel, log_time % TIMES, sequence, data)

    def frames(self, namespace: str, messages: Iterator[Recorded]) -> None:
        """Derives the frame tree for other viewers from the kept messages, as a recorder does."""
        channel = FrameChannel(self.writer, namespace)
        for found in messages:
            if derived := channel.derived(found.stream, found.message):
                self.writer.add_messages(derived)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.writer.close()
            if kind is None:
                self._part.replace(self.path)
        finally:
            self._part.unlink(missing_ok=True)


def renamed(metadata: Mapping[str, str], topic: str | None) -> dict[str, str]:
    """A channel's metadata under another topic: a companion goes with its stream."""
    values = dict(metadata)
    if topic is not None and "companion_of" in values:
        values["companion_of"] = topic.removesuffix("/@companion")
    return values


def places(origin: Origin, kept: Mapping[int, Mask]) -> Iterator[RawMessage]:
    """The kept messages of some channels as they lie in the file, each chunk read once.

    Of another program's file, those that damage keeps from being read are left out, and counted there.
    """
    for place in in_file_order([(channel, origin.entries(channel).where(mask)) for channel, mask in kept.items()]):
        try:
            raw = origin.file.read(*place)
        except DamagedError as error:
            if origin.own:
                raise
            origin.pass_over(place[0], error.what)
            continue
        yield raw


def framing(path: Path, kept: Mapping[str, Mapping[int, npt.NDArray[np.int64]]]) -> Iterator[Recorded]:
    """The kept messages that the frame tree is derived from. `kept`: stream → incarnation → stamps, sorted."""
    with Recording(path) as recording:
        names = [
            name
            for name, info in recording.streams.items()
            if name in kept and info.count and info.message_type in (Odometry, Transforms)
        ]
        bounds = [(s[0], s[-1]) for n in names for s in kept[n].values() if len(s)]
        start, end = min((first for first, _ in bounds), default=None), max((last for _, last in bounds), default=None)
        for found in recording.messages(names, start, end):
            stamps = kept[found.stream].get(found.incarnation)
            if stamps is not None and len(stamps):
                at = int(np.searchsorted(stamps, found.stamp))
                if at < len(stamps) and stamps[at] == found.stamp:
                    yield found
