"""Two devices on one topic are named by what each of them keeps."""

from __future__ import annotations

import numpy as np
import pytest
from lint_inputs import MadeInput, every

from dataflow.lint.checks import lint
from dataflow.messages import CameraInfo, Image, Message, PointCloud

STAMPS = every(0.1)


def image(stamp: int, frame: str, width: int = 8) -> Message:
    return Image(stamp=stamp, frame=frame, data=np.zeros((6, width), np.uint8))


def info(stamp: int, focal: float) -> Message:
    return CameraInfo.from_intrinsics(stamp=stamp, frame="c", width=8, height=6, fx=focal, fy=focal, cx=4, cy=3)


def cloud(stamp: int, frame: str) -> Message:
    return PointCloud(stamp=stamp, frame=frame, points=np.zeros((stamp % 5, 3)))


def found(messages: list[Message]) -> list[str]:
    return [f.text for f in lint(MadeInput({"a": messages}), clocks=False).findings if f.check == "publishers"]


@pytest.mark.parametrize(
    "messages",
    [
        [image(s, f"cam{i % 2}") for i, s in enumerate(STAMPS)],
        [image(s, "cam", 8 + 8 * (i % 2)) for i, s in enumerate(STAMPS)],  # both name their frame alike
        [info(s, 50 + 20 * (i % 2)) for i, s in enumerate(STAMPS)],
        [cloud(s, f"lidar{i % 2}") for i, s in enumerate(STAMPS)],
    ],
)
def test_two_devices_on_one_topic_are_named(messages: list[Message]) -> None:
    (text,) = found(messages)

    assert text.startswith("2 devices publish on it by turns: frame '")
    assert text.count("(50)") == 2


def test_one_device_is_sound_also_where_its_settings_change_once() -> None:
    assert found([cloud(s, "lidar") for s in STAMPS]) == []
    assert found([image(s, "cam", 8 if i < 30 else 16) for i, s in enumerate(STAMPS)]) == []
