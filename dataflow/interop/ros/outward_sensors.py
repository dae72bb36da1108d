"""Readings of sensors as ROS 2 messages."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from dataflow.interop.ros.made import Made, as_bytes, header_of, make, matrix, quaternion, time, vector
from dataflow.messages import (
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    CompressedVideo,
    DepthImage,
    Image,
    Image16,
    Imu,
    JointState,
    LaserScan,
    MagneticField,
    Measurement,
    NavSatFix,
    PointCloud,
    RangeReading,
)
from dataflow.messages.poses import COVARIANCE_TYPES
from dataflow.recording.errors import RecordingError

_FIX = {"no_fix": -1, "fix": 0, "sbas": 1, "gbas": 2, "rtk_float": 2, "rtk_fixed": 2}
_ABSENT = np.array([-1.0, 0, 0, 0, 0, 0, 0, 0, 0])
_FLOAT32, _FLOAT64, _UINT16, _UINT32 = 7, 8, 4, 6


def image(m: Image | Image16 | DepthImage) -> Made:
    color, bits = m.data.ndim == 3, 8 * m.data.itemsize
    encoding = "32FC1" if isinstance(m, DepthImage) else f"{'rgb' if color else 'mono'}{bits}"
    height, width = m.data.shape[:2]
    return "sensor_msgs/msg/Image", make(
        "sensor_msgs/Image",
        header=header_of(m.stamp, m.frame),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=m.data.nbytes // height,
        data=as_bytes(m.data),
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
    return "sensor_msgs/msg/CompressedImage", make(
        "sensor_msgs/CompressedImage", header=header_of(m.stamp, m.frame), format=format_, data=as_bytes(data)
    )


def compressed_video(m: CompressedVideo) -> Made:
    return "foxglove_msgs/msg/CompressedVideo", make(
        "foxglove_msgs/CompressedVideo",
        timestamp=time(m.stamp),
        frame_id=m.frame,
        data=as_bytes(m.data),
        format=m.format,
    )


def camera_info(m: CameraInfo) -> Made:
    nothing = make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return "sensor_msgs/msg/CameraInfo", make(
        "sensor_msgs/CameraInfo",
        header=header_of(m.stamp, m.frame),
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


def point_cloud(m: PointCloud) -> Made:
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
    return "sensor_msgs/msg/PointCloud2", make(
        "sensor_msgs/PointCloud2",
        header=header_of(m.stamp, m.frame),
        height=1 if m.columns is None else len(rows) // m.columns,
        width=len(rows) if m.columns is None else m.columns,
        fields=fields,
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.itemsize * (m.columns or len(rows)),
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=bool(np.isfinite(m.points).all()),
    )


def imu(m: Imu) -> Made:
    unknown = _ABSENT if m.orientation is None else matrix(m.orientation_covariance, 3)
    return "sensor_msgs/msg/Imu", make(
        "sensor_msgs/Imu",
        header=header_of(m.stamp, m.frame),
        orientation=quaternion(m.orientation),
        orientation_covariance=unknown,
        angular_velocity=vector(m.angular_velocity),
        angular_velocity_covariance=matrix(m.angular_velocity_covariance, 3),
        linear_acceleration=vector(m.linear_acceleration),
        linear_acceleration_covariance=matrix(m.linear_acceleration_covariance, 3),
    )


def magnetic_field(m: MagneticField) -> Made:
    return "sensor_msgs/msg/MagneticField", make(
        "sensor_msgs/MagneticField",
        header=header_of(m.stamp, m.frame),
        magnetic_field=vector(m.field),
        magnetic_field_covariance=matrix(m.covariance, 3),
    )


def laser_scan(m: LaserScan) -> Made:
    offsets = m.time_offsets
    step = 0.0 if offsets is None or len(offsets) < 2 else float(offsets[-1] - offsets[0]) / (len(offsets) - 1)
    return "sensor_msgs/msg/LaserScan", make(
        "sensor_msgs/LaserScan",
        header=header_of(m.stamp, m.frame),
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


def measurement(m: Measurement) -> Made:
    if m.unit not in MEASURED:
        raise RecordingError(f"a Measurement in {m.unit!r} has no counterpart in ROS; known are {', '.join(MEASURED)}")
    kind, field = MEASURED[m.unit]
    values = {field: m.value, "variance": m.variance or 0.0}
    return f"sensor_msgs/msg/{kind}", make(f"sensor_msgs/{kind}", header=header_of(m.stamp, m.frame), **values)


def range_reading(m: RangeReading) -> Made:
    return "sensor_msgs/msg/Range", make(
        "sensor_msgs/Range",
        header=header_of(m.stamp, m.frame),
        radiation_type=int(m.radiation == "infrared"),
        field_of_view=m.field_of_view,
        min_range=m.range_min,
        max_range=m.range_max,
        range=m.range,
    )


def nav_sat_fix(m: NavSatFix) -> Made:
    return "sensor_msgs/msg/NavSatFix", make(
        "sensor_msgs/NavSatFix",
        header=header_of(m.stamp, m.frame),
        status=make("sensor_msgs/NavSatStatus", status=_FIX[m.status], service=0),
        latitude=m.latitude,
        longitude=m.longitude,
        altitude=m.altitude,
        position_covariance=matrix(m.covariance, 3),
        position_covariance_type=COVARIANCE_TYPES.index(m.covariance_type),
    )


def joint_state(m: JointState) -> Made:
    position, velocity, effort = (
        np.zeros(0) if v is None else np.array(v) for v in (m.positions, m.velocities, m.efforts)
    )
    header = header_of(m.stamp, "")
    return "sensor_msgs/msg/JointState", make(
        "sensor_msgs/JointState",
        header=header,
        name=list(m.names),
        position=position,
        velocity=velocity,
        effort=effort,
    )
