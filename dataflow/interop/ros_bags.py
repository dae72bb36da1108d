"""ROS 1 bags, through the `rosbags` library."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

from rosbags.interfaces import ConnectionExtRosbag1
from rosbags.rosbag1 import Reader, ReaderError

from dataflow.interop.bag import BagError, Lost, Stored, Topic, is_latched
from dataflow.interop.channels import join
from dataflow.interop.ros2_folder import absent_parts
from dataflow.interop.salvage import Ros1Wreck, Row
from dataflow.interop.typestores import ros_type
from dataflow.recording.streams.codecs import SchemaText


class RosBag:
    """Reads ROS 1 bag files whose topics belong together: one, or those of a split recording. One that has no index, or
    is damaged, is read record by record; `strict`: that is an error.
    """

    def __init__(self, path: Path, files: Sequence[Path], *, strict: bool = False) -> None:
        self.path, self.kind = path, "ROS 1 bag" + (f", {len(files)} files" if len(files) > 1 else "")
        self.lost, self._strict = Lost(), strict
        self._files: list[Indexed | Ros1Wreck] = []
        notes = absent_parts(files)
        try:
            for file in files:
                self._files.append(self._opened(file, notes))
            joined = join(
                ((number, identity), topic)
                for number, opened in enumerate(self._files)
                for identity, topic in _named(opened)
            )
        except BaseException:
            self.close()
            raise
        self.topics, self._owner = joined.topics, joined.owner
        self.notes: tuple[str, ...] = (*notes, *joined.notes)
        promised: Counter[str] = Counter()
        for opened in self._files:
            promised.update(opened.promised if isinstance(opened, Indexed) else {})
        self.promised: Mapping[str, int] = promised

    def _opened(self, file: Path, notes: list[str]) -> Indexed | Ros1Wreck:
        try:
            return Indexed(file)
        except BagError as error:
            if self._strict:
                raise
            wreck, told, lacks = self._wrecked(file, str(error))
        (self.lost.parts if lacks else notes).append(told)
        return wreck

    def _wrecked(self, file: Path, reason: str) -> tuple[Ros1Wreck, str, bool]:
        """A damaged bag, record by record; what is told of it; whether anything is known to be missing.

        Raises `BagError` where nothing is left of it.
        """
        try:
            wreck = Ros1Wreck(file)
        except ValueError as error:
            raise BagError(reason) from error
        if not wreck.counts():
            wreck.close()
            raise BagError(f"{reason}; no whole message is left in it")
        what = reason.removeprefix(f"{file}: ").partition("; `dataflow recover")[0]
        told = [f"{file.name}: {what}", "its records are read one by one", *wreck.losses()]
        return wreck, "; ".join(told), len(told) > 2

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times. Those that damage keeps from being read are counted
        in `lost`; where it was opened strictly, they raise `BagError`."""
        counters = {name: count() for name in topics}
        merged = heapq.merge(*(self._one(number, topics) for number in range(len(self._files))), key=lambda m: m[0])
        for log_time, name, data in merged:
            yield Stored(name, next(counters[name]), log_time, data)

    def _one(self, number: int, topics: Collection[str]) -> Iterator[tuple[int, str, bytes]]:
        """The messages of one file; behind the first that cannot be read, those that its records still hold."""
        opened = self._files[number]
        names = {place[1]: name for place, name in self._owner.items() if place[0] == number and name in topics}
        last, since = None, 0
        try:
            for log_time, identity, data in opened.rows(list(names)) if names else ():
                since = since + 1 if log_time == last else 1
                last = log_time
                yield log_time, names[identity], data
            return
        except BagError as error:
            if self._strict:
                raise
            counted = {identity: topic.count for identity, topic in _named(opened)}
            opened.close()
            opened, told, _ = self._wrecked(opened.path, str(error))
            self._files[number] = opened
            self.lost.parts.append(told)
            found = opened.counts()
            for identity, held in counted.items():
                if (missing := held - found.get(identity, 0)) > 0:
                    self.lost.take(self._owner[number, identity], missing, told)
        for log_time, identity, data in opened.rows(list(names), last, since):
            yield log_time, names[identity], data

    def close(self) -> None:
        """Closes the files. Idempotent."""
        self.lost.announce(self.path)
        for opened in self._files:
            opened.close()
        self._files.clear()


def _named(opened: Indexed | Ros1Wreck) -> Iterator[tuple[int, Topic]]:
    """The topics of a file, their types named as in ROS 2."""
    for identity, topic in opened.topics():
        schema = topic.schema
        yield identity, replace(topic, schema=SchemaText(ros_type(schema.name), schema.encoding, schema.data))


class Indexed:
    """One bag file by its index, through the `rosbags` library. Raises `BagError`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = _opened(path)
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
            raise BagError(f"{self.path}: {_reason(self.path, error)}") from error

    def close(self) -> None:
        """Closes it. Idempotent."""
        if self._reader.bio is not None:
            self._reader.close()


def _opened(file: Path) -> Reader:
    """A bag file, opened; raises `BagError`, `OSError`."""
    reader = Reader(file)
    try:
        reader.open()
    except OSError:
        raise
    except Exception as error:  # the library raises whatever broken bytes make it raise
        raise BagError(f"{file}: {_reason(file, error)}") from error
    return reader


def _reason(path: Path, error: Exception) -> str:
    if "not indexed" in str(error):
        return f"the bag has no index, since its recorder was killed; {_saved(path)}"
    if isinstance(error, ReaderError):
        return f"{str(error).rstrip('.')}; {_saved(path)}"
    return f"it cannot be read as a bag: {type(error).__name__}: {error}; {_saved(path)}"


def _saved(path: Path) -> str:
    return f"`dataflow recover {path} -o OUT.mcap` saves the messages that can be read"
