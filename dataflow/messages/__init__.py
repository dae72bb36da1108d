"""Message types and their conventions, one module per family."""

from dataflow.messages.base import ANCHOR, Message, MessageError, array, message_type, message_types, scalar
from dataflow.messages.camera import CameraInfo
from dataflow.messages.clouds import Clusters, PointCloud
from dataflow.messages.detection import Boxes3D, Detections2D, Keypoints2D, pack_masks
from dataflow.messages.diagnostics import Diagnostics, Level
from dataflow.messages.images import (
    CompressedDepth,
    CompressedImage,
    CompressedVideo,
    DepthImage,
    Image,
    Image16,
    RelativeDepth,
)
from dataflow.messages.inertial import Imu, MagneticField
from dataflow.messages.mapping import Mesh, OccupancyGrid, Planes, Rooms
from dataflow.messages.poses import NavSatFix, Odometry, ParticleSet, Path, Point, Pose, Transforms, Twist
from dataflow.messages.ranging import LaserScan, RadarScan, RangeReading
from dataflow.messages.scene import Activity, Classification, FeatureVector, SceneGraph
from dataflow.messages.segmentation import SegmentationMap
from dataflow.messages.tracking import LandmarkSightings, Tracks, TrackState
from dataflow.messages.values import Alarm, Measurement, Number, Switch, Text
from dataflow.messages.wheels import JointState, WheelTicks

__all__ = [
    "ANCHOR",
    "Activity",
    "Alarm",
    "Boxes3D",
    "CameraInfo",
    "Classification",
    "Clusters",
    "CompressedDepth",
    "CompressedImage",
    "CompressedVideo",
    "DepthImage",
    "Detections2D",
    "Diagnostics",
    "FeatureVector",
    "Image",
    "Image16",
    "Imu",
    "JointState",
    "Keypoints2D",
    "LandmarkSightings",
    "LaserScan",
    "Level",
    "MagneticField",
    "Measurement",
    "Mesh",
    "Message",
    "MessageError",
    "NavSatFix",
    "Number",
    "OccupancyGrid",
    "Odometry",
    "ParticleSet",
    "Path",
    "Planes",
    "Point",
    "PointCloud",
    "Pose",
    "RadarScan",
    "RangeReading",
    "RelativeDepth",
    "Rooms",
    "SceneGraph",
    "SegmentationMap",
    "Switch",
    "Text",
    "TrackState",
    "Tracks",
    "Transforms",
    "Twist",
    "WheelTicks",
    "array",
    "message_type",
    "message_types",
    "pack_masks",
    "scalar",
]
