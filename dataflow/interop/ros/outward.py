"""Messages as ROS 2 messages, the other way round: which function makes which."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dataflow.interop.ros import outward_scene as scene
from dataflow.interop.ros import outward_sensors as sensors
from dataflow.interop.ros.made import Made
from dataflow.messages import (
    Alarm,
    Boxes3D,
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    CompressedVideo,
    DepthImage,
    Detections2D,
    Diagnostics,
    Image,
    Image16,
    Imu,
    JointState,
    LaserScan,
    MagneticField,
    Measurement,
    Message,
    NavSatFix,
    Number,
    OccupancyGrid,
    Odometry,
    ParticleSet,
    Path,
    Point,
    PointCloud,
    Pose,
    RangeReading,
    Switch,
    Text,
    Transforms,
    Twist,
)

OUTWARD: dict[type[Message], Callable[[Any], Made]] = {
    Image: sensors.image,
    Image16: sensors.image,
    DepthImage: sensors.image,
    CompressedImage: sensors.compressed,
    CompressedDepth: sensors.compressed,
    CompressedVideo: sensors.compressed_video,
    CameraInfo: sensors.camera_info,
    PointCloud: sensors.point_cloud,
    Imu: sensors.imu,
    MagneticField: sensors.magnetic_field,
    LaserScan: sensors.laser_scan,
    NavSatFix: sensors.nav_sat_fix,
    Measurement: sensors.measurement,
    RangeReading: sensors.range_reading,
    JointState: sensors.joint_state,
    Odometry: scene.odometry,
    Point: scene.point_stamped,
    Pose: scene.pose,
    Twist: scene.twist,
    Path: scene.path,
    OccupancyGrid: scene.occupancy_grid,
    ParticleSet: scene.particles,
    Transforms: scene.transforms,
    Detections2D: scene.detections,
    Boxes3D: scene.boxes,
    Diagnostics: scene.diagnostics,
    Alarm: scene.alarm,
    Number: scene.number,
    Text: scene.text,
    Switch: scene.switch,
}
"""By message type: how it becomes a ROS message."""
