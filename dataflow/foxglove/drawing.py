"""Drawings in Foxglove's schemas for message types without one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage as CompressedImageProto
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextAnnotation_pb2 import TextAnnotation
from foxglove_schemas_protobuf.Vector2_pb2 import Vector2
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

import dataflow.messages as messages
from dataflow.messages.detection import labels_of
from dataflow.recording.streams.codecs import SchemaText, codec_for
from dataflow.recording.streams.foxglove import file_descriptor_set
from dataflow.recording.streams.foxglove.values import pose_of, timestamp_of

_WHITE, _GREEN = Color(r=1, g=1, b=1, a=1), Color(r=0.2, g=0.9, b=0.4, a=1)
_FAINT = Color(r=0.2, g=0.9, b=0.4, a=0.3)
_LINE = Color(r=1, g=0.75, b=0.2, a=0.9)
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_FONT = 12.0


@dataclass(frozen=True, slots=True)
class SchemaDrawing:
    """Drawing of messages by one of Foxglove's schemas."""

    proto: type[Any]
    draw: Callable[[Any], Any]


def boxes_over(m: messages.Detections2D) -> ImageAnnotations:
    """Boxes and labels over the image, and the rims of masks where there are any."""
    made = ImageAnnotations(timestamp=timestamp_of(m.stamp))
    for k in range(m.count):
        mask = m.mask(k)
        if mask is not None:
            made.points.append(_rim(made, mask))
    for label, box, score in zip(m.labels(), m.boxes.tolist(), m.scores.tolist(), strict=True):
        _outline(made, box, f"{label} {score:.2f}")
    return made


def limbs_over(m: messages.Keypoints2D) -> ImageAnnotations:
    """Limbs between points that are likelier found than not."""
    made = ImageAnnotations(timestamp=timestamp_of(m.stamp))
    ends = [Point2(x=x, y=y) for x, y in m.limbs().reshape(-1, 2).tolist()]
    made.points.append(
        PointsAnnotation(
            timestamp=made.timestamp, type=PointsAnnotation.LINE_LIST, points=ends, outline_color=_GREEN, thickness=2.0
        )
    )
    return made


def _rim(made: ImageAnnotations, mask: npt.NDArray[np.bool_]) -> PointsAnnotation:
    """Returns the pixels of a mask (H, W) that have a neighbour outside it."""
    around = np.pad(mask, 1)
    inner = around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:]
    rows, columns = np.nonzero(mask & ~inner)
    points = [Point2(x=x + 0.5, y=y + 0.5) for x, y in zip(columns.tolist(), rows.tolist(), strict=True)]
    return PointsAnnotation(
        timestamp=made.timestamp, type=PointsAnnotation.POINTS, points=points, outline_color=_GREEN, thickness=1.0
    )


def tracks_over(m: messages.Tracks) -> ImageAnnotations:
    """Boxes of tracks over the image, with their numbers; one that is not in the image is left out."""
    made = ImageAnnotations(timestamp=timestamp_of(m.stamp))
    boxes = np.empty((0, 4)) if m.boxes is None else m.boxes
    for label, box, number in zip(m.labels(), boxes.tolist(), m.ids.tolist(), strict=False):
        if not np.isnan(box).any():
            _outline(made, box, f"{label} {number}")
    return made


def _outline(made: ImageAnnotations, box: list[float], text: str) -> None:
    x1, y1, x2, y2 = box
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
            timestamp=made.timestamp, position=Point2(x=x1, y=y1), text=text, font_size=_FONT, text_color=_WHITE
        )
    )


def scene(m: messages.Boxes3D) -> SceneUpdate:
    """Cubes with labels; each update replaces the one before."""
    made, entity = _scene(m.stamp, m.frame)
    for i, label in enumerate(m.labels()):
        _cube(entity, m.centers[i], m.orientations[i], m.sizes[i], label)
    return made


def tracks(m: messages.Tracks) -> SceneUpdate:
    """Cubes with class and number, and an arrow's worth of a second's way; without positions, nothing."""
    made, entity = _scene(m.stamp, m.frame)
    positions = np.empty((0, 3)) if m.positions is None else m.positions
    for i, (label, number) in enumerate(zip(m.labels(), m.ids.tolist(), strict=True)):
        if i >= len(positions) or np.isnan(positions[i]).any():
            continue
        size = np.zeros(3) if m.sizes is None or np.isnan(m.sizes[i]).any() else m.sizes[i]
        turn = _UPRIGHT if m.orientations is None else m.orientations[i]
        _cube(entity, positions[i], turn, size, f"{label} {number}")
        if m.velocities is not None and not np.isnan(m.velocities[i]).any():
            _segment(entity, positions[i], positions[i] + m.velocities[i])
    return made


def scene_graph(m: messages.SceneGraph) -> SceneUpdate:
    """Cubes with names, and a line with its predicate for each relation."""
    made, entity = _scene(m.stamp, m.frame)
    for i, label in enumerate(m.labels or labels_of(m.class_ids, m.class_names)):
        turn = _UPRIGHT if m.orientations is None else m.orientations[i]
        _cube(entity, m.positions[i], turn, m.sizes[i], label)
    for subject, predicate, other in zip(m.subjects.tolist(), m.predicates, m.objects.tolist(), strict=True):
        first, second = m.positions[subject], m.positions[other]
        _segment(entity, first, second)
        middle = pose_of(((first + second) / 2).tolist(), _UPRIGHT)
        entity.texts.add(
            pose=middle, billboard=True, font_size=_FONT - 2, scale_invariant=True, color=_LINE, text=predicate
        )
    return made


def surface(m: messages.Mesh) -> SceneUpdate:
    """Triangles."""
    made, entity = _scene(m.stamp, m.frame)
    triangles = entity.triangles.add(
        pose=pose_of((0.0, 0.0, 0.0), _UPRIGHT), color=Color(r=0.7, g=0.7, b=0.72, a=1), indices=m.triangles.ravel()
    )
    triangles.points.extend(Point3(x=x, y=y, z=z) for x, y, z in m.vertices.tolist())
    if m.colors is not None:
        triangles.colors.extend(Color(r=r, g=g, b=b, a=1) for r, g, b in (m.colors / 255.0).tolist())
    return made


def _scene(stamp: int, frame: str) -> tuple[SceneUpdate, SceneEntity]:
    """An update that replaces everything drawn before, and the entity to fill."""
    made = SceneUpdate()
    made.deletions.add(timestamp=timestamp_of(stamp), type=SceneEntityDeletion.ALL)
    return made, made.entities.add(timestamp=timestamp_of(stamp), frame_id=frame, id="all")


def _cube(entity: SceneEntity, position: Any, orientation: Any, size: Any, label: str) -> None:
    pose = pose_of(list(map(float, position)), list(map(float, orientation)))
    x, y, z = map(float, size)
    entity.cubes.add(pose=pose, size=Vector3(x=x, y=y, z=z), color=_FAINT)
    entity.texts.add(pose=pose, billboard=True, font_size=_FONT, scale_invariant=True, color=_WHITE, text=label)


def _segment(entity: SceneEntity, first: Any, second: Any) -> None:
    ends = [Point3(x=float(p[0]), y=float(p[1]), z=float(p[2])) for p in (first, second)]
    entity.lines.add(
        type=LinePrimitive.LINE_STRIP,
        pose=pose_of((0.0, 0.0, 0.0), _UPRIGHT),
        thickness=2.0,
        scale_invariant=True,
        points=ends,
        color=_LINE,
    )


def grid(m: messages.OccupancyGrid) -> Grid:
    """Cells as int8, row 0 at the origin."""
    columns = m.cells.shape[1]
    turn = _UPRIGHT if m.orientation is None else m.orientation.tolist()
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


def compressed_depth(m: messages.CompressedDepth) -> CompressedImageProto:
    """The 16-bit PNG as it is."""
    return CompressedImageProto(timestamp=timestamp_of(m.stamp), frame_id=m.frame, format="png", data=m.data.tobytes())


def relative_depth(m: messages.RelativeDepth) -> RawImage:
    """Nearness as an image of floats."""
    return _image(m.stamp, m.frame, "32FC1", np.ascontiguousarray(m.data, "<f4"))


def mask(m: messages.SegmentationMap) -> RawImage:
    """The classes' own colours; black has no class."""
    from dataflow.view.colors import of_classes  # here, since the viewer's package takes long to import

    names = m.class_names or [str(i) for i in range(int(m.classes.max(initial=0)) + 1)]
    table = np.zeros((int(np.iinfo(m.classes.dtype).max) + 1, 3), np.uint8)
    table[: len(names)] = of_classes(names)
    if m.void is not None and m.void < len(table):
        table[m.void] = 0
    return _image(m.stamp, m.frame, "rgb8", table[m.classes])


def _image(stamp: int, frame: str, encoding: str, pixels: Any) -> RawImage:
    height, width = pixels.shape[:2]
    return RawImage(
        timestamp=timestamp_of(stamp),
        frame_id=frame,
        width=width,
        height=height,
        encoding=encoding,
        step=pixels.strides[0],
        data=pixels.tobytes(),
    )


DRAWN: dict[type[messages.Message], SchemaDrawing] = {
    messages.Detections2D: SchemaDrawing(ImageAnnotations, boxes_over),
    messages.Keypoints2D: SchemaDrawing(ImageAnnotations, limbs_over),
    messages.Boxes3D: SchemaDrawing(SceneUpdate, scene),
    messages.SceneGraph: SchemaDrawing(SceneUpdate, scene_graph),
    messages.Mesh: SchemaDrawing(SceneUpdate, surface),
    messages.OccupancyGrid: SchemaDrawing(Grid, grid),
    messages.CompressedDepth: SchemaDrawing(CompressedImageProto, compressed_depth),
    messages.RelativeDepth: SchemaDrawing(RawImage, relative_depth),
    messages.SegmentationMap: SchemaDrawing(RawImage, mask),
}
_TRACKS_OVER, _TRACKS = SchemaDrawing(ImageAnnotations, tracks_over), SchemaDrawing(SceneUpdate, tracks)


def drawing_of(message: messages.Message) -> SchemaDrawing | None:
    """Returns how a message is drawn; None for a type that is written by its own codec."""
    if isinstance(message, messages.Tracks):
        return _TRACKS if message.positions is not None else _TRACKS_OVER
    return DRAWN.get(type(message))


def schema_of(message: messages.Message) -> tuple[SchemaText, str]:
    """The schema of what `data_of` gives, and its message encoding."""
    drawn = drawing_of(message)
    if drawn is None:
        codec = codec_for(type(message))
        return codec.schema, codec.message_encoding
    return SchemaText(str(drawn.proto.DESCRIPTOR.full_name), "protobuf", file_descriptor_set(drawn.proto)), "protobuf"


def data_of(message: messages.Message) -> bytes:
    """A message for Foxglove. Fields that its schema has no place for are left out."""
    drawn = drawing_of(message)
    if drawn is not None:
        return bytes(drawn.draw(message).SerializeToString())
    parts, _ = codec_for(type(message)).encode(message)
    return b"".join(bytes(part) for part in parts)
