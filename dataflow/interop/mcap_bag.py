"""MCAP files as one bag: a single file, or the files of a split ROS 2 recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from dataflow.interop.bag import Topic, is_latched
from dataflow.interop.joined_bag import JoinedBag, Row
from dataflow.recording.errors import DamagedError
from dataflow.recording.layout import Kind
from dataflow.recording.mcap.cache import ChunkCache
from dataflow.recording.mcap.index import McapFile
from dataflow.recording.streams.codecs import SchemaText
from dataflow.recording.streams.ordering import in_file_order

_OWN = (Kind.COMPANION, Kind.FIRINGS, Kind.EVENTS, Kind.FRAMES)


class McapBag(JoinedBag[McapFile]):
    """Reads MCAP files whose topics belong together, split files one after the other by log time."""

    def __init__(self, path: Path, files: Sequence[Path], *, compressed: bool = False, strict: bool = False) -> None:
        self._cache = ChunkCache()
        super().__init__(path, files, compressed=compressed, strict=strict)
        profiles = {f.header.profile for f in self.files} - {""}
        what = " ROS 2" if profiles == {"ros2"} else " ROS 1" if profiles == {"ros1"} else ""
        self.kind = f"MCAP{what}{self.kind}"
        self.lost.parts += [text for f in self.files for text in f.lacking]

    def _opened(self, file: Path, notes: list[str]) -> McapFile:
        opened = McapFile(file, cache=self._cache, lenient=not self.strict)
        notes += opened.damage
        return opened

    def _channels(self, file: McapFile) -> Iterator[tuple[int, Topic]]:
        sizes = file.message_bytes()
        for channel in file.channels.values():
            if channel.metadata.get("kind") in _OWN:
                continue
            schema = file.schemas.get(channel.schema_id)
            text = SchemaText("", "", b"") if schema is None else SchemaText(schema.name, schema.encoding, schema.data)
            held, (first, last) = file.index.count(channel.id), file.index.span(channel.id) or (None, None)
            latched = is_latched(channel.topic, channel.metadata.get("offered_qos_profiles", ""))
            name, encoding, size = channel.topic, channel.message_encoding, sizes.get(channel.id, 0)
            yield channel.id, Topic(name, encoding, text, held, first, last, size, latched, channel.metadata)

    def _rows(self, number: int, names: Mapping[int, str], broken: Counter[str]) -> Iterator[Row]:
        """The messages of one file by log time; those that wait for an earlier one of a later chunk are read twice."""
        file = self.files[number]
        places = list(in_file_order([(c, file.index.entries(c)) for c in names]))
        places.sort(key=lambda place: place[3])
        for place in places:
            try:
                yield place[3], place[0], file.read(*place).data
            except DamagedError as error:
                self._lose(file.path, names[place[0]], error.what, broken, error)
