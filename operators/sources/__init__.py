"""Sources: datasets, devices and made-up sequences."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.sources.broad_imu import BroadImu
    from operators.sources.euroc_imu import EurocImu
    from operators.sources.gnss import NmeaFile, NmeaGnss
    from operators.sources.image_folder import GrowingImageFolder, ImageFolder
    from operators.sources.kitti_odometry import KittiOdometry
    from operators.sources.kitti_raw import KittiRaw
    from operators.sources.realsense import RealSense
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
    from operators.sources.static_transforms import StaticTransforms
    from operators.sources.synthetic_rgbd import SyntheticRgbd
    from operators.sources.vectornav import VectorNavImu
    from operators.sources.velodyne import VelodyneFile, VelodyneLidar
    from operators.sources.victoria_park import VictoriaPark
    from operators.sources.video import VideoFile, Webcam
else:  # most need a separate library, which a graph without them need not load
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "broad_imu": ("BroadImu",),
            "euroc_imu": ("EurocImu",),
            "gnss": ("NmeaFile", "NmeaGnss"),
            "image_folder": ("GrowingImageFolder", "ImageFolder"),
            "kitti_odometry": ("KittiOdometry",),
            "kitti_raw": ("KittiRaw",),
            "realsense": ("RealSense",),
            "recorded": (
                "RecordedCamera",
                "RecordedImu",
                "RecordedLidar",
                "RecordedPose",
                "RecordedRgbdCamera",
                "RecordedStereoCamera",
                "RecordedTransforms",
            ),
            "rgbd_folder": ("RgbdFolder",),
            "static_transforms": ("StaticTransforms",),
            "synthetic_rgbd": ("SyntheticRgbd",),
            "vectornav": ("VectorNavImu",),
            "velodyne": ("VelodyneFile", "VelodyneLidar"),
            "victoria_park": ("VictoriaPark",),
            "video": ("VideoFile", "Webcam"),
        },
    )

__all__ = [
    "BroadImu",
    "EurocImu",
    "GrowingImageFolder",
    "ImageFolder",
    "KittiOdometry",
    "KittiRaw",
    "NmeaFile",
    "NmeaGnss",
    "RealSense",
    "RecordedCamera",
    "RecordedImu",
    "RecordedLidar",
    "RecordedPose",
    "RecordedRgbdCamera",
    "RecordedStereoCamera",
    "RecordedTransforms",
    "RgbdFolder",
    "StaticTransforms",
    "SyntheticRgbd",
    "VectorNavImu",
    "VelodyneFile",
    "VelodyneLidar",
    "VictoriaPark",
    "VideoFile",
    "Webcam",
]
