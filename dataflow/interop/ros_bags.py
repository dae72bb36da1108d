"""ROS 1 bags and ROS 2 bags with sqlite3 storage, through the `rosbags` library."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, ConnectionExtRosbag1, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as Reader1Error
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as Reader2Error

from dataflow.interop.bag import BagError, Stored, Topic, is_latched
from dataflow.recording.codecs import SchemaText

_FORMATS = {
    MessageDefinitionFormat.MSG: "ros2msg",
    MessageDefinitionFormat.IDL: "ros2idl",
    MessageDefinitionFormat.NONE: "",
}
TRANSIENT_LOCAL = 1


class RosBag:
    """Reads one ROS 1 bag file, or one ROS 2 bag with sqlite3 storage (a folder with its metadata, or a .db3 file)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ros1 = path.suffix == ".bag"
        self._reader: Any = None
        try:
            reader: Any = Reader1(path) if self._ros1 else Reader2(path)
            reader.open()
            self._reader = reader
        except (Reader1Error, Reader2Error, AssertionError, UnicodeDecodeError) as error:
            raise BagError(f"{path}: {_reason(error)}") from error
        except OSError:
            raise
        except Exception as error:  # sqlite and yaml raise errors of their own
            raise BagError(f"{path} cannot be opened as a bag: {type(error).__name__}: {error}") from error
        self.kind = "ROS 1 bag" if self._ros1 else "ROS 2 bag (sqlite3)"
        self.notes: tuple[str, ...] = ()
        grouped: dict[str, list[Connection]] = {}
        for connection in reader.connections:
            grouped.setdefault(connection.topic, []).append(connection)
        times = self._times() if self._ros1 else {}
        self.topics: Mapping[str, Topic] = {
            name: self._topic(name, connections, times) for name, connections in sorted(grouped.items())
        }

    def _topic(self, name: str, connections: list[Connection], times: dict[int, tuple[int, int]]) -> Topic:
        types = {(c.msgtype, c.msgdef.data) for c in connections}
        if len({kind for kind, _ in types}) > 1:
            named = ", ".join(sorted({kind for kind, _ in types}))
            raise BagError(f"{self.path}: topic {name!r} is recorded with several types: {named}")
        first = connections[0]
        encoding = "ros1msg" if self._ros1 else _FORMATS[first.msgdef.format]
        spans = [times[c.id] for c in connections if c.id in times]
        return Topic(
            name,
            "ros1" if self._ros1 else "cdr",
            SchemaText(first.msgtype, encoding, first.msgdef.data.encode()),
            sum(c.msgcount for c in connections),
            min((a for a, _ in spans), default=None),
            max((b for _, b in spans), default=None),
            None,
            is_latched(name) or any(_latched(c) for c in connections),
            {},
        )

    def _times(self) -> dict[int, tuple[int, int]]:
        """The first and last log time by connection of a ROS 1 bag, from its index."""
        return {number: (rows[0].time, rows[-1].time) for number, rows in self._reader.indexes.items() if rows}

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times."""
        chosen = [c for c in self._reader.connections if c.topic in topics]
        if not chosen:
            return
        counters = {name: count() for name in topics}
        try:
            for connection, log_time, data in self._reader.messages(connections=chosen):
                yield Stored(connection.topic, next(counters[connection.topic]), log_time, data)
        except (Reader1Error, Reader2Error) as error:
            raise BagError(f"{self.path}: {_reason(error)}") from error

    def close(self) -> None:
        """Closes the files. Idempotent."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def _latched(connection: Connection) -> bool:
    ext = connection.ext
    if isinstance(ext, ConnectionExtRosbag1):
        return bool(ext.latching)
    assert isinstance(ext, ConnectionExtRosbag2)
    return any(getattr(qos.durability, "value", qos.durability) == TRANSIENT_LOCAL for qos in ext.offered_qos_profiles)


def _reason(error: Exception) -> str:
    text = str(error) or type(error).__name__
    if "not indexed" in text:
        return "the bag has no index, since its recorder was killed; `rosbag reindex` makes one"
    return text.rstrip(".")
