"""Topics of a bag that no graph plays, kept in the recording of its replay as they are."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from dataflow.editing.part import copy_messages
from dataflow.interop.opening import open_bag
from dataflow.recording.streams.copying import Copy, Origin


def keep_untouched(
    recording: Path,
    bag: Path,
    played: Collection[str],
    start: int | None = None,
    end: int | None = None,
    *,
    shift: int = 0,
) -> dict[str, int]:
    """Adds to a recording every topic of a bag but those in `played`, byte for byte; how many messages of each.

    `shift`: what is added to log times (ns), so that they are of the clock of what was played. `start`, `end`: of the
    span, on that clock. A topic whose name a stream has is left out.
    """
    opened = open_bag(bag)
    try:
        with Origin(recording) as origin:
            taken = {channel.topic for channel in origin.channels.values()}
            topics = [t for name, t in opened.topics.items() if name not in played and name not in taken and t.count]
            if not topics:
                return {}
            with Copy(recording, origin, overwrite=True) as copy:
                for name, values in origin.metadata.items():
                    copy.writer.add_metadata(name, values)
                copy_messages(copy, origin, {c: np.ones(len(origin.entries(c)), bool) for c in origin.channels})
                channels = {}
                for topic in topics:
                    text = topic.schema
                    schema = copy.writer.add_schema(text.name, text.encoding, text.data) if text.name else 0
                    about = {key: value for key, value in topic.channel.items() if key != "kind"}
                    channels[topic.name] = copy.writer.add_channel(topic.name, topic.encoding, schema, about)
                written = dict.fromkeys(channels, 0)
                for stored in opened.messages(list(channels)):
                    time, number = max(stored.log_time + shift, 0), written[stored.topic]
                    if (start is None or time >= start) and (end is None or time <= end):
                        copy.writer.add_copied(channels[stored.topic], time, time, number, bytes(stored.data))
                        written[stored.topic] += 1
                return written
    finally:
        opened.close()
