"""ROS message types that have a counterpart here, and the functions that convert them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dataflow.interop.ros import clouds, images, objects, poses, sensors
from dataflow.messages import (
    Alarm,
    Boxes3D,
    CameraInfo,
    CompressedImage,
    CompressedVideo,
    Detections2D,
    Diagnostics,
    Image,
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

Convert = Callable[[Any, int], Message]
"""(the ROS message, its stamp in ns) → message; raises `RecordingError` and `MessageError`."""

TRANSFORM_SETS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types that hold transforms of several stamps: one message here for each stamp."""
_NUMBERS = ("Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64")
_READINGS = ("Temperature", "FluidPressure", "Illuminance", "RelativeHumidity")

CONVERSIONS: dict[str, tuple[type[Message], Convert]] = {
    "sensor_msgs/msg/Image": (Image, images.image),
    "sensor_msgs/msg/CompressedImage": (CompressedImage, images.compressed_image),
    "foxglove_msgs/msg/CompressedVideo": (CompressedVideo, images.compressed_video),
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (CompressedVideo, images.ffmpeg_packet),
    "sensor_msgs/msg/CameraInfo": (CameraInfo, images.camera_info),
    "sensor_msgs/msg/PointCloud2": (PointCloud, clouds.point_cloud),
    "sensor_msgs/msg/Imu": (Imu, sensors.imu),
    "sensor_msgs/msg/LaserScan": (LaserScan, sensors.laser_scan),
    "sensor_msgs/msg/NavSatFix": (NavSatFix, sensors.nav_sat_fix),
    "sensor_msgs/msg/MagneticField": (MagneticField, sensors.magnetic_field),
    "sensor_msgs/msg/JointState": (JointState, sensors.joint_state),
    "nav_msgs/msg/Odometry": (Odometry, poses.odometry),
    "nav_msgs/msg/Path": (Path, poses.path),
    "nav_msgs/msg/OccupancyGrid": (OccupancyGrid, sensors.occupancy_grid),
    "geometry_msgs/msg/Point": (Point, poses.point),
    "geometry_msgs/msg/PointStamped": (Point, poses.point),
    "geometry_msgs/msg/Pose": (Pose, poses.pose),
    "geometry_msgs/msg/PoseStamped": (Pose, poses.pose),
    "geometry_msgs/msg/PoseWithCovariance": (Pose, poses.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (Pose, poses.pose),
    "geometry_msgs/msg/PoseArray": (ParticleSet, poses.pose_array),
    "geometry_msgs/msg/Twist": (Twist, poses.twist),
    "geometry_msgs/msg/TwistStamped": (Twist, poses.twist),
    "geometry_msgs/msg/TwistWithCovarianceStamped": (Twist, poses.twist),
    "geometry_msgs/msg/TransformStamped": (Transforms, poses.transform),
    "tf2_msgs/msg/TFMessage": (Transforms, lambda m, stamp: poses.transforms(m.transforms, stamp)),
    "tf/msg/tfMessage": (Transforms, lambda m, stamp: poses.transforms(m.transforms, stamp)),
    "vision_msgs/msg/Detection2DArray": (Detections2D, objects.detections_2d),
    "vision_msgs/msg/Detection3DArray": (Boxes3D, objects.detections_3d),
    "visualization_msgs/msg/Marker": (Boxes3D, objects.marker),
    "visualization_msgs/msg/MarkerArray": (Boxes3D, objects.marker_array),
    "diagnostic_msgs/msg/DiagnosticArray": (Diagnostics, sensors.diagnostics),
    "rcl_interfaces/msg/Log": (Alarm, sensors.log),
    "rosgraph_msgs/msg/Log": (Alarm, sensors.log),
    "std_msgs/msg/String": (Text, sensors.text),
    "std_msgs/msg/Bool": (Switch, sensors.switch),
    **{f"std_msgs/msg/{name}": (Number, sensors.number) for name in _NUMBERS},
    **{f"sensor_msgs/msg/{name}": (Measurement, sensors.measurement) for name in _READINGS},
    "sensor_msgs/msg/Range": (RangeReading, sensors.range_reading),
}
"""By ROS type: the message type that it usually becomes, and how."""
