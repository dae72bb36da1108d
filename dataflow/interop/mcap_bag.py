"""MCAP files as one bag: a single file, or the files of a split ROS 2 recording."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path

from mcap.records import Channel

from dataflow.interop.bag import BagError, Stored, Topic, is_latched
from dataflow.recording.codecs import SchemaText
from dataflow.recording.index import McapFile
from dataflow.recording.layout import Kind
from dataflow.recording.ordering import in_file_order

_OWN = (Kind.COMPANION, Kind.FIRINGS, Kind.EVENTS, Kind.FRAMES)


class McapBag:
    """Reads MCAP files whose topics belong together, split files one after the other by log time."""

    def __init__(self, path: Path, files: Sequence[Path]) -> None:
        self.path = path
        self.files: list[McapFile] = []
        try:
            for file in files:
                self.files.append(McapFile(file))
            self.topics = self._find()
        except BaseException:
            self.close()
            raise
        profiles = {f.header.profile for f in self.files} - {""}
        what = " ROS 2" if profiles == {"ros2"} else " ROS 1" if profiles == {"ros1"} else ""
        self.kind = f"MCAP{what}" + (f", {len(files)} files" if len(files) > 1 else "")
        self.notes = tuple(
            [f"{f.path.name} has no proper end: it is being written, or its writer died" for f in self.files if f.torn]
            + [note for f in self.files for note in f.damage]
        )

    def _find(self) -> Mapping[str, Topic]:
        found: dict[str, Topic] = {}
        for file in self.files:
            sizes = file.message_bytes()
            for channel in file.channels.values():
                if channel.metadata.get("kind") in _OWN:
                    continue
                topic = self._topic(file, channel, sizes.get(channel.id, 0))
                known = found.get(topic.name)
                found[topic.name] = topic if known is None else self._joined(known, topic)
        return dict(sorted(found.items()))

    def _topic(self, file: McapFile, channel: Channel, size: int) -> Topic:
        schema = file.schemas.get(channel.schema_id)
        first, last = file.index.span(channel.id) or (None, None)
        return Topic(
            channel.topic,
            channel.message_encoding,
            SchemaText("", "", b"") if schema is None else SchemaText(schema.name, schema.encoding, schema.data),
            file.index.count(channel.id),
            first,
            last,
            size,
            is_latched(channel.topic, channel.metadata.get("offered_qos_profiles", "")),
            channel.metadata,
        )

    def _joined(self, a: Topic, b: Topic) -> Topic:
        """Returns a topic of two channels: of several publishers, or of two files."""
        if (a.encoding, a.schema) != (b.encoding, b.schema):
            raise BagError(
                f"{self.path}: topic {a.name!r} is recorded with two types, {a.schema.name} ({a.encoding}) and "
                f"{b.schema.name} ({b.encoding})"
            )
        firsts = [t for t in (a.first, b.first) if t is not None]
        lasts = [t for t in (a.last, b.last) if t is not None]
        return Topic(
            a.name,
            a.encoding,
            a.schema,
            a.count + b.count,
            min(firsts, default=None),
            max(lasts, default=None),
            (a.bytes or 0) + (b.bytes or 0),
            a.latched or b.latched,
            a.channel,
        )

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times."""
        counters = {name: count() for name in topics}
        merged = heapq.merge(*(self._one(file, topics) for file in self.files), key=lambda m: m[0])
        for log_time, name, data in merged:
            yield Stored(name, next(counters[name]), log_time, data)

    def _one(self, file: McapFile, topics: Collection[str]) -> Iterator[tuple[int, str, memoryview]]:
        """The messages of one file by log time; those that wait for an earlier one of a later chunk are read twice."""
        names = {
            c.id: c.topic for c in file.channels.values() if c.topic in topics and c.metadata.get("kind") not in _OWN
        }
        places = list(in_file_order([(c, file.index.entries(c)) for c in names]))
        places.sort(key=lambda place: place[3])
        for place in places:
            yield place[3], names[place[0]], file.read(*place).data

    def close(self) -> None:
        """Closes the files. Idempotent."""
        for file in self.files:
            file.close()
