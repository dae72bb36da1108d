"""ROS 1 bags, through the `rosbags` library."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, ConnectionExtRosbag1
from rosbags.rosbag1 import Reader, ReaderError

from dataflow.interop.bag import BagError, Stored, Topic, is_latched
from dataflow.interop.channels import join
from dataflow.recording.codecs import SchemaText


class RosBag:
    """Reads one ROS 1 bag file."""

    kind = "ROS 1 bag"

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader: Any = None
        try:
            reader: Any = Reader(path)
            reader.open()
            self._reader = reader
        except (ReaderError, AssertionError, UnicodeDecodeError) as error:
            raise BagError(f"{path}: {_reason(path, error)}") from error
        except OSError:
            raise
        except Exception as error:  # the library raises whatever broken bytes make it raise
            raise BagError(
                f"{path} cannot be opened as a bag: {type(error).__name__}: {error}; {_saved(path)}"
            ) from error
        times = self._times()
        joined = join((c.id, self._topic(c, times.get(c.id))) for c in reader.connections)
        self.topics, self._owner = joined.topics, joined.owner
        self.notes: tuple[str, ...] = joined.notes
        self.promised: Mapping[str, int] = {}

    def _topic(self, connection: Connection, span: tuple[int, int] | None) -> Topic:
        assert isinstance(connection.ext, ConnectionExtRosbag1)
        first, last = span or (None, None)
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

    def _times(self) -> dict[int, tuple[int, int]]:
        """The first and last log time by connection of a ROS 1 bag, from its index."""
        return {number: (rows[0].time, rows[-1].time) for number, rows in self._reader.indexes.items() if rows}

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times."""
        chosen = [c for c in self._reader.connections if self._owner[c.id] in topics]
        if not chosen:
            return
        counters = {name: count() for name in topics}
        try:
            for connection, log_time, data in self._reader.messages(connections=chosen):
                name = self._owner[connection.id]
                yield Stored(name, next(counters[name]), log_time, data)
        except (ReaderError, AssertionError) as error:
            raise BagError(f"{self.path}: {_reason(self.path, error)}") from error

    def close(self) -> None:
        """Closes the files. Idempotent."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def _reason(path: Path, error: Exception) -> str:
    text = str(error) or type(error).__name__
    if "not indexed" in text:
        return f"the bag has no index, since its recorder was killed; {_saved(path)}"
    return text.rstrip(".")


def _saved(path: Path) -> str:
    return f"`dataflow recover {path} -o OUT.mcap` saves the messages that can be read"
