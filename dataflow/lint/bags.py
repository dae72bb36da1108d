"""A bag that is looked at: topics as streams, with the timestamps in their headers as they are, nothing repaired."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.interop.bag import Bag, is_static, shortfalls
from dataflow.interop.playing import readings_of
from dataflow.interop.topics import Reading, is_known
from dataflow.interop.transform_sets import places_of
from dataflow.lint.inputs import Finding, Stamps, StreamFacts
from dataflow.messages import Message, MessageError, Transforms
from dataflow.recording import RecordingError


class BagInput:
    """An open bag. A message whose header has no time counts with the time at which it was recorded."""

    namespace = ""

    def __init__(self, bag: Bag) -> None:
        self._bag = bag
        self._readings: dict[str, Reading] = {reading.topic.name: reading for reading in readings_of(bag)}
        self.streams: Mapping[str, StreamFacts] = {
            name: StreamFacts(
                reading.topic.schema.name if reading.read_as is None else reading.read_as.SCHEMA,
                reading.topic.latched,
                reading.topic.count,
                reading.playable,
            )
            for name, reading in self._readings.items()
        }

    def file_findings(self, *, whole: bool) -> Iterator[Finding]:
        """Notes of the file, messages that are missing or cannot be read, and what has no place here."""
        for note in self._bag.notes:
            yield Finding("file", "", "warning", note)
        for name, reading in self._readings.items():
            if reading.topic.count and reading.reader is None and is_known(reading.topic):
                yield Finding("unreadable", name, "warning", reading.reason)
            if reading.losses:
                yield Finding("no place", name, "note", ", ".join(reading.losses))
            if not reading.topic.count:
                yield Finding("empty", name, "note", "it is declared, and holds no message")
        if whole:
            yield from self._read_all()
        for text in shortfalls(self._bag):
            yield Finding("missing", "", "error", text)

    def _read_all(self) -> Iterator[Finding]:
        """Reads every message once."""
        readable = {name: r for name, r in self._readings.items() if r.reader is not None and r.topic.count}
        places: dict[tuple[str, str], bytes] = {}
        changed: dict[tuple[str, str], tuple[int, int]] = {}
        unread: dict[str, tuple[int, int, str]] = {}
        unset: dict[str, int] = {}
        for stored in self._bag.messages(list(readable)) if readable else ():
            reading = readable[stored.topic]
            assert reading.reader is not None
            try:
                stamps = reading.reader.stamps(stored.data)
                parts = range(max(1, len(stamps)))
                read = [reading.reader.read(stored.data, part, max(stored.log_time, 0)) for part in parts]
            except (MessageError, RecordingError) as error:
                number, first, reason = unread.get(stored.topic, (0, stored.log_time, str(error)))
                unread[stored.topic] = number + 1, first, reason
                continue
            if stamps and max(stamps) <= 0 and not reading.topic.latched:
                unset[stored.topic] = unset.get(stored.topic, 0) + 1
            for message in read if is_static(stored.topic) else ():
                for child, place in places_of(message) if isinstance(message, Transforms) else ():
                    key = (stored.topic, child)
                    if places.setdefault(key, place) != place:
                        changed[key] = changed.get(key, (0, stored.log_time))[0] + 1, stored.log_time
                        places[key] = place
        for topic, (number, first, reason) in unread.items():
            text = f"{number:,} messages cannot be read, the first: {reason}"
            yield Finding("unreadable", topic, "error", text, first, {"messages": number})
        for topic, number in unset.items():
            text = (
                f"{number:,} of {self._readings[topic].topic.count:,} headers carry no time: when those were recorded "
                "is taken for when they were measured"
            )
            yield Finding("unstamped", topic, "warning", text, None, {"messages": number})
        for (topic, child), (number, at) in changed.items():
            text = f"the place of {child} changes {number:,} times, and static transforms hold from the beginning"
            yield Finding("static", topic, "warning", text, at)

    def stamps(self, stream: str) -> Stamps:
        """In the order of recording; of a message with several times, such as a set of transforms, the latest."""
        reader = self._readings[stream].reader
        found = []
        for stored in self._bag.messages([stream]):
            try:
                carried = reader.stamps(stored.data) if reader is not None else ()
            except (MessageError, RecordingError):
                continue  # counted in `file_findings`
            found.append(max(carried, default=0) or stored.log_time)
        return np.array(found, np.int64)

    def messages(self, stream: str) -> Iterator[Message]:
        """Those that can be read; of a message with several times, each part."""
        reader = self._readings[stream].reader
        assert reader is not None
        for stored in self._bag.messages([stream]):
            try:
                times = [time or stored.log_time for time in reader.stamps(stored.data)] or [stored.log_time]
                parts = [reader.read(stored.data, part, max(time, 0)) for part, time in enumerate(times)]
            except (MessageError, RecordingError):
                continue
            yield from parts
