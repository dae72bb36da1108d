"""Readings and poses that cannot be are named with the unit that would make sense."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from lint_inputs import MadeInput, every

from dataflow.lint.readings import check_readings
from dataflow.messages import CompressedImage, MagneticField, Measurement, Message, Odometry, Pose

STAMPS = every(0.1)


def field(stamp: int, strength: float) -> MagneticField:
    return MagneticField(stamp=stamp, frame="imu", field=[0.4 * strength, 0, 0.9 * strength])


def pose(stamp: int, x: float) -> Pose:
    return Pose(stamp=stamp, frame="map", position=[x, 0, 0], orientation=[0, 0, 0, 1])


def measured(stamp: int, value: float, unit: str) -> Measurement:
    return Measurement(stamp=stamp, frame="box", value=value, unit=unit)


def odometry(stamp: int, speed: float) -> Odometry:
    place = {"position": [0, 0, 0], "orientation": [0, 0, 0, 1], "linear": [speed, 0, 0], "angular": [0, 0, 0]}
    return Odometry(stamp=stamp, frame="odom", child_frame="base", **place)


JPEG = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8))[1]


def encoded(stamp: int, length: int) -> CompressedImage:
    return CompressedImage(stamp=stamp, frame="c", format="jpeg", data=JPEG[:length])


Make = Callable[[int, int], Message]


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda k, s: field(s, 48.0), "it is in µT, and tesla are wanted"),
        (lambda k, s: field(s, 0.48), "it is in gauss, and tesla are wanted"),
        (lambda k, s: field(s, 48e-6), ""),
        (lambda k, s: measured(s, 45.0, ""), "it is in percent"),
        (lambda k, s: measured(s, 0.45, ""), ""),
        (lambda k, s: measured(s, 1013.2, "Pa"), "it is in hPa"),
        (lambda k, s: measured(s, 101.3, "Pa"), "it is in kPa"),
        (lambda k, s: measured(s, 101_320.0, "Pa"), ""),
        (lambda k, s: measured(s, 295.0, "°C"), "is it in kelvin?"),
        (lambda k, s: measured(s, 21.0, "°C"), ""),
        (lambda k, s: pose(s, 500.0 * k), "positions move at 5e+03 m/s: are they in millimetres?"),
        (lambda k, s: pose(s, 1e300 if k == 4 else 0.1 * k), "positions jump 2 times faster than 1000 m/s"),
        (lambda k, s: pose(s, float("nan") if k == 3 else 0.1 * k), "messages hold numbers that are not finite"),
        (lambda k, s: odometry(s, float("inf") if k % 2 else 1.0), "messages hold numbers that are not finite"),
        (lambda k, s: pose(s, 3.0 * k), ""),
        (lambda k, s: encoded(s, 300 if k % 10 == 0 else len(JPEG)), "images cannot be decoded, the first: at"),
        (lambda k, s: encoded(s, len(JPEG) - 2), "images cannot be decoded, the first: at"),
        (lambda k, s: encoded(s, len(JPEG)), ""),
    ],
)
def test_readings_that_cannot_be_are_named(make: Make, told: str) -> None:
    data = MadeInput({"s": [make(k, s) for k, s in enumerate(STAMPS)]})

    found = [finding.text for finding in check_readings(data)]

    assert [told in text for text in found] == ([True] if told else [])


def test_a_velocity_that_is_not_given_is_no_reading() -> None:
    still = [
        Odometry(stamp=t, frame="odom", child_frame="base", position=[0, 0, 0], orientation=[0, 0, 0, 1])
        for t in STAMPS
    ]
    assert still[0].linear is None
    assert list(check_readings(MadeInput({"/odom": still}))) == []
