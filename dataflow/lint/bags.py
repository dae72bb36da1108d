"""A bag as material: topics as streams, with the timestamps in their headers as they are, nothing repaired."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.interop.bag import Bag
from dataflow.interop.playing import readings_of
from dataflow.interop.topics import Reading
from dataflow.lint.material import Stamps, StreamFacts
from dataflow.messages import Message, MessageError
from dataflow.recording import RecordingError


class BagMaterial:
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

    def stamps(self, stream: str) -> Stamps:
        """In the order of recording; of a message with several times, such as a set of transforms, the latest."""
        reader = self._readings[stream].reader
        found = []
        for stored in self._bag.messages([stream]):
            carried = reader.stamps(stored.data) if reader is not None else ()
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
