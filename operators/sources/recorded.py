"""Stand-ins for the sensors of a recording made elsewhere: a replay feeds their streams from the topics of a bag."""

from __future__ import annotations

from dataflow.messages import (
    CameraInfo,
    CompressedImage,
    CompressedVideo,
    DepthImage,
    Image,
    Imu,
    LaserScan,
    MagneticField,
    NavSatFix,
    Odometry,
    PointCloud,
    Pose,
    Transforms,
    Twist,
)
from dataflow.operator import Out, Source


class RecordedSource(Source, abstract=True):
    """Base of sources that exist in recordings only."""

    def setup(self) -> None:
        """Raises RuntimeError: there is nothing to run."""
        raise RuntimeError(
            f"{type(self).__name__} stands for streams of a recording and has no data: replay one into the "
            "graph with `dataflow replay RECORDING --graph GRAPH`"
        )


class RecordedCamera(RecordedSource):
    """A camera of a recording."""

    image: Out[Image] = Out(doc="colour or grey")
    compressed: Out[CompressedImage] = Out(doc="the same, encoded")
    video: Out[CompressedVideo] = Out(doc="the same as H.264 or H.265")
    info: Out[CameraInfo] = Out(static=True, doc="its calibration")


class RecordedRgbdCamera(RecordedSource):
    """A colour and depth camera of a recording; its ports are named as those of RgbdFolder."""

    image: Out[Image] = Out(doc="colour or grey")
    depth: Out[DepthImage] = Out(doc="depth, metres")
    image_info: Out[CameraInfo] = Out(static=True, doc="calibration of the colour camera")
    depth_info: Out[CameraInfo] = Out(static=True, doc="calibration of the depth camera")
    extrinsics: Out[Transforms] = Out(static=True, doc="holds the transform between the two cameras")
    ground_truth: Out[Pose] = Out(doc="true pose")


class RecordedStereoCamera(RecordedSource):
    """A stereo camera of a recording."""

    left: Out[Image] = Out(doc="left image")
    right: Out[Image] = Out(doc="right image")
    left_info: Out[CameraInfo] = Out(static=True, doc="calibration of the left camera")
    right_info: Out[CameraInfo] = Out(static=True, doc="calibration of the right camera; P holds the baseline")


class RecordedLidar(RecordedSource):
    """A spinning or planar lidar of a recording."""

    points: Out[PointCloud] = Out(doc="points")
    scan: Out[LaserScan] = Out(doc="planar sweeps")


class RecordedImu(RecordedSource):
    """An inertial sensor of a recording, with its magnetometer."""

    imu: Out[Imu] = Out(doc="gyroscope and accelerometer, with the orientation where it gives one")
    magnetic_field: Out[MagneticField] = Out(doc="magnetometer")


class RecordedPose(RecordedSource):
    """Places and motions of a recording: odometry, poses, commands, satellite fixes."""

    odometry: Out[Odometry] = Out(doc="pose and velocity")
    pose: Out[Pose] = Out(doc="pose")
    twist: Out[Twist] = Out(doc="velocity")
    fix: Out[NavSatFix] = Out(doc="satellite fix")


class RecordedTransforms(RecordedSource):
    """The transform tree of a recording."""

    moving: Out[Transforms] = Out(doc="transforms that change (/tf): those of one time are one message")
    fixed: Out[Transforms] = Out(static=True, doc="transforms that do not (/tf_static)")
