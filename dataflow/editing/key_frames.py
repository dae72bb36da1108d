"""Finds the key frames from which the video of a recording can be decoded."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from mcap.records import Channel

from dataflow.interop.bag import Topic
from dataflow.interop.topics import TopicReader, reader_of
from dataflow.messages import CompressedVideo, MessageError
from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import Kind
from dataflow.recording.streams.codecs import SchemaText
from dataflow.recording.streams.copying import Origin
from dataflow.video.decoder import is_key

FARTHEST = 3_000
"""Packets that are looked at for a key frame, back from a start: 100 s of 30 Hz."""
_SCHEMAS = {
    "foxglove.CompressedVideo",
    "foxglove_msgs/msg/CompressedVideo",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
    "sensor_msgs/msg/CompressedImage",
}
"""Schemas whose messages may be packets of video."""


def with_key_frames(origins: Sequence[Origin], start: int, streams: Collection[str] | None = None) -> int:
    """Returns the latest stamp (ns) up to `start` from which the video of a recording can be decoded by `start`.

    `origins`: the files of the recording, the earlier first; `streams`: those that count, None: all. Where a stream has
    packets and no key frame before, it does not count.
    """
    found: dict[str, int] = {}
    for origin in reversed(origins):
        for channel in origin.of_kind(Kind.STREAM).values():
            if channel.topic in found or (streams is not None and channel.topic not in streams):
                continue
            key = _key_before(origin, channel, start)
            if key is not None:
                found[channel.topic] = key
    return min([start, *found.values()])


def _key_before(origin: Origin, channel: Channel, start: int) -> int | None:
    """The stamp of the last key frame of a channel up to `start`; None where it has none, or no video."""
    schema = origin.file.schemas.get(channel.schema_id)
    if schema is None or schema.name not in _SCHEMAS:
        return None
    entries = origin.entries(channel.id)
    text = SchemaText(schema.name, schema.encoding, schema.data)
    topic = Topic(
        channel.topic, channel.message_encoding, text, len(entries), None, None, None, False, channel.metadata
    )
    try:
        reader = reader_of(topic)
    except RecordingError:
        return None
    before = np.flatnonzero(entries.times <= start)
    for place in before[np.argsort(entries.times[before], kind="stable")][::-1][:FARTHEST].tolist():
        time, chunk, offset = (int(column[place]) for column in entries.columns)
        packet = _packet(reader, bytes(origin.file.read(channel.id, chunk, offset, time).data), time)
        if packet is None:
            return None
        if is_key(packet.format, packet.data.tobytes()):
            return time
    return None


def _packet(reader: TopicReader, data: bytes, time: int) -> CompressedVideo | None:
    try:
        packet = reader.read(data, 0, max(time, 0))
    except (RecordingError, MessageError):
        return None
    return packet if isinstance(packet, CompressedVideo) else None
