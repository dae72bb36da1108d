"""The place of a robot's sensors in a graph whose measurements a program hands in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from dataflow.messages import CameraInfo, DepthImage, Image, Imu, Message, Odometry, PointCloud, Transforms, Twist
from dataflow.operator import Out, Source


class HandedSensors(Source):
    """Stands for the sensors of a `PerceptionSystem`, which is handed their measurements; it has none itself."""

    real_time = True

    image: Out[Image] = Out(doc="colour or grey image")
    depth: Out[DepthImage] = Out(doc="depth, metres, of the image's stamp")
    points: Out[PointCloud] = Out(doc="one turn of a LiDAR")
    imu: Out[Imu] = Out(doc="inertial sample")
    wheels: Out[Odometry] = Out(doc="odometry of the wheels, with velocities")
    command: Out[Twist] = Out(doc="control input: the commanded velocity of the base")
    image_info: Out[CameraInfo] = Out(static=True, doc="calibration of the image")
    depth_info: Out[CameraInfo] = Out(static=True, doc="calibration of the depth image")
    extrinsics: Out[Transforms] = Out(static=True, doc="where the sensors are on the robot")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        """Raises RuntimeError: what it gives is handed in."""
        raise RuntimeError("HandedSensors gives only what a PerceptionSystem is handed, or a recording of it")
