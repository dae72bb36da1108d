"""Rerun's .rrd files: their video streams, as topics of foxglove.CompressedVideo."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from google.protobuf.timestamp_pb2 import Timestamp

from dataflow.interop.bag import BagError, Stored, Topic
from dataflow.recording.streams.codecs import SchemaText
from dataflow.recording.streams.foxglove import file_descriptor_set

SAMPLE, CODEC = "VideoStream:sample", "VideoStream:codec"
_TEXT = SchemaText("foxglove.CompressedVideo", "protobuf", file_descriptor_set(CompressedVideo))
_LOGGED = ("log_time", "log_tick")
"""Timelines that Rerun adds."""


class RerunFile:
    """Reads the video streams of one .rrd file, each an entity; all else in it is for viewing, and is not read.

    Packets are stamped by the timeline that the file was logged with: one of times since the epoch, else one of
    durations, else the time of logging.
    """

    kind = "Rerun file"

    def __init__(self, path: Path) -> None:
        """Raises `BagError`."""
        from rerun.chunk import RrdReader

        self.path = path
        self.promised: Mapping[str, int] = {}
        try:
            reader = RrdReader(path)
            chunks = [
                chunk.to_record_batch()
                for store in reader.recordings()
                for chunk in reader.stream(store=store)
                if any(name in (SAMPLE, CODEC) for name in chunk.to_record_batch().schema.names)
            ]
        except (OSError, ValueError, RuntimeError) as error:
            raise BagError(f"{path} cannot be opened as a Rerun file: {error}") from error
        self._packets: dict[str, list[tuple[int, bytes]]] = {}
        self._formats: dict[str, str] = {}
        notes = []
        for batch in chunks:
            entity = batch.schema.metadata[b"rerun:entity_path"].decode()
            if CODEC in batch.schema.names:
                self._formats.update((entity, _format(code)) for (code,) in _cells(batch, CODEC))
            if SAMPLE in batch.schema.names:
                timeline, times = _times(batch)
                notes.append(f"{entity} is stamped by its timeline {timeline!r}")
                rows = zip(times.tolist(), _cells(batch, SAMPLE), strict=True)
                self._packets.setdefault(entity, []).extend((time, bytes(sample)) for time, (sample,) in rows)
        self.notes = tuple(dict.fromkeys(notes)) or ("it holds no video streams, and nothing else of it is read",)
        for packets in self._packets.values():
            packets.sort(key=lambda packet: packet[0])

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The topics by name, in alphabetical order."""
        return {name: self._topic(name) for name in sorted(self._packets)}

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of their times."""
        rows = [
            (time, name, number, data)
            for name in topics
            for number, (time, data) in enumerate(self._packets.get(name, ()))
        ]
        for time, name, number, data in sorted(rows, key=lambda row: row[:3]):
            stamp = Timestamp(seconds=time // 10**9, nanos=time % 10**9)
            proto = CompressedVideo(timestamp=stamp, frame_id=name.strip("/"), data=data, format=self._formats[name])
            yield Stored(name, number, time, proto.SerializeToString())

    def close(self) -> None:
        """Holds nothing open. Idempotent."""

    def _topic(self, name: str) -> Topic:
        packets = self._packets[name]
        self._formats.setdefault(name, "unknown")
        size = sum(len(data) for _, data in packets)
        return Topic(name, "protobuf", _TEXT, len(packets), packets[0][0], packets[-1][0], size, False, {})


def _format(code: int) -> str:
    """The format of a codec, whose number is its four letters."""
    letters = int(code).to_bytes(4, "big").decode("ascii", "replace")
    return {"avc1": "h264", "hev1": "h265", "av01": "av1"}.get(letters, letters)


def _cells(batch: Any, column: str) -> list[list[Any]]:
    """The cells of a column that hold something."""
    return [cell for cell in batch.column(column).to_pylist() if cell]


def _times(batch: Any) -> tuple[str, npt.NDArray[np.int64]]:
    """The timeline that counts, and the times (ns) of the rows that hold a packet."""
    kinds = {name: str(batch.schema.field(name).type) for name in batch.schema.names if ":" not in name}
    for begins, logged in (("timestamp", False), ("duration", False), ("timestamp", True)):
        for name, kind in sorted(kinds.items()):
            if kind.startswith(begins) and (name in _LOGGED) == logged:
                held = batch.column(SAMPLE).is_valid().to_numpy(zero_copy_only=False)
                return name, batch.column(name).cast("int64").to_numpy(zero_copy_only=False)[held]
    raise BagError("its video has no timeline of times: log it with rr.set_time(..., timestamp=...)")
