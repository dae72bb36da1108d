"""Messages as ROS 2 messages, the other way round."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dataflow.messages import (
    Alarm,
    Boxes3D,
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    DepthImage,
    Detections2D,
    Diagnostics,
    Image,
    Imu,
    JointState,
    LaserScan,
    MagneticField,
    Message,
    NavSatFix,
    Number,
    OccupancyGrid,
    Odometry,
    ParticleSet,
    Path,
    PointCloud,
    Pose,
    Switch,
    Text,
    Transforms,
    Twist,
)
from dataflow.messages.poses import COVARIANCE_TYPES
from dataflow.recording.errors import RecordingError

Made = tuple[str, Any]
"""(ROS type, ROS message)"""

_VISION = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nstring id\n",
    "vision_msgs/msg/Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id\n",
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
"""vision_msgs 4, which the library does not have."""
_FIX = {"no_fix": -1, "fix": 0, "sbas": 1, "gbas": 2, "rtk_float": 2, "rtk_fixed": 2}
_LOG = {"debug": 10, "info": 20, "warning": 30, "error": 40, "fatal": 50}
_ABSENT = np.array([-1.0, 0, 0, 0, 0, 0, 0, 0, 0])
_FLOAT32, _UINT16, _UINT32 = 7, 4, 6


@cache
def typestore() -> Typestore:
    """The ROS 2 types that messages become."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _VISION.items():
        store.register(get_types_from_msg(text, name))
    return store


def _make(kind: str, /, **fields: Any) -> Any:
    package, _, name = kind.partition("/")
    return typestore().types[f"{package}/msg/{name}"](**fields)


def time(stamp: int) -> Any:
    """A builtin_interfaces/Time; raises `RecordingError` for stamps that it cannot hold."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    if not -(2**31) <= seconds < 2**31:
        raise RecordingError(f"stamp {stamp} lies beyond the times of ROS, which end in 2038")
    return _make("builtin_interfaces/Time", sec=seconds, nanosec=nanoseconds)


def _header(stamp: int, frame: str) -> Any:
    return _make("std_msgs/Header", stamp=time(stamp), frame_id=frame)


def _vector(values: Any) -> Any:
    x, y, z = map(float, values)
    return _make("geometry_msgs/Vector3", x=x, y=y, z=z)


def _point(values: Any) -> Any:
    x, y, z = map(float, values)
    return _make("geometry_msgs/Point", x=x, y=y, z=z)


def _quaternion(values: Any) -> Any:
    x, y, z, w = (0.0, 0.0, 0.0, 1.0) if values is None else map(float, values)
    return _make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)


def _pose(position: Any, orientation: Any) -> Any:
    return _make("geometry_msgs/Pose", position=_point(position), orientation=_quaternion(orientation))


def _matrix(values: Any, size: int) -> Any:
    return np.zeros(size * size) if values is None else np.asarray(values, np.float64).ravel()


def _placed(position: Any, orientation: Any, covariance: Any) -> Any:
    pose = _pose(position, orientation)
    return _make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=_matrix(covariance, 6))


def _moving(linear: Any, angular: Any, covariance: Any = None) -> Any:
    zero = np.zeros(3)
    linear, angular = (_vector(zero if v is None else v) for v in (linear, angular))
    twist = _make("geometry_msgs/Twist", linear=linear, angular=angular)
    return _make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=_matrix(covariance, 6))


def _bytes(data: Any) -> Any:
    return np.ascontiguousarray(data).reshape(-1).view(np.uint8)


def image(m: Image | DepthImage) -> Made:
    encoding = "32FC1" if isinstance(m, DepthImage) else "rgb8" if m.data.ndim == 3 else "mono8"
    height, width = m.data.shape[:2]
    return "sensor_msgs/msg/Image", _make(
        "sensor_msgs/Image",
        header=_header(m.stamp, m.frame),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=m.data.nbytes // height,
        data=_bytes(m.data),
    )


def compressed(m: CompressedImage | CompressedDepth) -> Made:
    if isinstance(m, CompressedImage):
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
    return "sensor_msgs/msg/CompressedImage", _make(
        "sensor_msgs/CompressedImage", header=_header(m.stamp, m.frame), format=format_, data=_bytes(data)
    )


def camera_info(m: CameraInfo) -> Made:
    nothing = _make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return "sensor_msgs/msg/CameraInfo", _make(
        "sensor_msgs/CameraInfo",
        header=_header(m.stamp, m.frame),
        height=m.height,
        width=m.width,
        distortion_model="" if m.distortion_model == "none" else m.distortion_model,
        d=np.zeros(0) if m.distortion is None else np.array(m.distortion),
        k=m.K.ravel(),
        r=_matrix(m.R, 3),
        p=np.zeros(12) if m.P is None else m.P.ravel(),
        binning_x=0,
        binning_y=0,
        roi=nothing,
    )


def point_cloud(m: PointCloud) -> Made:
    columns: list[tuple[str, str, int, Any]] = [(n, "<f4", _FLOAT32, m.points[:, i]) for i, n in enumerate("xyz")]
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
        fields.append(_make("sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=1))
    return "sensor_msgs/msg/PointCloud2", _make(
        "sensor_msgs/PointCloud2",
        header=_header(m.stamp, m.frame),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=bool(np.isfinite(m.points).all()),
    )


def imu(m: Imu) -> Made:
    unknown = _ABSENT if m.orientation is None else _matrix(m.orientation_covariance, 3)
    return "sensor_msgs/msg/Imu", _make(
        "sensor_msgs/Imu",
        header=_header(m.stamp, m.frame),
        orientation=_quaternion(m.orientation),
        orientation_covariance=unknown,
        angular_velocity=_vector(m.angular_velocity),
        angular_velocity_covariance=_matrix(m.angular_velocity_covariance, 3),
        linear_acceleration=_vector(m.linear_acceleration),
        linear_acceleration_covariance=_matrix(m.linear_acceleration_covariance, 3),
    )


def magnetic_field(m: MagneticField) -> Made:
    return "sensor_msgs/msg/MagneticField", _make(
        "sensor_msgs/MagneticField",
        header=_header(m.stamp, m.frame),
        magnetic_field=_vector(m.field),
        magnetic_field_covariance=_matrix(m.covariance, 3),
    )


def laser_scan(m: LaserScan) -> Made:
    offsets = m.time_offsets
    step = 0.0 if offsets is None or len(offsets) < 2 else float(offsets[-1] - offsets[0]) / (len(offsets) - 1)
    return "sensor_msgs/msg/LaserScan", _make(
        "sensor_msgs/LaserScan",
        header=_header(m.stamp, m.frame),
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


def nav_sat_fix(m: NavSatFix) -> Made:
    return "sensor_msgs/msg/NavSatFix", _make(
        "sensor_msgs/NavSatFix",
        header=_header(m.stamp, m.frame),
        status=_make("sensor_msgs/NavSatStatus", status=_FIX[m.status], service=0),
        latitude=m.latitude,
        longitude=m.longitude,
        altitude=m.altitude,
        position_covariance=_matrix(m.covariance, 3),
        position_covariance_type=COVARIANCE_TYPES.index(m.covariance_type),
    )


def joint_state(m: JointState) -> Made:
    position, velocity, effort = (
        np.zeros(0) if v is None else np.array(v) for v in (m.positions, m.velocities, m.efforts)
    )
    header = _header(m.stamp, "")
    return "sensor_msgs/msg/JointState", _make(
        "sensor_msgs/JointState",
        header=header,
        name=list(m.names),
        position=position,
        velocity=velocity,
        effort=effort,
    )


def odometry(m: Odometry) -> Made:
    return "nav_msgs/msg/Odometry", _make(
        "nav_msgs/Odometry",
        header=_header(m.stamp, m.frame),
        child_frame_id=m.child_frame,
        pose=_placed(m.position, m.orientation, m.pose_covariance),
        twist=_moving(m.linear, m.angular, m.twist_covariance),
    )


def pose(m: Pose) -> Made:
    placed = _placed(m.position, m.orientation, m.covariance)
    return "geometry_msgs/msg/PoseWithCovarianceStamped", _make(
        "geometry_msgs/PoseWithCovarianceStamped", header=_header(m.stamp, m.frame), pose=placed
    )


def twist(m: Twist) -> Made:
    return "geometry_msgs/msg/TwistWithCovarianceStamped", _make(
        "geometry_msgs/TwistWithCovarianceStamped",
        header=_header(m.stamp, m.frame),
        twist=_moving(m.linear, m.angular, m.covariance),
    )


def path(m: Path) -> Made:
    turns = [None] * m.count if m.orientations is None else m.orientations
    stamps: Sequence[int] = [0] * m.count if m.stamps is None else m.stamps.tolist()
    poses = [
        _make("geometry_msgs/PoseStamped", header=_header(stamp, m.frame), pose=_pose(position, turn))
        for stamp, position, turn in zip(stamps, m.positions, turns, strict=True)
    ]
    return "nav_msgs/msg/Path", _make("nav_msgs/Path", header=_header(m.stamp, m.frame), poses=poses)


def occupancy_grid(m: OccupancyGrid) -> Made:
    height, width = m.cells.shape
    info = _make(
        "nav_msgs/MapMetaData",
        map_load_time=time(m.stamp),
        resolution=m.resolution,
        width=width,
        height=height,
        origin=_pose(m.position, m.orientation),
    )
    return "nav_msgs/msg/OccupancyGrid", _make(
        "nav_msgs/OccupancyGrid", header=_header(m.stamp, m.frame), info=info, data=np.array(m.cells).ravel()
    )


def particles(m: ParticleSet) -> Made:
    if m.poses.shape[1] == 3:
        half = 0.5 * m.poses[:, 2]
        rows = [
            _pose((x, y, 0.0), (0.0, 0.0, s, c))
            for (x, y, _), s, c in zip(m.poses, np.sin(half), np.cos(half), strict=True)
        ]
    else:
        rows = [_pose(row[:3], row[3:]) for row in m.poses]
    made = _make("geometry_msgs/PoseArray", header=_header(m.stamp, m.frame), poses=rows)
    return "geometry_msgs/msg/PoseArray", made


def transforms(m: Transforms) -> Made:
    rows = []
    for i, child in enumerate(m.child_frames):
        placed = _make(
            "geometry_msgs/Transform", translation=_vector(m.translations[i]), rotation=_quaternion(m.rotations[i])
        )
        header = _header(m.stamp, m.frames[i])
        rows.append(_make("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=placed))
    return "tf2_msgs/msg/TFMessage", _make("tf2_msgs/TFMessage", transforms=rows)


def _hypotheses(label: str, score: float) -> list[Any]:
    hypothesis = _make("vision_msgs/ObjectHypothesis", class_id=label, score=float(score))
    nowhere = _placed(np.zeros(3), None, None)
    return [_make("vision_msgs/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=nowhere)]


def detections(m: Detections2D) -> Made:
    header = _header(m.stamp, m.frame)
    rows = []
    for i, (label, (x1, y1, x2, y2)) in enumerate(zip(m.labels(), m.boxes.tolist(), strict=True)):
        middle = _make("vision_msgs/Point2D", x=(x1 + x2) / 2, y=(y1 + y2) / 2)
        center = _make("vision_msgs/Pose2D", position=middle, theta=0.0)
        box = _make("vision_msgs/BoundingBox2D", center=center, size_x=x2 - x1, size_y=y2 - y1)
        identity = "" if m.ids is None else str(m.ids[i])
        results = _hypotheses(label, m.scores[i])
        rows.append(_make("vision_msgs/Detection2D", header=header, results=results, bbox=box, id=identity))
    return "vision_msgs/msg/Detection2DArray", _make("vision_msgs/Detection2DArray", header=header, detections=rows)


def boxes(m: Boxes3D) -> Made:
    header = _header(m.stamp, m.frame)
    rows = []
    for i, label in enumerate(m.labels()):
        center = _pose(m.centers[i], m.orientations[i])
        box = _make("vision_msgs/BoundingBox3D", center=center, size=_vector(m.sizes[i]))
        identity = "" if m.ids is None else str(m.ids[i])
        results = _hypotheses(label, m.scores[i])
        rows.append(_make("vision_msgs/Detection3D", header=header, results=results, bbox=box, id=identity))
    return "vision_msgs/msg/Detection3DArray", _make("vision_msgs/Detection3DArray", header=header, detections=rows)


def diagnostics(m: Diagnostics) -> Made:
    owners = [] if m.owners is None else m.owners.tolist()
    rows = []
    for i, name in enumerate(m.names):
        pairs = [
            _make("diagnostic_msgs/KeyValue", key=k, value=v)
            for k, v, owner in zip(m.keys, m.values, owners, strict=True)
            if owner == i
        ]
        rows.append(
            _make(
                "diagnostic_msgs/DiagnosticStatus",
                level=int(m.levels[i]),
                name=name,
                message=m.messages[i],
                hardware_id=m.hardware_ids[i] if m.hardware_ids else "",
                values=pairs,
            )
        )
    made = _make("diagnostic_msgs/DiagnosticArray", header=_header(m.stamp, ""), status=rows)
    return "diagnostic_msgs/msg/DiagnosticArray", made


def alarm(m: Alarm) -> Made:
    made = _make(
        "rcl_interfaces/Log",
        stamp=time(m.stamp),
        level=_LOG[m.level],
        name=m.name,
        msg=m.text,
        file="",
        function="",
        line=0,
    )
    return "rcl_interfaces/msg/Log", made


def number(m: Number) -> Made:
    return "std_msgs/msg/Float64", _make("std_msgs/Float64", data=m.value)


def text(m: Text) -> Made:
    return "std_msgs/msg/String", _make("std_msgs/String", data=m.text)


def switch(m: Switch) -> Made:
    return "std_msgs/msg/Bool", _make("std_msgs/Bool", data=m.on)


OUTWARD: dict[type[Message], Callable[[Any], Made]] = {
    Image: image,
    DepthImage: image,
    CompressedImage: compressed,
    CompressedDepth: compressed,
    CameraInfo: camera_info,
    PointCloud: point_cloud,
    Imu: imu,
    MagneticField: magnetic_field,
    LaserScan: laser_scan,
    NavSatFix: nav_sat_fix,
    JointState: joint_state,
    Odometry: odometry,
    Pose: pose,
    Twist: twist,
    Path: path,
    OccupancyGrid: occupancy_grid,
    ParticleSet: particles,
    Transforms: transforms,
    Detections2D: detections,
    Boxes3D: boxes,
    Diagnostics: diagnostics,
    Alarm: alarm,
    Number: number,
    Text: text,
    Switch: switch,
}
"""By message type: how it becomes a ROS message."""
