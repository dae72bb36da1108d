"""A recording with what analysis meets: vectors, optional fields, parallel arrays, pictures, a static stream."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dataflow.messages import CameraInfo, Detections2D, Image, Imu, Number
from dataflow.recording import RecordingWriter

START = 1_700_000_000_000_000_000
MS = 1_000_000


def imu(i: int) -> Imu:
    return Imu(
        stamp=START + 10 * MS * i,
        frame="imu",
        angular_velocity=[i, 0.5, -i],
        linear_acceleration=[0.0, 0.0, 9.81],
        temperature=20.0 + i if i % 2 else None,
    )


def detections(i: int) -> Detections2D:
    return Detections2D(
        stamp=START + 40 * MS * i,
        frame="camera",
        width=4,
        height=3,
        class_names=("cat", "dog"),
        boxes=np.arange(4 * i, dtype=np.float32).reshape(i, 4) if i else np.zeros((0, 4), np.float32),
        scores=np.full(i, 0.5, np.float32),
        class_ids=np.arange(i, dtype=np.int32) % 2,
    )


def write(file: Path) -> None:
    """100 ms: `robot/imu` every 10 ms, `robot/objects` and `camera/image` every 40 ms, `camera/info` static."""
    with RecordingWriter(file, metadata={}, namespace="r1") as writer:
        for name, kind in (("robot/imu", Imu), ("robot/objects", Detections2D), ("camera/image", Image)):
            writer.add_stream(f"r1/{name}", kind)
        writer.add_stream("r1/camera/info", CameraInfo, static=True)
        writer.add_stream("r1/robot/battery", Number)
        writer.write("r1/camera/info", CameraInfo(stamp=0, frame="camera", width=4, height=3, K=np.eye(3)), seq=0)
        for i in range(11):
            writer.write("r1/robot/imu", imu(i), seq=i)
        for i in range(3):
            writer.write("r1/robot/objects", detections(i), seq=i)
            data = np.full((3, 4, 3), 50 * i, np.uint8)
            writer.write("r1/camera/image", Image(stamp=START + (40 * i + 3) * MS, frame="camera", data=data), seq=i)
