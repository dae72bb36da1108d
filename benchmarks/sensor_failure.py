"""Each sensor in turn is dropped, frozen, blacked out and miscalibrated while graphs/perception.yaml runs.

    python benchmarks/sensor_failure.py [--seconds 8] [--from 3 --to 5] [--only depth] [--out failures.json]

The bundled recording is handed to the graph message by message; what the faulty sensor gives in the span is left out
(dropped), the last message again (frozen), or nothing but black, no return, no point, zeros (black). A miscalibrated
sensor is wrong for the whole drive: it is turned by 3 degrees against its calibration, or its scale is wrong by 5 %.
The pose's error is against the truth from the first pose on; the other figures are the graph's own scores. A status is
said to speak where an operator warns about more messages than it does without the fault.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import dataflow
from dataflow.messages import (
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    DepthImage,
    Diagnostics,
    Image,
    Imu,
    Message,
    Odometry,
    PointCloud,
    Transforms,
)
from dataflow.messages.diagnostics import Level
from operators.codec import DepthDecoder, ImageDecoder

ROOT = Path(__file__).resolve().parents[1]
STREAMS = {
    "colour": "robot/image_jpeg",
    "depth": "robot/depth_png",
    "lidar": "robot/points",
    "imu": "robot/imu",
    "wheels": "robot/wheel_odometry",
}
FRAMES = {"colour": "camera", "depth": "depth", "lidar": "lidar", "imu": "imu"}
KINDS = ("dropped", "frozen", "black", "miscalibrated")
TURN = np.deg2rad(3.0)
SCALE = 1.05


@dataclass(frozen=True)
class Case:
    """One sensor and what happens to it."""

    sensor: str
    kind: str

    def __str__(self) -> str:
        return f"{self.sensor} {self.kind}" if self.sensor else "nothing"
