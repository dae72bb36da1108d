"""Values that cannot be: each is named with the unit that would make sense."""

from __future__ import annotations

import numpy as np
import pytest
from lint_inputs import MadeInput, every

from dataflow.lint.checks import lint
from dataflow.messages import DepthImage, Image16, Imu, LaserScan, Message, NavSatFix, PointCloud


def imu(stamp: int, acceleration: float = 9.81, rate: float = 0.1) -> Imu:
    return Imu(stamp=stamp, frame="imu", angular_velocity=[0, 0, rate], linear_acceleration=[0, 0, acceleration])


def depth(stamp: int, metres: float) -> DepthImage:
    return DepthImage(stamp=stamp, frame="camera", data=np.full((4, 4), metres, np.float32))


def cloud(stamp: int, sweep: float) -> PointCloud:
    offsets = np.linspace(0, sweep, 5, dtype=np.float32)
    return PointCloud(stamp=stamp, frame="lidar", points=np.zeros((5, 3)), time_offsets=offsets)


def fix(stamp: int) -> NavSatFix:
    return NavSatFix(stamp=stamp, frame="gps", latitude=0.0, longitude=0.0, altitude=0.0)


def scan(stamp: int, turn: float) -> LaserScan:
    return LaserScan(stamp=stamp, frame="l", angle_min=-turn, angle_max=turn, ranges=np.ones(9, np.float32))


def sloping(stamp: int, order: str) -> Image16:
    """A slope of 1 a pixel, its bytes in one order or the other."""
    slope = np.arange(1000, 1064, dtype=np.uint16)[None] + np.zeros((4, 1), np.uint16)
    return Image16(stamp=stamp, frame="camera", data=slope.byteswap() if order == ">" else slope)


STAMPS = every(0.1)


@pytest.mark.parametrize(
    ("messages", "told"),
    [
        ([imu(s, 1.0) for s in STAMPS], "in g, and m/s² is wanted"),
        ([imu(s, 1000.0) for s in STAMPS], "in mg"),
        ([imu(s, 0.0) for s in STAMPS], "it is taken out"),
        ([imu(s, rate=40.0) for s in STAMPS], "in degrees"),
        ([depth(s, -1.0) for s in STAMPS], "depths are negative"),
        ([depth(s, 0.0) for s in STAMPS], "no pixel of"),
        ([depth(s, 1500.0) for s in STAMPS], "in millimetres"),
        ([depth(s, 15.0) for s in STAMPS], "with 5000 units a metre it is 3 to 3 m"),
        ([depth(s, 0.25) for s in STAMPS], "if its units were millimetres, it is 1.2 to 1.2 m"),
        ([cloud(s, 1e5) for s in STAMPS], "in µs that would be 0.1 s"),
        ([fix(s) for s in STAMPS], "0° N 0° E"),
        ([cloud(s, 1.0) for s in STAMPS], "measured over 1 s, and a cloud comes every 0.1 s"),
        ([scan(s, 180.0) for s in STAMPS], "span 360 rad, more than a turn: are they in degrees?"),
        ([sloping(s, ">") for s in STAMPS], "two bytes swapped"),
        ([depth(s, 1.0).replace(data=sloping(s, ">").data / np.float32(1000)) for s in STAMPS], "two bytes swapped"),
    ],
)
def test_implausible_quantity_is_reported_with_the_likely_unit(messages: list[Message], told: str) -> None:
    found = [f.text for f in lint(MadeInput({"a": messages})).findings if f.check == "quantity"]

    assert len(found) == 1
    assert told in found[0]


def test_plausible_quantities_are_not_reported() -> None:
    sound = {
        "imu": [imu(s) for s in STAMPS],
        "depth": [depth(s, 2.0) for s in STAMPS],
        "cloud": [cloud(s, 0.1) for s in STAMPS],
        "scan": [scan(s, np.pi) for s in STAMPS],
        "grey": [sloping(s, "<") for s in STAMPS],
        "upper": [sloping(s, "<").replace(data=sloping(s, "<").data << 8) for s in STAMPS],
    }

    assert not [f for f in lint(MadeInput(sound)).findings if f.check in ("quantity", "clocks")]


def test_streams_that_are_decades_apart_are_of_two_clocks() -> None:
    now = 1_700_000_000 * 10**9
    data = MadeInput(
        {"a": [imu(now + s) for s in STAMPS], "b": [imu(now + s) for s in STAMPS], "c": [imu(s) for s in STAMPS]}
    )

    (found,) = [f for f in lint(data).findings if f.check == "clocks"]

    assert (found.stream, found.severity) == ("c", "error")
    assert "53.9 years earlier" in found.text


def test_one_stamp_that_is_decades_off_is_named() -> None:
    now = 1_700_000_000 * 10**9

    found = lint(MadeInput({"a": [imu(0), *(imu(now + s) for s in STAMPS)]})).findings

    assert any(f.check == "clocks" and "some are of another clock" in f.text for f in found)
