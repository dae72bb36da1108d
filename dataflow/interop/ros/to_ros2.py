"""Messages as ROS 2 messages, the other way round."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import dataflow.messages as messages
from dataflow.interop.ros.construction import (
    as_bytes,
    header_of,
    make,
    matrix,
    moving,
    placed_at,
    point,
    quaternion,
    stamped,
    time,
    vector,
    with_covariance,
)
from dataflow.messages.poses import COVARIANCE_TYPES
from dataflow.recording.errors import RecordingError

OUTWARD: dict[type[messages.Message], Callable[[Any], Any]] = {}
"""By message type: the function that makes a ROS message of it."""

_FIX = {"no_fix": -1, "fix": 0, "sbas": 1, "gbas": 2, "rtk_float": 2, "rtk_fixed": 2}
_ABSENT = np.array([-1.0, 0, 0, 0, 0, 0, 0, 0, 0])
_FLOAT32, _FLOAT64, _UINT16, _UINT32 = 7, 8, 4, 6
_LOG = {"debug": 10, "info": 20, "warning": 30, "error": 40, "fatal": 50}
_NOT_OF_CODE = {"file": "", "function": "", "line": 0}


def outward(*kinds: type[messages.Message]) -> Callable[[Callable[[Any], Any]], Callable[[Any], Any]]:
    """Enters a function for these message types."""

    def entered(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
        OUTWARD.update(dict.fromkeys(kinds, function))
        return function

    return entered


@outward(messages.Image, messages.Image16, messages.DepthImage)
def image(m: messages.Image | messages.Image16 | messages.DepthImage) -> Any:
    color, bits = m.data.ndim == 3, 8 * m.data.itemsize
    encoding = "32FC1" if isinstance(m, messages.DepthImage) else f"{'rgb' if color else 'mono'}{bits}"
    height, width = m.data.shape[:2]
    return stamped(
        "sensor_msgs/Image",
        m,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=m.data.nbytes // height,
        data=as_bytes(m.data),
    )


@outward(messages.CompressedImage, messages.CompressedDepth)
def compressed(m: messages.CompressedImage | messages.CompressedDepth) -> Any:
    if isinstance(m, messages.CompressedImage):
        format_, data = m.format, m.data
    else:
        inverse = m.quantizer == "inverse"
        if not inverse and (m.scale, m.offset) != (0.001, 0.0):
            raise RecordingError(
                f"a compressed depth image of {m.scale} m a unit has no counterpart; ROS counts millimetres"
            )
        format_ = "32FC1; compressedDepth png" if inverse else "16UC1; compressedDepth png"
        head = struct.pack("<iff", 0, m.scale if inverse else 0.0, m.offset if inverse else 0.0)
        data = np.concatenate([np.frombuffer(head, np.uint8), m.data])
    return stamped("sensor_msgs/CompressedImage", m, format=format_, data=as_bytes(data))


@outward(messages.CameraInfo)
def camera_info(m: messages.CameraInfo) -> Any:
    nothing = make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return stamped(
        "sensor_msgs/CameraInfo",
        m,
        height=m.height,
        width=m.width,
        distortion_model="" if m.distortion_model == "none" else m.distortion_model,
        d=np.zeros(0) if m.distortion is None else np.array(m.distortion),
        k=m.K.ravel(),
        r=matrix(m.R, 3),
        p=np.zeros(12) if m.P is None else m.P.ravel(),
        binning_x=0,
        binning_y=0,
        roi=nothing,
    )


@outward(messages.PointCloud)
def point_cloud(m: messages.PointCloud) -> Any:
    dtype, kind = ("<f4", _FLOAT32) if m.precise is None else ("<f8", _FLOAT64)
    points = m.points if m.precise is None else m.precise
    columns: list[tuple[str, str, int, Any]] = [(n, dtype, kind, points[:, i]) for i, n in enumerate("xyz")]
    if m.intensities is not None:
        columns.append(("intensity", "<f4", _FLOAT32, m.intensities))
    if m.colors is not None:
        red, green, blue = m.colors.T.astype(np.uint32)
        columns.append(("rgb", "<u4", _UINT32, red << 16 | green << 8 | blue))
    if m.rings is not None:
        columns.append(("ring", "<u2", _UINT16, m.rings))
    if m.time_offsets is not None:
        columns.append(("time", "<f4", _FLOAT32, m.time_offsets))
    if m.normals is not None:
        columns += [(f"normal_{n}", "<f4", _FLOAT32, m.normals[:, i]) for i, n in enumerate("xyz")]
    rows = np.zeros(len(m.points), [(name, dtype) for name, dtype, _, _ in columns])
    fields = []
    for name, _, kind, values in columns:
        rows[name] = values
        assert rows.dtype.fields is not None
        offset = rows.dtype.fields[name][1]
        fields.append(make("sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=1))
    return stamped(
        "sensor_msgs/PointCloud2",
        m,
        height=1 if m.columns is None else len(rows) // m.columns,
        width=len(rows) if m.columns is None else m.columns,
        fields=fields,
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.itemsize * (m.columns or len(rows)),
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=bool(np.isfinite(m.points).all()),
    )


@outward(messages.LaserScan)
def laser_scan(m: messages.LaserScan) -> Any:
    offsets = m.time_offsets
    step = 0.0 if offsets is None or len(offsets) < 2 else float(offsets[-1] - offsets[0]) / (len(offsets) - 1)
    return stamped(
        "sensor_msgs/LaserScan",
        m,
        angle_min=m.angle_min,
        angle_max=m.angle_max,
        angle_increment=m.angle_increment,
        time_increment=step,
        scan_time=0.0,
        range_min=m.range_min,
        range_max=m.range_max,
        ranges=np.array(m.ranges),
        intensities=np.zeros(0, np.float32) if m.intensities is None else np.array(m.intensities),
    )


MEASURED = {
    "°C": ("Temperature", "temperature"),
    "Pa": ("FluidPressure", "fluid_pressure"),
    "lx": ("Illuminance", "illuminance"),
    "": ("RelativeHumidity", "relative_humidity"),
}
"""Type and field of sensor_msgs by unit."""


@outward(messages.Measurement)
def measurement(m: messages.Measurement) -> Any:
    if m.unit not in MEASURED:
        raise RecordingError(f"a Measurement in {m.unit!r} has no counterpart in ROS; known are {', '.join(MEASURED)}")
    kind, field = MEASURED[m.unit]
    values = {field: m.value, "variance": m.variance or 0.0}
    return stamped(f"sensor_msgs/{kind}", m, **values)


@outward(messages.NavSatFix)
def nav_sat_fix(m: messages.NavSatFix) -> Any:
    return stamped(
        "sensor_msgs/NavSatFix",
        m,
        status=make("sensor_msgs/NavSatStatus", status=_FIX[m.status], service=0),
        latitude=m.latitude,
        longitude=m.longitude,
        altitude=m.altitude,
        position_covariance=matrix(m.covariance, 3),
        position_covariance_type=COVARIANCE_TYPES.index(m.covariance_type),
    )


@outward(messages.JointState)
def joint_state(m: messages.JointState) -> Any:
    position, velocity, effort = (
        np.zeros(0) if v is None else np.array(v) for v in (m.positions, m.velocities, m.efforts)
    )
    header, names = header_of(m.stamp, ""), list(m.names)
    return make(
        "sensor_msgs/JointState", header=header, name=names, position=position, velocity=velocity, effort=effort
    )


@outward(messages.Path)
def path(m: messages.Path) -> Any:
    turns = [None] * m.count if m.orientations is None else m.orientations
    stamps: Sequence[int] = [0] * m.count if m.stamps is None else m.stamps.tolist()
    poses = [
        make("geometry_msgs/PoseStamped", header=header_of(stamp, m.frame), pose=placed_at(position, turn))
        for stamp, position, turn in zip(stamps, m.positions, turns, strict=True)
    ]
    return stamped("nav_msgs/Path", m, poses=poses)


@outward(messages.OccupancyGrid)
def occupancy_grid(m: messages.OccupancyGrid) -> Any:
    height, width = m.cells.shape
    info = make(
        "nav_msgs/MapMetaData",
        map_load_time=time(m.stamp),
        resolution=m.resolution,
        width=width,
        height=height,
        origin=placed_at(m.position, m.orientation),
    )
    return stamped("nav_msgs/OccupancyGrid", m, info=info, data=np.array(m.cells).ravel())


@outward(messages.ParticleSet)
def particles(m: messages.ParticleSet) -> Any:
    if m.poses.shape[1] == 3:
        half = 0.5 * m.poses[:, 2]
        rows = [
            placed_at((x, y, 0.0), (0.0, 0.0, s, c))
            for (x, y, _), s, c in zip(m.poses, np.sin(half), np.cos(half), strict=True)
        ]
    else:
        rows = [placed_at(row[:3], row[3:]) for row in m.poses]
    return stamped("geometry_msgs/PoseArray", m, poses=rows)


@outward(messages.Transforms)
def transforms(m: messages.Transforms) -> Any:
    rows = []
    for i, child in enumerate(m.child_frames):
        placed = make(
            "geometry_msgs/Transform", translation=vector(m.translations[i]), rotation=quaternion(m.rotations[i])
        )
        header = header_of(m.stamp, m.frames[i])
        rows.append(make("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=placed))
    return make("tf2_msgs/TFMessage", transforms=rows)


def _hypotheses(label: str, score: float) -> list[Any]:
    hypothesis = make("vision_msgs/ObjectHypothesis", class_id=label, score=float(score))
    nowhere = with_covariance(np.zeros(3), None, None)
    return [make("vision_msgs/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=nowhere)]


@outward(messages.Detections2D)
def detections(m: messages.Detections2D) -> Any:
    header = header_of(m.stamp, m.frame)
    rows = []
    for i, (label, (x1, y1, x2, y2)) in enumerate(zip(m.labels(), m.boxes.tolist(), strict=True)):
        middle = make("vision_msgs/Point2D", x=(x1 + x2) / 2, y=(y1 + y2) / 2)
        center = make("vision_msgs/Pose2D", position=middle, theta=0.0)
        box = make("vision_msgs/BoundingBox2D", center=center, size_x=x2 - x1, size_y=y2 - y1)
        identity = "" if m.ids is None else str(m.ids[i])
        results = _hypotheses(label, m.scores[i])
        rows.append(make("vision_msgs/Detection2D", header=header, results=results, bbox=box, id=identity))
    return make("vision_msgs/Detection2DArray", header=header, detections=rows)


@outward(messages.Boxes3D)
def boxes(m: messages.Boxes3D) -> Any:
    header = header_of(m.stamp, m.frame)
    rows = []
    for i, label in enumerate(m.labels()):
        center = placed_at(m.centers[i], m.orientations[i])
        box = make("vision_msgs/BoundingBox3D", center=center, size=vector(m.sizes[i]))
        identity = "" if m.ids is None else str(m.ids[i])
        results = _hypotheses(label, m.scores[i])
        rows.append(make("vision_msgs/Detection3D", header=header, results=results, bbox=box, id=identity))
    return make("vision_msgs/Detection3DArray", header=header, detections=rows)


@outward(messages.Diagnostics)
def diagnostics(m: messages.Diagnostics) -> Any:
    owners = [] if m.owners is None else m.owners.tolist()
    rows = []
    for i, name in enumerate(m.names):
        pairs = [
            make("diagnostic_msgs/KeyValue", key=k, value=v)
            for k, v, owner in zip(m.keys, m.values, owners, strict=True)
            if owner == i
        ]
        rows.append(
            make(
                "diagnostic_msgs/DiagnosticStatus",
                level=int(m.levels[i]),
                name=name,
                message=m.messages[i],
                hardware_id=m.hardware_ids[i] if m.hardware_ids else "",
                values=pairs,
            )
        )
    return make("diagnostic_msgs/DiagnosticArray", header=header_of(m.stamp, ""), status=rows)


OUTWARD |= {
    messages.Number: lambda m: make("std_msgs/Float64", data=m.value),
    messages.Text: lambda m: make("std_msgs/String", data=m.text),
    messages.Switch: lambda m: make("std_msgs/Bool", data=m.on),
    messages.Alarm: lambda m: make(
        "rcl_interfaces/Log", stamp=time(m.stamp), level=_LOG[m.level], name=m.name, msg=m.text, **_NOT_OF_CODE
    ),
    messages.CompressedVideo: lambda m: make(
        "foxglove_msgs/CompressedVideo",
        timestamp=time(m.stamp),
        frame_id=m.frame,
        data=as_bytes(m.data),
        format=m.format,
    ),
    messages.Point: lambda m: stamped("geometry_msgs/PointStamped", m, point=point(m.position)),
    messages.Pose: lambda m: stamped(
        "geometry_msgs/PoseWithCovarianceStamped", m, pose=with_covariance(m.position, m.orientation, m.covariance)
    ),
    messages.Twist: lambda m: stamped(
        "geometry_msgs/TwistWithCovarianceStamped", m, twist=moving(m.linear, m.angular, m.covariance)
    ),
    messages.Odometry: lambda m: stamped(
        "nav_msgs/Odometry",
        m,
        child_frame_id=m.child_frame,
        pose=with_covariance(m.position, m.orientation, m.pose_covariance),
        twist=moving(m.linear, m.angular, m.twist_covariance),
    ),
    messages.Imu: lambda m: stamped(
        "sensor_msgs/Imu",
        m,
        orientation=quaternion(m.orientation),
        orientation_covariance=_ABSENT if m.orientation is None else matrix(m.orientation_covariance, 3),
        angular_velocity=vector(m.angular_velocity),
        angular_velocity_covariance=matrix(m.angular_velocity_covariance, 3),
        linear_acceleration=vector(m.linear_acceleration),
        linear_acceleration_covariance=matrix(m.linear_acceleration_covariance, 3),
    ),
    messages.MagneticField: lambda m: stamped(
        "sensor_msgs/MagneticField",
        m,
        magnetic_field=vector(m.field),
        magnetic_field_covariance=matrix(m.covariance, 3),
    ),
    messages.RangeReading: lambda m: stamped(
        "sensor_msgs/Range",
        m,
        radiation_type=int(m.radiation == "infrared"),
        field_of_view=m.field_of_view,
        min_range=m.range_min,
        max_range=m.range_max,
        range=m.range,
    ),
}
