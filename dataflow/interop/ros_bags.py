"""ROS 1 bags, through the `rosbags` library."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from rosbags.interfaces import ConnectionExtRosbag1
from rosbags.rosbag1 import Reader, ReaderError

from dataflow.interop.bag import Topic, is_latched
from dataflow.interop.joined_bag import BrokenFileError, IntactFile, SalvagedBag
from dataflow.interop.ros2_folder import absent_parts
from dataflow.interop.salvage import DamagedFile, DamagedRos1Bag, Row
from dataflow.interop.typestores import ros_type
from dataflow.recording.streams.codecs import SchemaText


class RosBag(SalvagedBag):
    """Reads ROS 1 bag files whose topics belong together: one, or those of a split recording. One that has no index, or
    is damaged, is read record by record."""

    kind = "ROS 1 bag"
    _wreck = DamagedRos1Bag

    def __init__(self, path: Path, files: Sequence[Path], *, strict: bool = False) -> None:
        super().__init__(path, files, strict=strict)
        self.notes = (*absent_parts(files), *self.notes)
        self.promised = sum((f.promised for f in self.files if isinstance(f, Indexed)), Counter())

    def _sound(self, file: Path, notes: list[str]) -> Indexed:
        return Indexed(file)

    def _channels(self, file: IntactFile | DamagedFile) -> Iterator[tuple[int, Topic]]:
        """The topics of a file, their types named as in ROS 2."""
        for identity, topic in file.topics():
            schema = topic.schema
            yield identity, replace(topic, schema=SchemaText(ros_type(schema.name), schema.encoding, schema.data))


class Indexed:
    """One bag file by its index, through the `rosbags` library. Raises `BrokenFileError`, `OSError`."""

    def __init__(self, path: Path) -> None:
        self.path, self._reader = path, Reader(path)
        try:
            self._reader.open()
        except OSError:
            raise
        except Exception as error:  # the library raises whatever broken bytes make it raise
            raise BrokenFileError(path, _reason(error)) from error
        names = {c.id: c.topic for c in self._reader.connections}
        self.promised: Counter[str] = Counter()
        for number, held in (each for chunk in self._reader.chunk_infos for each in chunk.connection_counts.items()):
            if number in names:  # else the bag's end describes no such connection
                self.promised[names[number]] += held

    def topics(self) -> Iterator[tuple[int, Topic]]:
        """The topics by the number of their connection."""
        for connection in self._reader.connections:
            assert isinstance(connection.ext, ConnectionExtRosbag1)
            index = self._reader.indexes.get(connection.id)
            first, last = (index[0].time, index[-1].time) if index else (None, None)
            schema = SchemaText(connection.msgtype, "ros1msg", connection.msgdef.data.encode())
            latched = is_latched(connection.topic) or bool(connection.ext.latching)
            count = connection.msgcount
            yield connection.id, Topic(connection.topic, "ros1", schema, count, first, last, None, latched, {})

    def rows(self, topics: Collection[int]) -> Iterator[Row]:
        """The messages of some topics by log time."""
        chosen = [c for c in self._reader.connections if c.id in topics]
        try:
            for connection, log_time, data in self._reader.messages(connections=chosen) if chosen else ():
                yield log_time, connection.id, data
        except Exception as error:  # the library raises whatever broken bytes make it raise
            if isinstance(error, OSError) and error.errno is not None:  # the disk's, not that of a decompressor
                raise
            raise BrokenFileError(self.path, _reason(error)) from error

    def close(self) -> None:
        """Closes it. Idempotent."""
        if self._reader.bio is not None:
            self._reader.close()


def _reason(error: Exception) -> str:
    if "not indexed" in str(error):
        return "the bag has no index, since its recorder was killed"
    if isinstance(error, ReaderError):
        return str(error).rstrip(".")
    return f"it cannot be read as a bag: {type(error).__name__}: {error}"
