"""Calibrations that are not those of the images beside them are named."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
from lint_inputs import MadeInput, every

from dataflow.lint.checks import lint
from dataflow.messages import CameraInfo, CompressedImage, Image, Message

STAMPS = every(0.1)


def images(frame: str, width: int, height: int) -> list[Message]:
    return [Image(stamp=s, frame=frame, data=np.zeros((height, width, 3), np.uint8)) for s in STAMPS]


def files(frame: str, width: int, height: int) -> list[Message]:
    data = cv2.imencode(".png", np.zeros((height, width, 3), np.uint8))[1]
    return [CompressedImage(stamp=s, frame=frame, format="png", data=data.ravel()) for s in STAMPS]


def info(frame: str, width: int, height: int, cx: float = 30, cy: float = 20) -> list[Message]:
    made = CameraInfo.from_intrinsics(
        stamp=STAMPS[0], frame=frame, width=width, height=height, fx=50, fy=50, cx=cx, cy=cy
    )
    return [made]


@pytest.mark.parametrize(
    ("streams", "stream", "told"),
    [
        ({"image": images("c", 64, 48), "info": info("c", 128, 96)}, "image", "64x48 pixels, .* info of 128x96"),
        ({"image": images("c", 64, 48), "info": info("c", 64, 48, 320, 240)}, "info", r"\(320, 240\) lies outside"),
        (  # two cameras that call themselves the same
            {"left": images("c", 64, 48), "right": images("c", 80, 60), "info": info("c", 64, 48)},
            "right",
            "80x60 pixels",
        ),
        ({"c/image": files("c", 64, 48), "c/info": info("c", 128, 96)}, "c/image", "64x48 pixels, .* c/info of 128x96"),
        (
            {"c/image": images("c", 64, 48), "c/camera_info": info("d", 64, 48)},
            "c/image",
            "of frame 'c', and c/camera_info is the calibration of frame 'd'",
        ),
    ],
)
def test_a_calibration_of_other_images_is_named(streams: dict[str, list[Message]], stream: str, told: str) -> None:
    found = [f for f in lint(MadeInput(streams), clocks=False).findings if f.check == "calibration"]

    assert [f.stream for f in found] == [stream]
    assert re.search(told, found[0].text)


def test_calibrations_of_all_sizes_of_a_camera_and_of_other_cameras_are_right() -> None:
    streams = {
        "image": images("c", 64, 48),
        "small": images("c", 32, 24),
        "info": info("c", 64, 48),
        "small_info": info("c", 32, 24, 16, 12),
        "other": images("d", 16, 12),
    }

    assert not [f for f in lint(MadeInput(streams), clocks=False).findings if f.check == "calibration"]
