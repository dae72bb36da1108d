"""ROS message types that have a counterpart here, and the functions that convert them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import dataflow.messages as messages
from dataflow.interop.ros import clouds, images, objects, poses, sensors
from dataflow.interop.ros.values import covariance, vector

Convert = Callable[[Any, int], messages.Message]
"""(the ROS message, its stamp in ns) → message; raises `RecordingError` and `MessageError`."""

TRANSFORM_SETS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types that hold transforms of several stamps: one message here for each stamp."""
_NUMBERS = ("Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64")
_READINGS = ("Temperature", "FluidPressure", "Illuminance", "RelativeHumidity")

CONVERSIONS: dict[str, tuple[type[messages.Message], Convert]] = {
    "sensor_msgs/msg/Image": (messages.Image, images.image),
    "sensor_msgs/msg/CompressedImage": (messages.CompressedImage, images.compressed_image),
    "foxglove_msgs/msg/CompressedVideo": (messages.CompressedVideo, images.compressed_video),
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (messages.CompressedVideo, images.ffmpeg_packet),
    "sensor_msgs/msg/CameraInfo": (messages.CameraInfo, images.camera_info),
    "sensor_msgs/msg/PointCloud2": (messages.PointCloud, clouds.point_cloud),
    "sensor_msgs/msg/Imu": (messages.Imu, sensors.imu),
    "sensor_msgs/msg/LaserScan": (messages.LaserScan, sensors.laser_scan),
    "sensor_msgs/msg/NavSatFix": (messages.NavSatFix, sensors.nav_sat_fix),
    "sensor_msgs/msg/MagneticField": (
        messages.MagneticField,
        lambda m, stamp: messages.MagneticField(
            stamp=stamp,
            frame=m.header.frame_id,
            field=vector(m.magnetic_field),
            covariance=covariance(m, "magnetic_field_covariance", 3),
        ),
    ),
    "sensor_msgs/msg/JointState": (messages.JointState, sensors.joint_state),
    "nav_msgs/msg/Odometry": (messages.Odometry, poses.odometry),
    "nav_msgs/msg/Path": (messages.Path, poses.path),
    "nav_msgs/msg/OccupancyGrid": (messages.OccupancyGrid, sensors.occupancy_grid),
    "geometry_msgs/msg/Point": (messages.Point, poses.point),
    "geometry_msgs/msg/PointStamped": (messages.Point, poses.point),
    "geometry_msgs/msg/Pose": (messages.Pose, poses.pose),
    "geometry_msgs/msg/PoseStamped": (messages.Pose, poses.pose),
    "geometry_msgs/msg/PoseWithCovariance": (messages.Pose, poses.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (messages.Pose, poses.pose),
    "geometry_msgs/msg/PoseArray": (messages.ParticleSet, poses.pose_array),
    "geometry_msgs/msg/Twist": (messages.Twist, poses.twist),
    "geometry_msgs/msg/TwistStamped": (messages.Twist, poses.twist),
    "geometry_msgs/msg/TwistWithCovarianceStamped": (messages.Twist, poses.twist),
    "geometry_msgs/msg/TransformStamped": (messages.Transforms, poses.transform),
    "tf2_msgs/msg/TFMessage": (messages.Transforms, lambda m, stamp: poses.transforms(m.transforms, stamp)),
    "tf/msg/tfMessage": (messages.Transforms, lambda m, stamp: poses.transforms(m.transforms, stamp)),
    "vision_msgs/msg/Detection2DArray": (messages.Detections2D, objects.detections_2d),
    "vision_msgs/msg/Detection3DArray": (messages.Boxes3D, objects.detections_3d),
    "visualization_msgs/msg/Marker": (messages.Boxes3D, objects.marker),
    "visualization_msgs/msg/MarkerArray": (messages.Boxes3D, objects.marker_array),
    "diagnostic_msgs/msg/DiagnosticArray": (messages.Diagnostics, sensors.diagnostics),
    "rcl_interfaces/msg/Log": (messages.Alarm, sensors.log),
    "rosgraph_msgs/msg/Log": (messages.Alarm, sensors.log),
    "std_msgs/msg/String": (messages.Text, lambda m, stamp: messages.Text(stamp=stamp, text=m.data)),
    "std_msgs/msg/Bool": (messages.Switch, lambda m, stamp: messages.Switch(stamp=stamp, on=bool(m.data))),
    **{f"std_msgs/msg/{name}": (messages.Number, sensors.number) for name in _NUMBERS},
    **{f"sensor_msgs/msg/{name}": (messages.Measurement, sensors.measurement) for name in _READINGS},
    "sensor_msgs/msg/Range": (messages.RangeReading, sensors.range_reading),
}
"""By ROS type: the message type that it usually becomes, and how."""
