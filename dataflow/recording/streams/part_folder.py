"""A folder of the parts of one recording, NAME_000.mcap and so on, read as one file.

A message that several parts hold, since firings of both take it, is read once.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import accumulate, groupby, pairwise
from pathlib import Path

from mcap.records import Channel, Schema

from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import CUT, RECORDING, Kind
from dataflow.recording.mcap.attachments import Attachment, Place
from dataflow.recording.mcap.cache import ChunkCache
from dataflow.recording.mcap.chunks import Column
from dataflow.recording.mcap.contents import Entries
from dataflow.recording.mcap.index import McapFile, RawMessage
from dataflow.recording.mcap.message_index import MessageIndex
from dataflow.recording.mcap.rawfile import Watch
from dataflow.recording.streams.cutting import cut_of

_PART = re.compile(r"(.+)_(\d{3,})\.mcap")
_ONCE = (Kind.STREAM, Kind.COMPANION, Kind.FRAMES)
"""Channels whose times increase, so that a part holds again what is not after those before it."""

NOTHING_IN_IT = "holds nothing: its writer died as it began the file"


def holds_nothing(file: McapFile | PartedFile) -> bool:
    """Returns whether the writer of a file died before it had stored a message or a record, or could store nothing."""
    blank = not (file.channels or file.metadata or file.attachments)
    return (file.torn or blank) and not any(map(file.index.count, file.channels))


def parts_in(folder: Path) -> list[Path]:
    """The parts of a recording that are a folder's only MCAP files, in order; none for any other folder.

    Raises `RecordingError` where one is missing between others.
    """
    found = {path: _PART.fullmatch(path.name) for path in folder.glob("*.mcap")}
    stems = {None if match is None else match[1] for match in found.values()}
    if len(found) < 2 or len(stems) > 1 or None in stems:
        return []
    numbered = sorted((int(match[2]), path) for path, match in found.items() if match is not None)
    for (one, path), (other, _) in pairwise(numbered):
        if other != one + 1:
            raise RecordingError(f"{folder}: the part after {path.name} is missing: number {one + 1}")
    return [path for _, path in numbered]


class PartedFile:
    """The parts of a recording as one file (see `McapFile`). Chunks and channels are numbered through all of them."""

    own = True

    def __init__(self, path: Path, parts: Sequence[Path], *, watch: Watch | None = None) -> None:
        self.path = path
        self._files: list[McapFile] = []
        bare: list[Path] = []
        cache = ChunkCache()
        try:
            for part in parts:
                begun = None if not part.stat().st_size else McapFile(part, watch=watch, cache=cache)
                if begun is None or holds_nothing(begun):
                    bare.append(part)
                    if begun is not None:
                        begun.close()
                    continue
                self._files.append(begun)
                if not any(name == RECORDING for name, _ in self._files[-1].metadata):
                    raise RecordingError(f"{part} is no recording of this program, so {path} is not one in parts")
        except BaseException:
            self.close()
            raise
        if not self._files:
            raise RecordingError(f"{path}: nothing is in any of its parts")
        self.header = self._files[0].header
        self.torn = self._files[-1].torn or parts[-1] in bare
        self.lacking = [text for file in self._files for text in file.lacking]
        if parts[-1] in bare:
            self.lacking.append(f"{parts[-1].name} {NOTHING_IN_IT}")
        self.lost_bytes = sum(file.lost_bytes for file in self._files)
        self.nbytes = sum(file.nbytes for file in self._files)
        self.damage = [f"{f.path.name}: {note}" for f in self._files for note in f.damage]
        self.damage += [
            f"{f.path.name} has no proper end, and is not the last part" for f in self._files[:-1] if f.torn
        ]
        self.damage += [f"{part.name} {NOTHING_IN_IT}" for part in bare]
        self.metadata = self._joined_metadata()
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        numbers: list[dict[int, int]] = []
        known: dict[tuple[object, ...], int] = {}
        for file in self._files:
            numbers.append({})
            for channel in file.channels.values():
                schema = file.schemas.get(channel.schema_id)
                text = None if schema is None else (schema.name, schema.encoding, schema.data)
                about = (channel.topic, channel.message_encoding, text, *sorted(channel.metadata.items()))
                number = numbers[-1][channel.id] = known.setdefault(about, len(known) + 1)
                if schema is not None:
                    self.schemas.setdefault(number, replace(schema, id=number))
                self.channels.setdefault(number, replace(channel, id=number, schema_id=number if schema else 0))
        self._numbers = numbers
        self._bases = [0, *accumulate(file.chunks for file in self._files)]
        once = {number for number, c in self.channels.items() if c.metadata.get("kind") in _ONCE}
        self._owns = [{number: own for own, number in of.items()} for of in numbers]
        indexes = list(zip((file.index for file in self._files), self._owns, strict=True))
        self.index: MessageIndex = _JoinedIndex(indexes, self._bases, once)

    def _joined_metadata(self) -> list[tuple[str, dict[str, str]]]:
        """The records of all parts; of the whole recording nothing was cut off, unless of its ends."""
        cuts = [cut_of(dict(file.metadata)) for file in self._files]
        records = [(name, values) for file in self._files for name, values in file.metadata if name != CUT]
        first, last = cuts[0], cuts[-1]
        start, end = (None if first is None else first.start), (None if last is None else last.end)
        if first is not None and (start is not None or end is not None):
            records.append((CUT, replace(first, start=start, end=end).metadata()))
        return records

    @cached_property
    def attachments(self) -> Sequence[Place]:
        """The attachments, each once; `offset` counts through all parts."""
        return list(self._attached)

    @cached_property
    def _attached(self) -> Mapping[Place, Attachment]:
        found: dict[Place, Attachment] = {}
        seen = set()
        start = 0
        for file in self._files:
            for place in file.attachments:
                attachment = file.attachment(place)
                if (attachment.name, attachment.key) not in seen:
                    seen.add((attachment.name, attachment.key))
                    found[replace(place, offset=start + place.offset)] = attachment
            start += file.nbytes
        return found

    def attachment(self, place: Place) -> Attachment:
        """The attachment at a place."""
        return self._attached[place]

    def message_bytes(self) -> dict[int, int]:
        """Bytes of message data by channel, as in `McapFile`; what several parts hold counts in each."""
        totals: dict[int, int] = {}
        for file, numbers in zip(self._files, self._numbers, strict=True):
            for channel, size in file.message_bytes().items():
                totals[numbers[channel]] = totals.get(numbers[channel], 0) + size
        return totals

    def read(self, channel: int, chunk: int, offset: int, log_time: int) -> RawMessage:
        """The message that an entry of the index points to. Raises `DamagedError` where another one is there."""
        part = bisect_right(self._bases, chunk) - 1
        return (
            self._files[part]
            .read(self._owns[part][channel], chunk - self._bases[part], offset, log_time)
            ._replace(channel=channel)
        )

    def close(self) -> None:
        """Closes the files. Idempotent."""
        for file in self._files:
            file.close()


class _JoinedIndex:
    """The indexes of several parts as one; each with its channels by the numbers that they have here."""

    def __init__(
        self, parts: Sequence[tuple[MessageIndex, Mapping[int, int]]], bases: Sequence[int], once: Collection[int]
    ) -> None:
        self._parts, self._bases, self._once = parts, bases, once
        self._kept: dict[int, list[tuple[int, int, int | None, int]]] = {}

    def _parts_of(self, channel: int) -> list[tuple[int, int, int | None, int]]:
        """The parts that hold a channel: (part, its own number, the time up to which others hold it, messages)."""
        if channel not in self._kept:
            found: list[tuple[int, int, int | None, int]] = []
            newest: int | None = None
            for number, (index, channels) in enumerate(self._parts):
                own = channels.get(channel)
                span = None if own is None else index.span(own)
                if own is None or span is None:
                    continue
                after = newest if channel in self._once and newest is not None and span[0] <= newest else None
                count = index.count(own)
                if after is not None:
                    count = sum(int((part.times > after).sum()) for part in index.blocks(own, after + 1, None))
                found.append((number, own, after, count))
                newest = span[1] if newest is None else max(newest, span[1])
            self._kept[channel] = found
        return self._kept[channel]

    def count(self, channel: int) -> int:
        return sum(count for _, _, _, count in self._parts_of(channel))

    def span(self, channel: int) -> tuple[int, int] | None:
        spans = [span for k, own, _, _ in self._parts_of(channel) if (span := self._parts[k][0].span(own)) is not None]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    def entries(self, channel: int) -> Entries:
        return Entries.joined(self.blocks(channel, None, None))

    def blocks(self, channel: int, start: int | None, end: int | None) -> Iterator[Entries]:
        for number, own, after, _ in self._parts_of(channel):
            span = self._parts[number][0].span(own)
            if span is None or (start is not None and span[1] < start) or (end is not None and span[0] > end):
                continue
            low = start if after is None else max(after + 1, after + 1 if start is None else start)
            for part in self._parts[number][0].blocks(own, low, end):
                yield self._moved(number, part, after)

    def in_file_order(
        self, channels: Collection[int], start: int | None = None, end: int | None = None, skip: int = 0
    ) -> Iterator[tuple[int, Mapping[int, Entries]]]:
        held = sorted(
            (k, own, channel, after, n) for channel in channels for k, own, after, n in self._parts_of(channel)
        )
        before, whole = 0, start is None and end is None
        for number, listed in groupby(held, key=lambda item: item[0]):
            here = {own: (channel, after, count) for _, own, channel, after, count in listed}
            count = sum(count for _, _, count in here.values())
            if whole and before + count <= skip:
                before += count
                continue
            once = any(after is not None for _, after, _ in here.values())
            left = 0 if once else max(0, skip - before)
            passed = 0
            for ahead, part in self._parts[number][0].in_file_order(list(here), start, end, left):
                moved = {here[own][0]: self._moved(number, found, here[own][1]) for own, found in part.items()}
                passed = passed if once else ahead
                yield before + passed, moved
                passed += sum(map(len, moved.values()))
            before += passed

    def sample(self) -> tuple[Mapping[int, Entries], Column | None]:
        raise RecordingError("sizes of streams are available part by part only")

    def _moved(self, number: int, entries: Entries, after: int | None) -> Entries:
        kept = entries if after is None else entries.where(entries.times > after)
        return Entries(kept.times, kept.chunks + self._bases[number], kept.offsets)
