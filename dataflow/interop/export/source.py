"""The streams of a recording or the topics of a bag for an export, and those that nothing here can read."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Self

from dataflow.interop.account import Account
from dataflow.interop.bag import Bag, BagError, Stored, Topic, shortfalls
from dataflow.interop.clocks import Choice
from dataflow.interop.opening import is_foreign, open_bag
from dataflow.interop.playing import PLAIN, BagReadOptions, readable
from dataflow.interop.streams import BagStreams
from dataflow.messages import Message
from dataflow.recording import Recorded, Recording, RecordingError, StreamInfo
from dataflow.recording.layout import BAG, RECORDING


def distinct(names: Iterable[str], called: Callable[[str], str], taken: Iterable[str] = ()) -> dict[str, str]:
    """Returns the name of each in an output: `called(name)`, `_2` or more behind one that is taken.

    Names that are called as they are keep their name.
    """
    found: dict[str, str] = {}
    used = set(taken)
    for name in sorted(set(names), key=lambda name: (called(name) != name, name)):
        wanted = called(name)
        options = (wanted, *(f"{wanted}_{number}" for number in range(2, len(used) + 3)))
        found[name] = next(option for option in options if option not in used)
        used.add(found[name])
    return found


class ExportSource:
    """A recording or a bag opened for conversion: a context manager.

    `streams`: what is read as messages, by name; `names`: what each is called outside (without the namespace).
    `untouched`: topics that no message type fits; `bag`: the same file as a bag, None for one that is none.
    `start`, `end`: stamps (ns) of the span.
    """

    def __init__(
        self,
        path: Path,
        topics: Sequence[str] | None = None,
        clock: Choice = "auto",
        start: int | None = None,
        end: int | None = None,
        wishes: BagReadOptions = PLAIN,
    ) -> None:
        self.path, self.foreign = Path(path), is_foreign(Path(path))
        self._reader: Recording | BagStreams | None = None
        self.bag: Bag = open_bag(self.path, strict=wishes.strict)
        self.start, self.end = start, end
        try:
            if self.foreign:
                self._reader = readable(self.bag, self.path, clock, topics, wishes, accounting=True)
                namespace = ""
                self.account = self._reader.account
            else:
                if wishes.depth:
                    raise BagError(f"{self.path} is a recording: its depth is in metres, and no topic of it is made so")
                self._reader = Recording(self.path)
                namespace = self._reader.metadata.get(RECORDING, {}).get("namespace", "")
                self.account = Account(list(self.bag.notes), shortfalls(self.bag))
            self.streams: dict[str, StreamInfo] = {
                name: info
                for name, info in self._reader.streams.items()
                if info.message_type is not None and info.count and (topics is None or name in topics)
            }
            self.names = {name: name.removeprefix(f"{namespace}/") if namespace else name for name in self.streams}
            self.topics = self._topics_of(self._reader)
            self.untouched: tuple[Topic, ...] = tuple(
                topic
                for name, topic in self.bag.topics.items()
                if name not in self._reader.streams or self._reader.streams[name].message_type is None
                if topics is None or name in topics
            )
        except BaseException:
            self.close()
            raise

    def _topics_of(self, reader: Recording | BagStreams) -> dict[str, str]:
        """The topic of the bag that each stream comes from, of a bag and of a recording that was made of one."""
        known = {name: info.metadata["topic"] for name, info in self.streams.items() if "topic" in info.metadata}
        try:
            played = json.loads(reader.metadata.get(BAG, {}).get("topics", "{}"))
        except ValueError:
            return known
        return {name: topic for name, topic in played.items() if name in self.streams} | known

    @property
    def shift(self) -> int:
        """Nanoseconds that are added to the log times of a bag so that they are of the clock of its streams."""
        return self._reader.clock.shift if isinstance(self._reader, BagStreams) else 0

    def facts(self) -> dict[str, str]:
        """Metadata of a recording that was made of a bag; complete when all messages have been read."""
        assert isinstance(self._reader, BagStreams)
        self._count_lost()
        told = {name: text for name, text in self._reader.facts().items() if name != "topics"}
        account = self.account.as_json()
        kept = {name: json.dumps(account[name], ensure_ascii=False) for name in ("unread", "lost") if account[name]}
        return told | kept

    def _count_lost(self) -> None:
        """Takes into the account what damage has kept from being read."""
        if isinstance(self._reader, BagStreams):
            self.bag.lost.join(self._reader.lost)
            self.account.short[:] = shortfalls(self.bag)

    @property
    def clock(self) -> str:
        """The clock of a bag, and why; empty for a recording."""
        return f"{self._reader.clock.kind}: {self._reader.clock.why}" if isinstance(self._reader, BagStreams) else ""

    def messages(self, names: Sequence[str] | None = None) -> Iterator[Recorded]:
        """The messages of some streams, or of all, merged by (stamp, stream); static ones first."""
        assert self._reader is not None
        return self._reader.messages(list(self.streams if names is None else names), self.start, self.end)

    def of_type(self, *types: type[Message]) -> list[str]:
        """Streams of some message types, the order of `types` first."""
        return [name for kind in types for name, info in self.streams.items() if info.message_type is kind]

    def first_stamp(self, names: Sequence[str] | None = None) -> int | None:
        """The stamp of the first message of some streams, or of all, that is not static; None where there is none."""
        chosen = [self.streams[name] for name in (self.streams if names is None else names)]
        firsts = [info.first for info in chosen if not info.static and info.first is not None]
        return max(min(firsts), self.start or 0) if firsts else None

    def stored(self, topics: Sequence[str]) -> Iterator[Stored]:
        """Serialised messages of topics by log time, on the clock of the streams, those of the span."""
        low, high = self.start or 0, self.end
        for stored in self.bag.messages(topics):
            time = max(stored.log_time + self.shift, 0)
            if time >= low and (high is None or time <= high):
                yield stored._replace(log_time=time)

    def only(self, what: str, *types: type[Message]) -> str:
        """The one stream of some types; raises `RecordingError` that names the choice."""
        found = self.of_type(*types)
        if len(found) == 1:
            return found[0]
        kinds = " or ".join(t.__name__ for t in types)
        if not found:
            raise RecordingError(f"{self.path}: {what} takes a stream of {kinds}; there is none among those chosen")
        names = ", ".join(self.names[name] for name in found)
        raise RecordingError(
            f"{self.path}: {what} takes one stream of {kinds}; leave out with --without all but one of {names}"
        )

    def close(self) -> None:
        """Closes the files. Idempotent."""
        if self._reader is not None:
            self._count_lost()
            self._reader.close()
        self.bag.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
