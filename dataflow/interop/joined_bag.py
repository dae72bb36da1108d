"""Bags of several files: channels joined into topics, messages merged, broken files read record by record."""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import zstandard

from dataflow.interop.bag import BagError, DamageReport, Stored, Topic
from dataflow.interop.salvage import DamagedFile
from dataflow.interop.unpacking import unpacked_message
from dataflow.recording.errors import RecordingError

Place = tuple[int, int]
"""Number of a file, and of a channel in it."""
Row = tuple[int, int, bytes | memoryview]
"""(log time, number of the channel, message)"""


class OpenedFile(Protocol):
    """One file of a bag."""

    path: Path

    def close(self) -> None:
        """Closes it. Idempotent."""


File = TypeVar("File", bound=OpenedFile)


class JoinedBag(ABC, Generic[File]):
    """Files whose topics belong together, as one bag. A subclass opens a file, and reads its channels and messages.

    `closing`: what else ends when the bag is closed.
    """

    kind = ""

    def __init__(self, path: Path, files: Sequence[Path], *, compressed: bool = False, strict: bool = False) -> None:
        """`compressed`: each message is a zstd frame; `strict`: damage is an error."""
        self.path, self.lost, self.strict = path, DamageReport(), strict
        self.promised: Mapping[str, int] = {}
        self.files: list[File] = []
        self.closing = ExitStack()
        self._compressed = compressed
        notes: list[str] = []
        try:
            for file in files:
                self.files.append(self._opened(file, notes))
            self.topics, self._owner, unusual = join(
                ((number, identity), topic)
                for number, opened in enumerate(self.files)
                for identity, topic in self._channels(opened)
            )
        except BaseException:
            self.close()
            raise
        self.kind += f", {len(files)} files" if len(files) > 1 else ""
        self.notes: tuple[str, ...] = (*notes, *unusual)

    @abstractmethod
    def _opened(self, file: Path, notes: list[str]) -> File:
        """Opens a file, and adds to `notes` what is unusual about it."""

    @abstractmethod
    def _channels(self, file: File) -> Iterator[tuple[int, Topic]]:
        """The channels of a file by number, each as a topic."""

    @abstractmethod
    def _rows(self, number: int, names: Mapping[int, str], broken: Counter[str]) -> Iterator[Row]:
        """The messages of some channels of a file by log time; equal ones as they were written."""

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times; equal ones as they were written. Those that damage
        keeps from being read are counted in `lost`; where it was opened strictly, they raise `BagError`."""
        counters = {name: count() for name in topics}
        broken: Counter[str] = Counter()
        merged = heapq.merge(
            *(self._one(number, topics, broken) for number in range(len(self.files))), key=lambda row: row[0]
        )
        for log_time, name, data in merged:
            yield Stored(name, next(counters[name]), log_time, data)

    def _one(self, number: int, topics: Collection[str], broken: Counter[str]) -> Iterator[tuple[int, str, Any]]:
        names = {place[1]: name for place, name in self._owner.items() if place[0] == number and name in topics}
        for log_time, identity, data in self._rows(number, names, broken) if names else ():
            try:
                yield log_time, names[identity], unpacked_message(data) if self._compressed else data
            except zstandard.ZstdError as error:
                what = f"a message at {log_time} that is no zstd frame: {error}"
                self._lose(self.files[number].path, names[identity], what, broken, error)

    def _lose(self, file: Path, topic: str, what: str, broken: Counter[str], error: Exception) -> None:
        """Counts a message that cannot be read; raises `BagError` where the bag was opened strictly."""
        if self.strict:
            raise BagError(f"{file}, topic {topic}: {what}") from error
        broken[topic] += 1
        self.lost.take(topic, broken[topic], f"{file.name}, {what}")

    def close(self) -> None:
        """Closes the files. Idempotent."""
        self.lost.announce(self.path)
        for file in self.files:
            file.close()
        self.closing.close()


class BrokenFileError(BagError):
    """A file whose format or index is broken, for `reason`: what is left of it can be salvaged."""

    def __init__(self, file: Path, reason: str) -> None:
        super().__init__(f"{file}: {reason}; `dataflow recover {file} -o OUT.mcap` saves the messages that can be read")
        self.reason = reason


class IntactFile(OpenedFile, Protocol):
    """A file whose format and index are sound, as far as they have been read."""

    def topics(self) -> Iterator[tuple[int, Topic]]:
        """The topics by number: those that are declared, and those that hold a message."""

    def rows(self, topics: Collection[int]) -> Iterator[Row]:
        """The messages of some topics by log time; equal ones as they were written. Raises `BrokenFileError`."""


class SalvagedBag(JoinedBag[IntactFile | DamagedFile]):
    """A bag whose broken files are read record by record; opened strictly, they are an error."""

    _wreck: ClassVar[type[DamagedFile]]

    @abstractmethod
    def _sound(self, file: Path, notes: list[str]) -> IntactFile:
        """Opens a sound file, and adds to `notes` what is unusual about it. Raises `BrokenFileError`."""

    def _opened(self, file: Path, notes: list[str]) -> IntactFile | DamagedFile:
        try:
            return self._sound(file, notes)
        except BrokenFileError as error:
            if self.strict:
                raise
            wreck, told, lacks = self._salvaged(file, error.reason)
        (self.lost.parts if lacks else notes).append(told)
        return wreck

    def _channels(self, file: IntactFile | DamagedFile) -> Iterator[tuple[int, Topic]]:
        return file.topics()

    def _salvaged(self, file: Path, reason: str) -> tuple[DamagedFile, str, bool]:
        """A broken file, record by record; the notes about it; whether anything is known to be missing.

        Raises `BagError` where nothing is left of it.
        """
        try:
            wreck = self._wreck(file)
        except (RecordingError, ValueError) as error:
            raise BagError(f"{file}: {reason}; {error}") from error
        if not wreck.counts():
            wreck.close()
            raise BagError(f"{file}: {reason}; no whole message is left in it")
        told = [f"{file.name}: {reason}", f"its {wreck.parts} are read one by one", *wreck.losses()]
        return wreck, "; ".join(told), len(told) > 2

    def _rows(self, number: int, names: Mapping[int, str], broken: Counter[str]) -> Iterator[Row]:
        """The messages of one file; behind the first that cannot be read, those that are left of it."""
        opened = self.files[number]
        last, since = None, 0
        try:
            for row in opened.rows(list(names)):
                since = since + 1 if row[0] == last else 1
                last = row[0]
                yield row
            return
        except BrokenFileError as error:
            if self.strict:
                raise
            counted = {identity: topic.count for identity, topic in opened.topics()}
            opened.close()
            wreck, told, _ = self._salvaged(opened.path, error.reason)
            self.files[number] = wreck
            self.lost.parts.append(told)
            found = wreck.counts()
            for identity, held in counted.items():
                if (missing := held - found.get(identity, 0)) > 0 and (number, identity) in self._owner:
                    self.lost.take(self._owner[number, identity], missing, f"{opened.path.name}: {error.reason}")
        yield from wreck.rows(list(names), last, since)


def join(channels: Iterable[tuple[Place, Topic]]) -> tuple[dict[str, Topic], dict[Place, str], list[str]]:
    """Joins channels of one name where their messages are laid out equally.

    Of channels that are not, the type with most messages keeps the name; each other one is a topic `NAME (TYPE)`.
    Returns the topics by name, in alphabetical order; the topic of each channel; and what is unusual, for people.
    """
    named: dict[str, list[tuple[list[Place], Topic]]] = {}
    for key, topic in channels:
        kinds = named.setdefault(topic.name, [])
        for place, (keys, known) in enumerate(kinds):
            if _same_layout(known, topic):
                kinds[place] = ([*keys, key], _sum(known, topic))
                break
        else:
            kinds.append(([key], topic))
    topics: dict[str, Topic] = {}
    owner: dict[Place, str] = {}
    notes = []
    for name, kinds in named.items():
        kinds.sort(key=lambda kind: -kind[1].count)
        for place, (keys, topic) in enumerate(kinds):
            called = name
            if place:
                called = f"{name} ({topic.schema.name})"
                while called in topics or called in named:
                    called += "'"
                most = kinds[0][1]
                what = "definitions" if topic.schema.name == most.schema.name else "types"
                notes.append(
                    f"topic {name} holds messages of two {what}: {topic.count:,} of {topic.schema.name} are the topic "
                    f"{called!r} here, beside {most.count:,} of {most.schema.name}"
                )
            topics[called] = replace(topic, name=called)
            owner |= dict.fromkeys(keys, called)
    return dict(sorted(topics.items())), owner, notes


def _same_layout(a: Topic, b: Topic) -> bool:
    if a.encoding != b.encoding:
        return False
    if a.schema == b.schema or (a.schema.data == b.schema.data and a.schema.data):
        return True
    if a.encoding not in ("cdr", "ros1"):
        return False
    from dataflow.interop.typestores import same_layout  # rosbags takes long to import

    return same_layout(a.encoding, a.schema, b.schema)


def _sum(a: Topic, b: Topic) -> Topic:
    return replace(
        a,
        schema=a.schema if a.schema.data else b.schema,
        count=a.count + b.count,
        first=min((t for t in (a.first, b.first) if t is not None), default=None),
        last=max((t for t in (a.last, b.last) if t is not None), default=None),
        bytes=None if a.bytes is None or b.bytes is None else a.bytes + b.bytes,
        latched=a.latched or b.latched,
    )
