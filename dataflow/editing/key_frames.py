"""Finds the key frames from which the video of a recording can be decoded."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np
from mcap.records import Channel

from dataflow.interop.bag import Topic
from dataflow.messages import CompressedVideo, MessageError
from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import Kind
from dataflow.recording.streams.codecs import SchemaText
from dataflow.recording.streams.copying import Origin
from dataflow.video.decoder import is_key

if TYPE_CHECKING:
    from dataflow.interop.topics import TopicReader

FARTHEST = 3_000
"""Packets that are looked at for a key frame, back from a start: 100 s of 30 Hz."""
_SCHEMAS = {
    "foxglove.CompressedVideo",
    "foxglove_msgs/msg/CompressedVideo",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
    "sensor_msgs/msg/CompressedImage",
}
"""Schemas whose messages may be packets of video."""


def key_frames(
    origins: Sequence[Origin], starts: Sequence[int], streams: Collection[str] | None = None
) -> list[dict[str, int]]:
    """Returns for each of `starts` (stamps in ns, increasing), by stream of video, that of its last key frame up to it.

    `origins`: the files of the recording, the earlier first; `streams`: those that count, None: all. A stream that has
    no key frame before a start is left out there.
    """
    found: list[dict[str, int]] = [{} for _ in starts]
    for origin in origins:
        for channel in origin.of_kind(Kind.STREAM).values():
            if streams is None or channel.topic in streams:
                for known, key in zip(found, _keys_before(origin, channel, starts), strict=True):
                    if key is not None:
                        known[channel.topic] = max(key, known.get(channel.topic, key))
    return found


def _keys_before(origin: Origin, channel: Channel, starts: Sequence[int]) -> list[int | None]:
    """The stamps of the last key frame of a channel up to each start; None where it has none, or no video."""
    nothing: list[int | None] = [None for _ in starts]
    schema = origin.file.schemas.get(channel.schema_id)
    if schema is None or schema.name not in _SCHEMAS:
        return nothing
    from dataflow.interop.topics import reader_of  # needs the extra `bags`, which recordings without video do not

    entries = origin.entries(channel.id)
    text = SchemaText(schema.name, schema.encoding, schema.data)
    topic = Topic(
        channel.topic, channel.message_encoding, text, len(entries), None, None, None, False, channel.metadata
    )
    try:
        reader = reader_of(topic)
    except RecordingError:
        return nothing
    order = np.argsort(entries.times, kind="stable")
    ends = np.searchsorted(entries.times[order], np.asarray(starts, np.int64), "right").tolist()
    keys: list[int | None] = []
    looked, last = 0, -1  # packets before `looked` need no second look: their last key frame is `last`, by rank
    for end in ends:
        for rank in range(end - 1, max(looked, end - FARTHEST) - 1, -1):
            time, chunk, offset = (int(column[order[rank]]) for column in entries.columns)
            packet = _packet(reader, bytes(origin.file.read(channel.id, chunk, offset, time).data), time)
            if packet is None:
                return nothing
            if is_key(packet.format, packet.data.tobytes()):
                last = rank
                break
        looked = end
        keys.append(int(entries.times[order[last]]) if last >= max(0, end - FARTHEST) else None)
    return keys


def _packet(reader: TopicReader, data: bytes, time: int) -> CompressedVideo | None:
    try:
        packet = reader.read(data, 0, max(time, 0))
    except (RecordingError, MessageError):
        return None
    return packet if isinstance(packet, CompressedVideo) else None
