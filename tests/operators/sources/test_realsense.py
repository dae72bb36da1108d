"""A RealSense camera that the library's own software device stands in for."""

from __future__ import annotations

import importlib.util
import sys
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from dataflow.messages import CameraInfo, DepthImage, Image, Transforms
from dataflow.operator import SourceError
from operators.sources import RealSense, realsense

WIDTH, HEIGHT, RATE = 64, 48, 30
START = 1_700_000_000_000
"""Milliseconds."""

need = pytest.mark.skipif(not importlib.util.find_spec("pyrealsense2"), reason="needs the extra [realsense]")


class Made:
    """A camera with a colour and a depth sensor."""

    def __init__(self, serial: str = "12") -> None:
        self.rs = rs = realsense._library()
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, serial)
        self.depth_sensor, self.color_sensor = self.device.add_sensor("Stereo"), self.device.add_sensor("RGB")
        self.depth = self.depth_sensor.add_video_stream(self._mode(rs.stream.depth, 1, rs.format.z16, 2, 0.0))
        self.color = self.color_sensor.add_video_stream(self._mode(rs.stream.color, 2, rs.format.rgb8, 3, 0.1))
        self.depth_sensor.add_read_only_option(rs.option.depth_units, 0.001)
        place = rs.extrinsics()
        place.rotation, place.translation = [0, 1, 0, -1, 0, 0, 0, 0, 1], [0.015, 0.0, 0.0]
        self.color.register_extrinsics_to(self.depth, place)

    def _mode(self, stream: Any, uid: int, form: Any, size: int, bent: float) -> Any:
        found, lens = self.rs.video_stream(), self.rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = WIDTH, HEIGHT, 60 + uid, 61, 31.5, 23.5
        lens.model, lens.coeffs = self.rs.distortion.brown_conrady, [bent, 0, 0, 0, 0]
        found.type, found.index, found.uid, found.fmt, found.bpp = stream, 0, uid, form, size
        found.width, found.height, found.fps, found.intrinsics = WIDTH, HEIGHT, RATE, lens
        return found

    def send(self, number: int, *, depth: bool, late: float = 0.0, domain: str = "global_time") -> None:
        frame, rs = self.rs.software_video_frame(), self.rs
        frame.bpp = 2 if depth else 3
        frame.stride = WIDTH * frame.bpp
        frame.pixels = (
            np.full((HEIGHT, WIDTH), 1000 + number, np.uint16)
            if depth
            else np.full((HEIGHT, WIDTH, 3), number, np.uint8)
        )
        frame.timestamp, frame.frame_number = START + number * 1000 / RATE + late, number
        frame.domain = getattr(rs.timestamp_domain, domain)
        frame.profile = (self.depth if depth else self.color).as_video_stream_profile()
        if depth:
            frame.depth_units = 0.001
        (self.depth_sensor if depth else self.color_sensor).on_video_frame(frame)


class Camera(RealSense):
    """A source whose camera is made; looks find one after another, None is none."""

    made: list[Made | None]

    def _devices(self) -> list[Any]:
        found = self.made.pop(0)
        return [] if found is None else [found.device]


def camera(*made: Made | None, **params: int) -> Camera:
    source = Camera(**{"width": WIDTH, "height": HEIGHT, "rate": RATE, **params})
    source.made = list(made)
    return source


@need
def test_depth_and_colour_of_one_moment_come_together_with_the_cameras_stamps() -> None:
    made = Made()
    source = camera(made)
    source.setup()
    made.send(0, depth=False)  # its depth image was lost
    for number in (1, 2):
        made.send(number, depth=True)
        made.send(number, depth=False, late=3.0)
    steps = source.stream()
    found = [next(steps) for _ in range(2)]
    source.close()

    for number, step in enumerate(found, 1):
        image, depth = step["image"], step["depth"]
        assert isinstance(image, Image)
        assert isinstance(depth, DepthImage)
        assert depth.stamp == pytest.approx((START + number * 1000 / RATE) * 1e6, abs=1000)
        assert image.stamp - depth.stamp == pytest.approx(3_000_000, abs=1000)
        assert (image.data == number).all()
        assert depth.data == pytest.approx(1.0 + 0.001 * number)
    assert source.summary() == {"clock": "global_time", "without_partner": 1, "unplugged": 0}


@need
def test_calibrations_are_those_of_the_camera() -> None:
    source = camera(Made())
    source.setup()
    found = source.static_outputs()
    source.close()
    color, depth, place = (found[name] for name in ("image_info", "depth_info", "extrinsics"))

    assert isinstance(color, CameraInfo)
    assert isinstance(depth, CameraInfo)
    assert isinstance(place, Transforms)
    assert (color.fx, color.fy, color.cx, color.cy) == (62, 61, 31.5, 23.5)
    assert (color.distortion_model, depth.distortion_model) == ("plumb_bob", "none")
    assert color.distortion == pytest.approx([0.1, 0, 0, 0, 0])
    assert (place.frames, place.child_frames) == (("camera_depth_optical",), ("camera_color_optical",))
    assert place.translations[0] == pytest.approx([0.015, 0, 0])
    assert np.abs(place.rotations[0]) == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    assert place.rotations[0][2] * place.rotations[0][3] > 0  # the library's columns: a quarter turn from x to y


@need
def test_a_clock_of_the_cameras_own_gives_way_to_the_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Made()
    source = camera(made)
    source.setup()
    monkeypatch.setattr("operators.sources.realsense.time.time_ns", lambda: 5 * 10**18)
    for depth in (True, False):
        made.send(1, depth=depth, domain="hardware_clock")
    step = next(source.stream())
    source.close()

    assert (step["image"].stamp, source.summary()["clock"]) == (5 * 10**18, "machine")


@need
def test_a_camera_that_is_unplugged_goes_on_when_it_is_back(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(realsense, "SILENCE", -1.0)
    monkeypatch.setattr(realsense, "POLL", 1)
    first, second = Made(), Made()
    source = camera(first, None, Made("another"), second)
    pauses: list[float] = []
    source.setup()

    def wait(seconds: float) -> bool:
        pauses.append(seconds)
        return False

    monkeypatch.setattr(source._stopped, "wait", wait)
    began = source._open

    def opened() -> None:
        began()
        monkeypatch.setattr(realsense, "SILENCE", 60.0)
        for depth in (True, False):
            second.send(9, depth=depth)

    monkeypatch.setattr(source, "_open", opened)
    step = next(source.stream())
    source.close()

    assert isinstance(step["image"], Image)
    assert (step["image"].data == 9).all()
    assert pauses == [0.1, 0.2, 0.4]
    assert source.summary()["unplugged"] == 1
    assert [r.getMessage() for r in caplog.records if r.levelname == "WARNING"] == [
        "the RealSense camera gives no pair of images any more: it is looked for"
    ]


@need
def test_a_camera_whose_colour_stops_is_looked_for_and_its_depth_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Made()
    source = camera(made, Made())
    source.setup()
    for number in range(50):
        made.send(number, depth=True)
    steps = source.stream()
    looks: list[int] = []

    def look() -> None:
        looks.append(max(map(len, source._waiting)))
        source.stop_reading()

    monkeypatch.setattr(source, "_look_for_it", look)
    now = iter(range(100))
    monkeypatch.setattr("operators.sources.realsense.time.monotonic", lambda: next(now))
    monkeypatch.setattr(realsense, "SILENCE", 30.0)
    assert not list(steps)
    source.close()

    assert looks == [realsense.WAITING]
    assert source.summary()["without_partner"] == 31 - realsense.WAITING


@need
@pytest.mark.parametrize("call", ["get_info", "query_sensors", "open", "start"])
def test_a_camera_that_is_unplugged_while_it_is_opened_is_looked_for_again(
    call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, device, sensor = camera(), Mock(), Mock()
    device.get_info.return_value, device.query_sensors.return_value = "12", [sensor]
    sensor.stop.side_effect = RuntimeError("it is not streaming")
    getattr(device if hasattr(type(Made().device), call) else sensor, call).side_effect = RuntimeError("no such device")
    source._rs = realsense._library()
    monkeypatch.setattr(source, "_devices", lambda: [device])
    monkeypatch.setattr(source, "_profile", lambda *_: (sensor, Mock()))
    with pytest.raises(SourceError, match="does not start: no such device"):
        source._open()

    assert sensor.close.called == (call == "start")
    assert source._sensors == ()


@need
def test_modes_and_cameras_that_are_not_there_are_named() -> None:
    with pytest.raises(SourceError, match="no color of 640x48 at 30 Hz; it has 64x48 at 30 Hz"):
        camera(Made(), width=640).setup()
    with pytest.raises(SourceError, match="no RealSense camera 7; there are none"):
        RealSense(serial="7").setup()


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(SourceError, match=r"pip install 'robot-dataflow\[realsense\]'"):
        RealSense().setup()
