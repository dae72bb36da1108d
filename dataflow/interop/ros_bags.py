"""ROS 1 bags, through the `rosbags` library."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, ConnectionExtRosbag1
from rosbags.rosbag1 import Reader, ReaderError

from dataflow.interop.bag import BagError, Stored, Topic, is_latched
from dataflow.interop.channels import join
from dataflow.interop.ros2_folder import absent_parts
from dataflow.recording.streams.codecs import SchemaText


class RosBag:
    """Reads ROS 1 bag files whose topics belong together: one, or those of a split recording."""

    def __init__(self, path: Path, files: Sequence[Path]) -> None:
        self.path, self.kind = path, "ROS 1 bag" + (f", {len(files)} files" if len(files) > 1 else "")
        self._readers: list[Any] = []
        self.promised: Mapping[str, int] = {}
        try:
            for file in files:
                self._readers.append(_opened(file))
            joined = join(
                ((number, c.id), self._topic(c, reader.indexes.get(c.id)))
                for number, reader in enumerate(self._readers)
                for c in reader.connections
            )
        except BaseException:
            self.close()
            raise
        self.topics, self._owner = joined.topics, joined.owner
        self.notes: tuple[str, ...] = (*absent_parts(files), *joined.notes)
        promised: Counter[str] = Counter()
        for reader in self._readers:
            names = {c.id: c.topic for c in reader.connections}
            for number, held in (each for chunk in reader.chunk_infos for each in chunk.connection_counts.items()):
                if number in names:  # else the bag's end describes no such connection
                    promised[names[number]] += held
        self.promised = promised

    def _topic(self, connection: Connection, index: Sequence[Any] | None) -> Topic:
        assert isinstance(connection.ext, ConnectionExtRosbag1)
        first, last = (index[0].time, index[-1].time) if index else (None, None)
        return Topic(
            connection.topic,
            "ros1",
            SchemaText(connection.msgtype, "ros1msg", connection.msgdef.data.encode()),
            connection.msgcount,
            first,
            last,
            None,
            is_latched(connection.topic) or bool(connection.ext.latching),
            {},
        )

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times."""
        counters = {name: count() for name in topics}
        merged = heapq.merge(*(self._one(number, topics) for number in range(len(self._readers))), key=lambda m: m[0])
        for log_time, name, data in merged:
            yield Stored(name, next(counters[name]), log_time, data)

    def _one(self, number: int, topics: Collection[str]) -> Iterator[tuple[int, str, bytes]]:
        reader = self._readers[number]
        chosen = [c for c in reader.connections if self._owner[number, c.id] in topics]
        try:
            for connection, log_time, data in reader.messages(connections=chosen) if chosen else ():
                yield log_time, self._owner[number, connection.id], data
        except (ReaderError, AssertionError) as error:
            raise BagError(f"{reader.path}: {_reason(reader.path, error)}") from error

    def close(self) -> None:
        """Closes the files. Idempotent."""
        for reader in self._readers:
            reader.close()
        self._readers.clear()


def _opened(file: Path) -> Reader:
    """A bag file, opened; raises `BagError`, `OSError`."""
    try:
        reader = Reader(file)
        reader.open()
    except (ReaderError, AssertionError, UnicodeDecodeError) as error:
        raise BagError(f"{file}: {_reason(file, error)}") from error
    except OSError:
        raise
    except Exception as error:  # the library raises whatever broken bytes make it raise
        raise BagError(f"{file} cannot be opened as a bag: {type(error).__name__}: {error}; {_saved(file)}") from error
    return reader


def _reason(path: Path, error: Exception) -> str:
    text = str(error) or type(error).__name__
    if "not indexed" in text:
        return f"the bag has no index, since its recorder was killed; {_saved(path)}"
    return text.rstrip(".")


def _saved(path: Path) -> str:
    return f"`dataflow recover {path} -o OUT.mcap` saves the messages that can be read"
