"""Sources: datasets, devices, made-up sequences and a simulated robot."""

from operators.sources.broad_imu import BroadImu
from operators.sources.euroc_imu import EurocImu
from operators.sources.kitti_odometry import KittiOdometry
from operators.sources.kitti_raw import KittiRaw
from operators.sources.recorded import (
    RecordedCamera,
    RecordedImu,
    RecordedLidar,
    RecordedPose,
    RecordedRgbdCamera,
    RecordedStereoCamera,
    RecordedTransforms,
)
from operators.sources.rgbd_folder import RgbdFolder
from operators.sources.simulated_robot import SimulatedRobot
from operators.sources.synthetic_rgbd import SyntheticRgbd
from operators.sources.victoria_park import VictoriaPark

__all__ = [
    "BroadImu",
    "EurocImu",
    "KittiOdometry",
    "KittiRaw",
    "RecordedCamera",
    "RecordedImu",
    "RecordedLidar",
    "RecordedPose",
    "RecordedRgbdCamera",
    "RecordedStereoCamera",
    "RecordedTransforms",
    "RgbdFolder",
    "SimulatedRobot",
    "SyntheticRgbd",
    "VictoriaPark",
]
