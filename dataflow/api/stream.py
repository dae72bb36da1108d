"""One stream of a recording: its messages when they are asked for, its fields as columns."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, SupportsIndex, overload

import numpy as np
import numpy.typing as npt

from dataflow.api import frames
from dataflow.api.columns import Column, column, elements, is_narrow, parallel_fields
from dataflow.api.html import StreamFacts, stream_html
from dataflow.arguments import checked
from dataflow.graph.problems import did_you_mean
from dataflow.messages.base import Field, Message
from dataflow.recording import Recorded, Recording, StreamInfo
from dataflow.recording.layout import Kind
from dataflow.recording.streams.access import StreamIndex
from dataflow.recording.streams.json_columns import Values

if TYPE_CHECKING:
    import pandas as pd

Stamps = npt.NDArray[np.int64]


class RecordedStream(Sequence[Message]):
    """The messages of one stream, or some of them; nothing is read before it is asked for.

    `stream[0]`, `stream[-1]` and iteration decode single messages; `stream[10:20]` is a part of the stream, and
    `stream["position"]` the column of a field. `seconds` count from the recording's first message.
    """

    def __init__(self, recording: Recording, name: str, origin: int, places: Stamps | None = None) -> None:
        self._recording, self._origin, self._chosen = recording, origin, places
        self.name = name

    @property
    def info(self) -> StreamInfo:
        """The facts of the stream that need no decoding: schema, encoding, count, size, metadata."""
        return self._recording.streams[self.name]

    @property
    def message_type(self) -> type[Message]:
        """The class of its messages. Raises `RecordingError` where this program has none for them."""
        self._index  # noqa: B018  (raises the error with the reason)
        found = self.info.message_type
        assert found is not None
        return found

    @property
    def fields(self) -> tuple[str, ...]:
        """The names of its messages' fields, in the order of their declaration."""
        return tuple(field.name for field in self.message_type.FIELDS)

    @cached_property
    def _index(self) -> StreamIndex:
        index = self._recording.index(self.name)
        if (unread := self._recording.unread.get(self.name)) is not None:
            warnings.warn(f"{self._recording.path}: {self.name}: {unread}", stacklevel=3)
        return index

    @property
    def partial(self) -> bool:
        """Returns whether this is a part of the stream."""
        return self._chosen is not None

    @cached_property
    def _places(self) -> Stamps:
        return np.arange(len(self._index), dtype=np.int64) if self._chosen is None else self._chosen

    @cached_property
    def stamps(self) -> Stamps:
        """(N,) timestamps in nanoseconds since the epoch."""
        return self._index.stamps[self._places]

    @property
    def seconds(self) -> npt.NDArray[np.float64]:
        """(N,) seconds from the first message of the recording."""
        return np.asarray((self.stamps - self._origin) * 1e-9, np.float64)

    # ------------------------------------------------------------------------------------------------- messages

    def __len__(self) -> int:
        foreign = self.info.message_type is not None and self.info.metadata.get("kind") != Kind.STREAM
        return len(self._places) if foreign or self._chosen is not None else self.info.count

    def __iter__(self) -> Iterator[Message]:
        return (self._index.read(int(place)).message for place in self._places)

    @overload
    def __getitem__(self, item: int) -> Message: ...
    @overload
    def __getitem__(self, item: slice) -> RecordedStream: ...
    @overload
    def __getitem__(self, item: str) -> Column: ...
    def __getitem__(self, item: int | slice | str) -> Message | RecordedStream | Column:
        if isinstance(item, str):
            return self.column(item)
        if isinstance(item, slice):
            return self._part(self._places[item])
        return self.recorded(item).message

    def recorded(self, place: int) -> Recorded:
        """The message at a place with its number and incarnation. Raises `IndexError`, `RecordingError`."""
        if not isinstance(place, SupportsIndex):
            raise TypeError(f"{self.name}: expected a place, a slice, or a field's name, got {place!r}")
        if not -len(self) <= place < len(self):
            raise IndexError(f"message {place} of {self.name}, which has {len(self)}")
        return self._index.read(int(self._places[place]))

    @checked
    def at(self, seconds: float) -> Message | None:
        """The newest message at or before a moment, in seconds from the recording's first message; None before the
        first."""
        earlier = np.flatnonzero(self.stamps <= self._origin + round(seconds * 1e9))
        return self[int(earlier[-1])] if len(earlier) else None

    @checked
    def between(self, start: float | None = None, end: float | None = None) -> RecordedStream:
        """The part from `start` to `end`, both included, in seconds from the recording's first message."""
        return self.within(_stamp(start, self._origin), _stamp(end, self._origin))

    @checked
    def within(self, first: int | None = None, last: int | None = None) -> RecordedStream:
        """The part with first ≤ stamp ≤ last (nanoseconds since the epoch). A static stream stays whole."""
        if self.info.static:
            return self
        inside = np.ones(len(self.stamps), bool)
        if first is not None:
            inside &= self.stamps >= first
        if last is not None:
            inside &= self.stamps <= last
        return self._part(self._places[inside])

    def _part(self, places: Stamps) -> RecordedStream:
        part = RecordedStream(self._recording, self.name, self._origin, places)
        part.__dict__["_index"] = self._index
        return part

    # ------------------------------------------------------------------------------------------------- columns

    @checked
    def column(self, field: str) -> Column:
        """A field of all messages: (N,) of a scalar, (N, ...) of an array.

        Arrays of different shapes make an array of objects. Where a message has none, floating-point columns hold NaN,
        others None. Only the chunks that hold the stream are read. Raises `KeyError` for an unknown field.
        """
        if field == "stamp":
            return self.stamps
        return self.columns(field)[field]

    @checked
    def columns(self, *fields: str) -> dict[str, Column]:
        """Several fields, read in one pass; without names, the scalars and the vectors of fixed length."""
        chosen = self._fields(fields) or tuple(f for f in self.message_type.FIELDS if is_narrow(f))
        values = self._values(chosen)
        return {f.name: column(f, values[f.name]) for f in chosen}

    @checked
    def frame(self, *fields: str) -> pd.DataFrame:
        """A pandas table with a row for each message, by time (UTC).

        `stamp` and `seconds` come first; a vector has a column for each component: `position.x`. Without names of
        fields: the scalars and the vectors of fixed length that any message has. Raises `ImportError` without pandas.
        """
        return frames.frame(self.stamps, self.seconds, self.columns(*fields), asked=bool(fields))

    @checked
    def elements(self, *fields: str) -> pd.DataFrame:
        """A pandas table with a row for each element of parallel arrays: each detection, point or joint.

        `message` is the place of the message in this stream, `element` the place in the message. `class_ids` are given
        their names. Without names of fields: all that run in parallel. Raises `TypeError` for messages that have none.
        """
        able = parallel_fields(self.message_type)
        if not able:
            raise TypeError(f"{self.name} holds {self.message_type.SCHEMA}, which has no parallel arrays; use frame()")
        chosen = self._fields(fields) or able
        lengths = next(f for f in able if f in self.message_type.ARRAYS)
        names = [f for f in self.message_type.FIELDS if f.name == frames.CLASS_NAMES]
        values = self._values(tuple(dict.fromkeys((*chosen, lengths, *names))))
        found = elements(tuple(dict.fromkeys((*chosen, lengths))), values)
        columns = {f.name: found.columns[f.name] for f in chosen if f.name in found.columns}
        class_names = values.get(frames.CLASS_NAMES, ())
        return frames.element_frame(self.stamps, self.seconds, found, columns, class_names)

    def _fields(self, names: Sequence[str]) -> tuple[Field, ...]:
        known = {field.name: field for field in self.message_type.FIELDS}
        for name in names:
            if name not in known:
                raise KeyError(
                    f"{self.message_type.SCHEMA} has no field {name!r}: {did_you_mean(name, known, 'it has')}"
                )
        return tuple(known[name] for name in names)

    def _values(self, fields: Sequence[Field]) -> dict[str, Values]:
        return self._index.columns(self._places, frozenset(field.name for field in fields))

    # ------------------------------------------------------------------------------------------------- display

    def __repr__(self) -> str:
        found = self.info.message_type
        kind = found.SCHEMA if found is not None else self.info.schema or self.info.encoding
        return f"<{self.name}: {facts_of(self).messages:,} × {kind}>"

    def _repr_html_(self) -> str:
        return stream_html(facts_of(self))


def _stamp(seconds: float | None, origin: int) -> int | None:
    return None if seconds is None else origin + round(seconds * 1e9)


def facts_of(stream: RecordedStream) -> StreamFacts:
    """Sums up a stream, or a part of one."""
    info = stream.info
    count = len(stream) if stream.partial else info.count
    if count in (0, info.count):
        return StreamFacts(stream.name, info, count, info.first, info.last)
    return StreamFacts(stream.name, info, count, int(stream.stamps.min()), int(stream.stamps.max()))
