"""Draws messages into a file, and reads what a sink saved: rows of (entity, component, stamp or None, values)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import rerun as rr
from rerun.chunk import RrdReader

from dataflow.messages import Message
from dataflow.view import SceneState, ViewOptions, visualize
from dataflow.view.layout import layout


class Row(NamedTuple):
    entity: str
    component: str
    stamp: int | None
    values: list[Any]


def rows(path: Path) -> list[Row]:
    """Every component value in the file, the blueprint's aside."""
    reader = RrdReader(path)
    (recording,) = reader.recordings()
    return [row for chunk in reader.stream(store=recording) for row in _rows(chunk)]


def blueprint_rows(path: Path) -> list[Row]:
    """Every component value of the blueprints in the file."""
    reader = RrdReader(path)
    return [row for store in reader.blueprints() for chunk in reader.stream(store=store) for row in _rows(chunk)]


def draw(
    tmp_path: Path,
    *drawn: tuple[str, Message],
    static: tuple[str, ...] = (),
    options: ViewOptions | None = None,
    scene: SceneState | None = None,
) -> list[Row]:
    """What a viewer gets when these messages of these streams are drawn in order."""
    types = {stream: type(message) for stream, message in drawn}
    scene = scene or SceneState(layout(types, static=static), options or ViewOptions())
    path = tmp_path / "drawn.rrd"
    with rr.RecordingStream("test", recording_id="test") as recording:
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        recording.save(path)
        for stream, message in drawn:
            visualize(recording, f"/{stream}", message, scene, stream)
    return rows(path)


def at(found: list[Row], entity: str, component: str) -> list[Row]:
    """The rows of one component of one entity, the static ones first, then by stamp.

    Chunks of an entity that were flushed together lie in a file in any order.
    """
    those = (row for row in found if row.entity == entity and row.component == component)
    return sorted(those, key=lambda row: (row.stamp is not None, row.stamp or 0))


def _rows(chunk: Any) -> Iterator[Row]:
    batch = chunk.to_record_batch()
    stamps: list[Any] = [None] * batch.num_rows
    if "stamp" in batch.schema.names:
        stamps = batch.column("stamp").cast("int64").to_pylist()
    for name in batch.schema.names:
        if ":" not in name:
            continue
        for stamp, values in zip(stamps, batch.column(name).to_pylist(), strict=True):
            if values is not None:
                yield Row(chunk.entity_path, name, stamp, values)
