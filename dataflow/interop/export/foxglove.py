"""Foxglove MCAP: every stream that a Foxglove schema fits as protobuf, others as JSON with their schema."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage as CompressedImageProto
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextAnnotation_pb2 import TextAnnotation
from foxglove_schemas_protobuf.Vector2_pb2 import Vector2
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from mcap.writer import CompressionType, Writer

from dataflow.interop.export.material import Material
from dataflow.interop.export.report import Exported
from dataflow.messages import Boxes3D, CompressedDepth, Detections2D, Message, OccupancyGrid
from dataflow.recording.codecs import SchemaText, codec_for
from dataflow.recording.foxglove import file_descriptor_set
from dataflow.recording.foxglove.values import pose_of, timestamp_of

_WHITE, _GREEN = Color(r=1, g=1, b=1, a=1), Color(r=0.2, g=0.9, b=0.4, a=1)
_FAINT = Color(r=0.2, g=0.9, b=0.4, a=0.3)
_ENTITY = "boxes"


@dataclass(frozen=True, slots=True)
class Drawn:
    """Drawing of a message type that has no schema of its own, by one of Foxglove's."""

    proto: type[Any]
    draw: Callable[[Any], Any]


def boxes_over(m: Detections2D) -> ImageAnnotations:
    """Boxes and labels over the image."""
    made = ImageAnnotations(timestamp=timestamp_of(m.stamp))
    for label, (x1, y1, x2, y2), score in zip(m.labels(), m.boxes.tolist(), m.scores.tolist(), strict=True):
        corners = [Point2(x=x, y=y) for x, y in ((x1, y1), (x2, y1), (x2, y2), (x1, y2))]
        made.points.append(
            PointsAnnotation(
                timestamp=made.timestamp,
                type=PointsAnnotation.LINE_LOOP,
                points=corners,
                outline_color=_GREEN,
                thickness=2.0,
            )
        )
        made.texts.append(
            TextAnnotation(
                timestamp=made.timestamp,
                position=Point2(x=x1, y=y1),
                text=f"{label} {score:.2f}",
                font_size=12.0,
                text_color=_WHITE,
            )
        )
    return made


def scene(m: Boxes3D) -> SceneUpdate:
    """Cubes with labels; each update replaces the one before."""
    made = SceneUpdate()
    entity = made.entities.add(timestamp=timestamp_of(m.stamp), frame_id=m.frame, id=_ENTITY)
    for i, label in enumerate(m.labels()):
        pose = pose_of(m.centers[i].tolist(), m.orientations[i].tolist())
        x, y, z = m.sizes[i].tolist()
        entity.cubes.add(pose=pose, size=Vector3(x=x, y=y, z=z), color=_FAINT)
        entity.texts.add(pose=pose, billboard=True, font_size=12.0, scale_invariant=True, color=_WHITE, text=label)
    return made


def grid(m: OccupancyGrid) -> Grid:
    """Cells as int8, row 0 at the origin."""
    columns = m.cells.shape[1]
    turn = (0.0, 0.0, 0.0, 1.0) if m.orientation is None else m.orientation.tolist()
    return Grid(
        timestamp=timestamp_of(m.stamp),
        frame_id=m.frame,
        pose=pose_of(m.position.tolist(), turn),
        column_count=columns,
        cell_size=Vector2(x=m.resolution, y=m.resolution),
        row_stride=columns,
        cell_stride=1,
        fields=[PackedElementField(name="occupancy", offset=0, type=PackedElementField.INT8)],
        data=m.cells.tobytes(),
    )


def compressed_depth(m: CompressedDepth) -> CompressedImageProto:
    """The 16-bit PNG as it is."""
    return CompressedImageProto(timestamp=timestamp_of(m.stamp), frame_id=m.frame, format="png", data=m.data.tobytes())


DRAWN: dict[type[Message], Drawn] = {
    Detections2D: Drawn(ImageAnnotations, boxes_over),
    Boxes3D: Drawn(SceneUpdate, scene),
    OccupancyGrid: Drawn(Grid, grid),
    CompressedDepth: Drawn(CompressedImageProto, compressed_depth),
}


def export_foxglove(material: Material, file: Path, done: Exported) -> None:
    """Writes an MCAP for Foxglove: topics named `/node/port`, log time and the messages' own time the stamp.

    Fields that a Foxglove schema has no place for are left out (our own recordings keep them in companions).
    """
    with file.open("wb") as opened:
        writer = Writer(opened, compression=CompressionType.ZSTD)
        writer.start(profile="", library="dataflow convert")
        channels: dict[str, int] = {}
        for name, info in material.streams.items():
            assert info.message_type is not None
            channels[name] = _open(writer, f"/{material.names[name].lstrip('/')}", info.message_type)
        kept: dict[str, int] = {}
        for topic in material.untouched:
            schema = writer.register_schema(topic.schema.name, topic.schema.encoding, topic.schema.data)
            kept[topic.name] = writer.register_channel(topic.name, topic.encoding, schema if topic.schema.name else 0)
        for recorded in material.messages():
            stamp = max(recorded.stamp, 0)
            writer.add_message(channels[recorded.stream], stamp, _data(recorded.message), stamp, recorded.seq % 2**32)
            done.count(material.names[recorded.stream])
        for stored in material.stored(list(kept)):
            writer.add_message(
                kept[stored.topic], stored.log_time, bytes(stored.data), stored.log_time, stored.number % 2**32
            )
            done.count(stored.topic)
        writer.finish()  # type: ignore[no-untyped-call]
    done.files.append(str(file))


def _open(writer: Writer, topic: str, kind: type[Message]) -> int:
    drawn = DRAWN.get(kind)
    if drawn is None:
        codec = codec_for(kind)
        schema, encoding = codec.schema(), codec.message_encoding
    else:
        name = str(drawn.proto.DESCRIPTOR.full_name)
        schema, encoding = SchemaText(name, "protobuf", file_descriptor_set(drawn.proto)), "protobuf"
    number = writer.register_schema(schema.name, schema.encoding, schema.data)
    return writer.register_channel(topic, encoding, number)


def _data(message: Message) -> bytes:
    drawn = DRAWN.get(type(message))
    if drawn is not None:
        return bytes(drawn.draw(message).SerializeToString())
    parts, _ = codec_for(type(message)).encode(message)
    return b"".join(bytes(part) for part in parts)
