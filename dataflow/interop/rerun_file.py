"""Rerun's .rrd files: their video streams, as topics of foxglove.CompressedVideo."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from google.protobuf.timestamp_pb2 import Timestamp

from dataflow.interop.bag import BagError, DamageReport, Stored, Topic
from dataflow.recording.streams.codecs import SchemaText
from dataflow.recording.streams.foxglove import file_descriptor_set

SAMPLE, CODEC = "VideoStream:sample", "VideoStream:codec"
_TEXT = SchemaText("foxglove.CompressedVideo", "protobuf", file_descriptor_set(CompressedVideo))
_LOGGED = ("log_time", "log_tick")
"""Timelines that Rerun adds."""


class RerunFile:
    """Reads the video streams of one .rrd file, each an entity; all else in it is for viewing, and is not read.

    Packets are stamped by the timeline that the file was logged with: one of times since the epoch, else one of
    durations, else the time of logging; numbers (sequences) are no times. They are held in memory once, as the file has
    them. Of several recordings in the file, the first with video is read.
    """

    kind = "Rerun file"

    def __init__(self, path: Path) -> None:
        """Raises `BagError`."""
        self.path = path
        self.promised: Mapping[str, int] = {}
        self.lost = DamageReport()
        self._formats: dict[str, str] = {}
        self._packets: dict[str, list[tuple[int, Any, int]]] = {}
        """(time (ns), column of samples, row) by entity."""
        batches, notes = _video(path)
        for entity, those in batches.items():
            self._formats[entity] = next((_format(c) for b in those for c in _codes(b)), "unknown")
            sampled = [batch for batch in those if SAMPLE in batch.schema.names]
            if sampled:
                timeline = _timeline(path, entity, sampled)
                logged = ", the time of logging: it has no other timeline of times" * (timeline in _LOGGED)
                notes.append(f"{entity} is stamped by its timeline {timeline!r}{logged}")
                rows = (row for batch in sampled for row in _rows(batch, timeline))
                self._packets[entity] = sorted(rows, key=lambda row: row[0])
        self.notes = tuple(notes) or ("it holds no video streams, and nothing else of it is read",)

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The topics by name, in alphabetical order."""
        return {name: self._topic(name) for name in sorted(self._packets) if self._packets[name]}

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of their times."""
        rows = (
            (time, name, number, samples, row)
            for name in topics
            for number, (time, samples, row) in enumerate(self._packets.get(name, ()))
        )
        for time, name, number, samples, row in sorted(rows, key=lambda row: row[:3]):
            stamp, data = Timestamp(seconds=time // 10**9, nanos=time % 10**9), samples[row].values[0].values
            proto = CompressedVideo(
                timestamp=stamp, frame_id=name.strip("/"), data=data.to_numpy().tobytes(), format=self._formats[name]
            )
            yield Stored(name, number, time, proto.SerializeToString())

    def close(self) -> None:
        """Holds nothing open. Idempotent."""

    def _topic(self, name: str) -> Topic:
        packets = self._packets[name]
        size = sum(len(samples[row].values[0].values) for _, samples, row in packets)
        return Topic(name, "protobuf", _TEXT, len(packets), packets[0][0], packets[-1][0], size, False, {})


def _video(path: Path) -> tuple[dict[str, list[Any]], list[str]]:
    """Returns the record batches of video by entity, and notes on recordings that are not read. Raises `BagError`."""
    from rerun.chunk import RrdReader

    found: dict[str, list[Any]] = {}
    notes, chosen = [], ""
    try:
        reader = RrdReader(path)
        for store in reader.recordings():
            for chunk in reader.stream(store=store):
                batch = chunk.to_record_batch()
                if SAMPLE in batch.schema.names or CODEC in batch.schema.names:
                    chosen = chosen or store.recording_id
                    if chosen != store.recording_id:
                        notes.append(f"its recording {store.recording_id!r} is not read: the first one is, {chosen!r}")
                        break
                    found.setdefault(batch.schema.metadata[b"rerun:entity_path"].decode(), []).append(batch)
    except (OSError, ValueError, RuntimeError) as error:
        raise BagError(f"{path} cannot be opened as a Rerun file: {error}") from error
    return found, notes


def _format(code: int) -> str:
    """The format of a codec, whose number is its four letters."""
    letters = int(code).to_bytes(4, "big").decode("ascii", "replace")
    return {"avc1": "h264", "hev1": "h265", "av01": "av1"}.get(letters, letters)


def _codes(batch: Any) -> list[int]:
    cells = batch.column(CODEC).to_pylist() if CODEC in batch.schema.names else []
    return [cell[0] for cell in cells if cell]


def _timeline(path: Path, entity: str, batches: list[Any]) -> str:
    """The timeline that counts, of those that all batches have. Raises `BagError`."""
    kinds = [{name: str(batch.schema.field(name).type) for name in batch.schema.names} for batch in batches]
    common: list[str] = sorted(name for name in kinds[0] if ":" not in name and all(name in others for others in kinds))
    for begins, logged in (("timestamp", False), ("duration", False), ("timestamp", True)):
        for name in common:
            if kinds[0][name].startswith(begins) and (name in _LOGGED) == logged:
                return name
    raise BagError(
        f"{path}: {entity} has no timeline of times that all of it is on: log it with rr.set_time(..., timestamp=...)"
    )


def _rows(batch: Any, timeline: str) -> Iterator[tuple[int, Any, int]]:
    """Yields time (ns), column and row of each packet."""
    samples = batch.column(SAMPLE)
    lengths = samples.value_lengths().fill_null(0).to_numpy(zero_copy_only=False)
    times = batch.column(timeline).cast("int64").to_numpy(zero_copy_only=False)
    return ((int(times[row]), samples, row) for row in np.flatnonzero(lengths).tolist())
