"""Writes ROS 2 bags: a folder with one MCAP file and the metadata of rosbag2."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from ruamel.yaml import YAML
from ruamel.yaml.scalarstring import LiteralScalarString

from dataflow.interop.bag import Topic
from dataflow.interop.export.extras import ROSBAG2, carry
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource, distinct
from dataflow.interop.ros.construction import typestore
from dataflow.interop.ros.to_ros2 import OUTWARD
from dataflow.interop.topics import UNIT
from dataflow.interop.typestores import RosType, ros_type
from dataflow.messages import (
    Boxes3D,
    Detections2D,
    Imu,
    LaserScan,
    Message,
    NavSatFix,
    Number,
    ParticleSet,
    Point,
    Pose,
    RangeReading,
    Transforms,
)
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.codecs import SchemaText

VOLATILE, LATCHED = 2, 1
_QOS = """- history: 1
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""


@dataclass(slots=True)
class _Channel:
    id: int
    type: str
    qos: str
    count: int = 0


class Ros2Writer:
    """Writes topics of CDR messages as a ROS 2 bag; the folder must not exist."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        self.folder = folder
        self.file = folder / f"{folder.name}_0.mcap"
        self._stream = self.file.open("wb")
        self.mcap = Writer(self._stream, compression=CompressionType.ZSTD)
        self.mcap.start(profile="ros2", library="dataflow convert")
        self._schemas: dict[SchemaText, int] = {}
        self._channels: dict[tuple[str, SchemaText], _Channel] = {}
        self._first: int | None = None
        self._last = 0

    def write(
        self, topic: str, schema: SchemaText, data: bytes, stamp: int, *, latched: bool = False, unit: str = ""
    ) -> None:
        """Adds a message; a topic of two types or definitions has two channels. `unit`: of its numbers, for the
        channel's metadata, since ROS has no place for it."""
        topic = topic.removesuffix(f" ({schema.name})")  # as the rarer type of a topic is called here
        channel = self._channels.get((topic, schema))
        if channel is None:
            channel = self._channels[topic, schema] = self._open(topic, schema, latched, unit)
        self.mcap.add_message(channel.id, log_time=stamp, publish_time=stamp, data=data, sequence=channel.count)
        channel.count += 1
        self._first = stamp if self._first is None else min(self._first, stamp)
        self._last = max(self._last, stamp)

    def _open(self, topic: str, schema: SchemaText, latched: bool, unit: str) -> _Channel:
        if schema not in self._schemas:
            self._schemas[schema] = self.mcap.register_schema(schema.name, schema.encoding, schema.data)
        qos = _QOS.format(depth=1 if latched else 10, durability=LATCHED if latched else VOLATILE)
        about = {"offered_qos_profiles": qos} | ({UNIT: unit} if unit else {})
        number = self.mcap.register_channel(topic, "cdr", self._schemas[schema], metadata=about)
        return _Channel(number, schema.name, qos)

    def close(self) -> None:
        """Finishes the file and writes metadata.yaml."""
        self.mcap.finish()  # type: ignore[no-untyped-call]
        self._stream.close()
        yaml = YAML()
        yaml.width = 10_000
        yaml.dump({"rosbag2_bagfile_information": self._metadata()}, self.folder / "metadata.yaml")

    def _metadata(self) -> dict[str, Any]:
        first, total = self._first or 0, sum(channel.count for channel in self._channels.values())
        span = self._last - first if total else 0

        def times() -> dict[str, Any]:
            return {"starting_time": {"nanoseconds_since_epoch": first}, "duration": {"nanoseconds": span}}

        topics = []
        for (topic, _), channel in self._channels.items():
            about = {"name": topic, "type": channel.type, "serialization_format": "cdr"}
            about["offered_qos_profiles"] = LiteralScalarString(channel.qos)
            topics.append({"topic_metadata": about, "message_count": channel.count})
        bag = {"version": 5, "storage_identifier": "mcap", **times(), "message_count": total}
        bag |= {"topics_with_message_count": topics, "compression_format": "", "compression_mode": ""}
        bag |= {"relative_file_paths": [self.file.name]}
        return {**bag, "files": [{"path": self.file.name, **times(), "message_count": total}]}


def export_ros2(source: ExportSource, folder: Path, done: Exported) -> None:
    """Writes a ROS 2 bag. Topics of ROS stay as they are, byte for byte (of ROS 1: field by field).

    Streams of messages become ROS messages. Those that come from a bag have the names of its topics again; of others,
    transforms are /tf and /tf_static, and each one else is a topic of its name. Raises `RecordingError`.
    """
    ros = [t for t in source.bag.topics.values() if t.encoding in ("cdr", "ros1")]
    chosen = {*source.streams, *(t.name for t in source.untouched)}
    ros = [t for t in ros if t.name in chosen]
    others = [name for name in source.streams if name not in {t.name for t in ros}]
    for topic in source.untouched:
        if topic not in ros:
            done.left_out[topic.name] = f"{topic.encoding} messages of {topic.schema.name or 'no schema'}"
    writer = Ros2Writer(folder)
    called = distinct([*(t.name for t in ros), *source.topics.values(), *source.names.values()], _ros_name)
    try:
        _copy(source, ros, called, writer, done)
        _convert(source, others, called, writer, done)
        carry(source, writer.mcap, done, without=(ROSBAG2,))
    finally:
        writer.close()
    done.files.append(str(folder))


def _copy(
    source: ExportSource, topics: list[Topic], called: Mapping[str, str], writer: Ros2Writer, done: Exported
) -> None:
    kinds: dict[str, RosType] = {}
    schemas: dict[str, SchemaText] = {}
    latched = {t.name: t.latched for t in topics}
    for topic in topics:
        if topic.encoding == "cdr" and topic.schema.data:
            schemas[topic.name] = topic.schema
            continue
        try:
            kind = RosType(topic.schema.name, topic.encoding, topic.schema)
            schemas[topic.name] = kind.as_ros2()
        except RecordingError as error:
            done.left_out[topic.name] = str(error)
            continue
        if topic.encoding == "ros1":
            kinds[topic.name] = kind
    shift = source.shift
    for stored in source.stored(list(schemas)):
        kind_of = kinds.get(stored.topic)
        name = called[stored.topic]
        try:
            data = bytes(stored.data) if kind_of is None else kind_of.to_cdr(stored.data)
        except RecordingError as error:
            done.lose(name, f"messages that cannot be read, left out: {error}")
            continue
        log_time = max(stored.log_time - shift, 0)  # as it was: it all is of the recorder's clock
        writer.write(name, schemas[stored.topic], data, log_time, latched=latched[stored.topic])
        done.count(name)


def _convert(
    source: ExportSource, names: list[str], called: Mapping[str, str], writer: Ros2Writer, done: Exported
) -> None:
    store = typestore()
    schemas: dict[str, SchemaText] = {}
    mapped = []
    for name in names:
        kind = source.streams[name].message_type
        assert kind is not None
        if kind in OUTWARD:
            mapped.append(name)
        else:
            done.left_out[source.names[name]] = f"{kind.SCHEMA} has no counterpart in ROS"
    begin = source.first_stamp(mapped) or 0
    for recorded in source.messages(mapped) if mapped else ():
        name = recorded.stream
        static = source.streams[name].static
        topic = _topic_of(source, name, called)
        try:
            message = _made(source.streams[name].metadata.get("type", ""), recorded.message)
        except RecordingError as error:
            done.lose(topic, str(error))
            continue
        kind_of = message.__msgtype__
        if kind_of not in schemas:
            schemas[kind_of] = SchemaText(kind_of, "ros2msg", store.generate_msgdef(kind_of, ros_version=2)[0].encode())
        stamp = begin if static else recorded.stamp
        try:
            data = bytes(store.serialize_cdr(message, kind_of))
        except (struct.error, OverflowError, ValueError) as error:
            raise RecordingError(f"{name} at {recorded.stamp} does not fit into {kind_of}: {error}") from error
        unit = recorded.message.unit if isinstance(recorded.message, Number) else ""
        writer.write(topic, schemas[kind_of], data, stamp - source.shift, latched=static, unit=unit)
        for lost in _lost(recorded.message):
            done.lose(topic, lost)
        done.count(topic)


def _topic_of(source: ExportSource, name: str, called: Mapping[str, str]) -> str:
    if name in source.topics:
        return called[source.topics[name]]
    if source.streams[name].message_type is Transforms:
        return "/tf_static" if source.streams[name].static else "/tf"
    return called[source.names[name]]


def _made(recorded_as: str, message: Message) -> Any:
    """The ROS message; a single transform as one where the topic held such."""
    made = OUTWARD[type(message)](message)
    single = isinstance(message, Transforms) and ros_type(recorded_as) == "geometry_msgs/msg/TransformStamped"
    return made.transforms[0] if single and len(made.transforms) == 1 else made


_NO_PLACE: dict[type[Message], tuple[str, ...]] = {
    Imu: ("temperature",),
    NavSatFix: ("satellites",),
    Point: ("covariance",),
    RangeReading: ("variance",),
    ParticleSet: ("weights",),
    Detections2D: ("visible", "pixel_counts", "masks"),
    Boxes3D: ("velocities", "covariances", "visible", "point_counts"),
}
"""Fields that the ROS type of a message has no place for."""


def _lost(message: Message) -> list[str]:
    """What of a message its ROS type does not hold."""
    found = [name for name in _NO_PLACE.get(type(message), ()) if getattr(message, name, None) is not None]
    if isinstance(message, ParticleSet) and len(set(message.weights.tolist())) <= 1:
        found.remove("weights")
    if isinstance(message, Pose) and message.child_frame:
        found.append("child_frame")
    if isinstance(message, LaserScan) and message.time_offsets is not None and len(message.time_offsets) > 1:
        steps = np.diff(message.time_offsets.astype(np.float64))
        if abs(float(message.time_offsets[0])) > 1e-6 or float(np.ptp(steps)) > 1e-6:
            found.append("time_offsets that are no constant step")
    return found


def _ros_name(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"
