"""MCAP files as one bag: a single file, or the files of a split ROS 2 recording."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path

import zstandard
from mcap.records import Channel

from dataflow.interop.bag import BagError, Lost, Stored, Topic, is_latched
from dataflow.interop.channels import join
from dataflow.interop.zstd_frames import unpacked_message
from dataflow.recording.errors import DamagedError
from dataflow.recording.layout import Kind
from dataflow.recording.mcap.cache import ChunkCache
from dataflow.recording.mcap.index import McapFile
from dataflow.recording.streams.codecs import SchemaText
from dataflow.recording.streams.ordering import in_file_order

_OWN = (Kind.COMPANION, Kind.FIRINGS, Kind.EVENTS, Kind.FRAMES)


class McapBag:
    """Reads MCAP files whose topics belong together, split files one after the other by log time."""

    def __init__(self, path: Path, files: Sequence[Path], *, compressed: bool = False, strict: bool = False) -> None:
        """`compressed`: each message is a zstd frame; `strict`: damage is an error."""
        self.path, self.lost, self._strict = path, Lost(), strict
        self.promised: Mapping[str, int] = {}
        self.files: list[McapFile] = []
        cache = ChunkCache()
        self._decompress = unpacked_message if compressed else None
        try:
            for file in files:
                self.files.append(McapFile(file, cache=cache, lenient=not strict))
            joined = join(
                ((number, channel.id), self._topic(opened, channel, sizes.get(channel.id, 0)))
                for number, opened in enumerate(self.files)
                for sizes in [opened.message_bytes()]
                for channel in opened.channels.values()
                if channel.metadata.get("kind") not in _OWN
            )
        except BaseException:
            self.close()
            raise
        self.topics, self._owner = joined.topics, joined.owner
        profiles = {f.header.profile for f in self.files} - {""}
        what = " ROS 2" if profiles == {"ros2"} else " ROS 1" if profiles == {"ros1"} else ""
        self.kind = f"MCAP{what}" + (f", {len(files)} files" if len(files) > 1 else "")
        self.notes: tuple[str, ...] = tuple([note for f in self.files for note in f.damage] + list(joined.notes))
        self.lost.parts += [text for f in self.files for text in f.lacking]

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

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times. Those that damage keeps from being read are counted
        in `lost`; where it was opened strictly, they raise `RecordingError`."""
        counters = {name: count() for name in topics}
        lost: Counter[str] = Counter()
        merged = heapq.merge(
            *(self._one(number, topics, lost) for number in range(len(self.files))), key=lambda m: m[0]
        )
        for log_time, name, data in merged:
            yield Stored(name, next(counters[name]), log_time, data)

    def _one(
        self, number: int, topics: Collection[str], lost: Counter[str]
    ) -> Iterator[tuple[int, str, bytes | memoryview]]:
        """The messages of one file by log time; those that wait for an earlier one of a later chunk are read twice."""
        file = self.files[number]
        names = {place[1]: name for place, name in self._owner.items() if place[0] == number and name in topics}
        places = list(in_file_order([(c, file.index.entries(c)) for c in names]))
        places.sort(key=lambda place: place[3])
        for place in places:
            name = names[place[0]]
            try:
                data = file.read(*place).data
                yield place[3], name, data if self._decompress is None else self._decompress(data)
            except (DamagedError, zstandard.ZstdError) as error:
                what = error.what if isinstance(error, DamagedError) else f"a message that is no zstd frame: {error}"
                if self._strict:
                    raise BagError(f"{file.path}, topic {name}: {what}") from error
                lost[name] += 1
                self.lost.take(name, lost[name], f"{file.path.name}, {what}")

    def close(self) -> None:
        """Closes the files. Idempotent."""
        self.lost.announce(self.path)
        for file in self.files:
            file.close()
