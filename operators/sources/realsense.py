"""Intel RealSense cameras: depth and colour with their calibrations, by pyrealsense2."""

from __future__ import annotations

import ctypes
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Image, Message, Transforms
from dataflow.operator import Out, Param, Source, SourceError
from operators.sources.ports import LONGEST_PAUSE, SHORTEST_PAUSE

SILENCE = 5.0
"""Seconds without depth and colour of one moment after which a camera counts as unplugged: one may start late."""
WAITING = 8
"""Images that wait for their partner; the oldest beyond them has none."""
POLL = 200
"""Milliseconds after which a wait for frames looks whether the run has ended."""
MODELS = {"brown_conrady": "plumb_bob", "modified_brown_conrady": "plumb_bob", "kannala_brandt4": "equidistant"}
"""Distortion models by the library's names; others keep them."""


class RealSense(Source):
    """Reads depth and colour of an Intel RealSense camera, with the calibrations that it holds.

    Frames are stamped by the camera's clock, which the library relates to the machine's (global time); where it cannot,
    by the machine's clock at their arrival. The summary names which. Depth and colour of one moment, at most half a
    period apart, come together, each with its own stamp. A camera that is unplugged is looked for after 0.1 s, then
    after pauses doubled up to 5 s, and counted. Needs the extra `[realsense]`.
    """

    real_time = True

    image: Out[Image] = Out(doc="colour images")
    depth: Out[DepthImage] = Out(doc="depth, not registered to the colour image")
    image_info: Out[CameraInfo] = Out(static=True, doc="calibration of the colour camera")
    depth_info: Out[CameraInfo] = Out(static=True, doc="calibration of the depth camera")
    extrinsics: Out[Transforms] = Out(static=True, doc="the colour camera in the depth camera's frame")

    serial: str = Param("", doc="serial number; empty takes the first camera, and that one again after it was gone")
    width: int = Param(640, ge=1, unit="px", doc="width of both images")
    height: int = Param(480, ge=1, unit="px", doc="height of both images")
    rate: int = Param(30, ge=1, unit="Hz", doc="images a second")
    image_frame: str = Param("camera_color_optical", min_length=1, doc="optical frame of the colour camera")
    depth_frame: str = Param("camera_depth_optical", min_length=1, doc="optical frame of the depth camera")

    _unplugged, _single, _domain = 0, 0, "none"
    _sensors: tuple[Any, ...] = ()
    _serial = ""

    def setup(self) -> None:
        """Raises SourceError where the package, the camera or a mode is not there."""
        self._rs, self._stopped, self._serial = _library(), threading.Event(), self.serial
        self._open()

    def static_outputs(self) -> Mapping[str, Message]:
        color, depth = self._profiles
        turn = color.get_extrinsics_to(depth)
        T_depth_image = np.eye(4)
        T_depth_image[:3, :3] = np.array(turn.rotation).reshape(3, 3).T  # by columns
        T_depth_image[:3, 3] = turn.translation
        return {
            "image_info": self._info(color, self.image_frame),
            "depth_info": self._info(depth, self.depth_frame),
            "extrinsics": Transforms.from_matrix(
                T_depth_image, stamp=self._began, frame=self.depth_frame, child_frame=self.image_frame
            ),
        }

    def stream(self) -> Iterator[Mapping[str, Message]]:
        last = time.monotonic()
        while not self._stopped.is_set():
            there, frame = self._queue.try_wait_for_frame(POLL)
            for step in self._paired(frame) if there else ():
                yield step
                last = time.monotonic()
            if time.monotonic() - last > SILENCE:
                self._look_for_it()
                last = time.monotonic()

    def stop_reading(self) -> None:
        self._stopped.set()

    def close(self) -> None:
        for end in (end for sensor in self._sensors for end in (sensor.stop, sensor.close)):
            try:
                end()
            except RuntimeError as error:  # it is gone, or has not started
                self.log.debug("sensor of RealSense %s: %s", self._serial, error)
        self._sensors = ()

    def summary(self) -> Mapping[str, int | str]:
        return {"clock": self._domain, "without_partner": self._single, "unplugged": self._unplugged}

    def _devices(self) -> list[Any]:
        return list(self._rs.context().query_devices())

    def _device(self) -> Any:
        """The camera; from then on no other. Raises SourceError."""
        there = {device.get_info(self._rs.camera_info.serial_number): device for device in self._devices()}
        for serial, device in there.items():
            if self._serial in ("", serial):
                self._serial = serial
                return device
        raise SourceError(f"no RealSense camera {self._serial}".strip() + f"; there are {', '.join(there) or 'none'}")

    def _open(self) -> None:
        """Starts both cameras. Raises SourceError."""
        rs = self._rs
        wanted = ((rs.stream.color, rs.format.rgb8), (rs.stream.depth, rs.format.z16))
        self._queue = rs.frame_queue(2 * self.rate, keep_frames=True)
        self._waiting: tuple[deque[Any], deque[Any]] = (deque(), deque())
        self._began = time.time_ns()
        try:  # each call of the library fails for a camera that is unplugged meanwhile
            sensors = list(self._device().query_sensors())
            found = [self._profile(sensors, *each) for each in wanted]
            for sensor in {id(sensor): sensor for sensor, _ in found}.values():
                sensor.open([profile for each, profile in found if each is sensor])
                self._sensors = (*self._sensors, sensor)
                sensor.start(self._queue)
            self._profiles = tuple(profile.as_video_stream_profile() for _, profile in found)
        except RuntimeError as error:
            self.close()
            raise SourceError(f"the RealSense camera does not start: {error}") from error

    def _profile(self, sensors: list[Any], stream: Any, form: Any) -> tuple[Any, Any]:
        """The sensor that has a stream, and its mode. Raises SourceError."""
        modes = []
        for sensor in sensors:
            for profile in sensor.get_stream_profiles():
                video = profile.as_video_stream_profile() if profile.is_video_stream_profile() else None
                if video is None or profile.stream_type() != stream or profile.format() != form:
                    continue
                modes.append((video.width(), video.height(), profile.fps()))
                if modes[-1] == (self.width, self.height, self.rate):
                    return sensor, profile
        listed = ", ".join(f"{w}x{h} at {fps} Hz" for w, h, fps in sorted(set(modes)))
        raise SourceError(
            f"the RealSense camera has no {stream.name} of {self.width}x{self.height} at {self.rate} Hz; it has "
            f"{listed or 'none'}"
        )

    def _paired(self, frame: Any) -> Iterator[Mapping[str, Message]]:
        """Yields depth and colour of one moment once both are there."""
        depth = bool(frame.is_depth_frame())
        self._waiting[depth].append((self._stamp(frame), frame))
        colors, depths = self._waiting
        while colors and depths:
            apart = colors[0][0] - depths[0][0]
            if abs(apart) > 500_000_000 // self.rate:
                (depths if apart > 0 else colors).popleft()
                self._single += 1
                continue
            (color_stamp, color), (depth_stamp, far) = colors.popleft(), depths.popleft()
            metres = np.asarray(far.get_data()).astype(np.float32) * np.float32(far.as_depth_frame().get_units())
            yield {
                "image": Image(stamp=color_stamp, frame=self.image_frame, data=np.asarray(color.get_data())),
                "depth": DepthImage(stamp=depth_stamp, frame=self.depth_frame, data=metres),
            }
        if len(colors) + len(depths) > WAITING:
            (colors or depths).popleft()
            self._single += 1

    def _stamp(self, frame: Any) -> int:
        known = frame.frame_timestamp_domain != self._rs.timestamp_domain.hardware_clock
        self._domain = frame.frame_timestamp_domain.name if known else "machine"
        return round(frame.timestamp * 1e6) if known else time.time_ns()

    def _info(self, profile: Any, frame: str) -> CameraInfo:
        found = profile.intrinsics
        bent = any(found.coeffs)
        model = MODELS.get(found.model.name, found.model.name) if bent else "none"
        return CameraInfo.from_intrinsics(
            stamp=self._began, frame=frame, width=found.width, height=found.height, fx=found.fx, fy=found.fy,
            cx=found.ppx, cy=found.ppy, distortion_model=model,
            distortion=(found.coeffs[:4] if model == "equidistant" else found.coeffs) if bent else None,
        )  # fmt: skip

    def _look_for_it(self) -> None:
        """Waits until the camera is back, or the run ends."""
        self._unplugged += 1
        self.log.warning("the RealSense camera gives no pair of images any more: it is looked for")
        self.close()
        pause = SHORTEST_PAUSE
        while not self._stopped.wait(pause):
            try:
                self._open()
            except SourceError:
                pause = min(2 * pause, LONGEST_PAUSE)
            else:
                self.log.info("the RealSense camera is back")
                return


def _library() -> Any:
    """The package pyrealsense2; it needs libusb, which the system or another package has. Raises SourceError."""
    try:
        try:
            import pyrealsense2
        except ImportError as error:
            if isinstance(error, ModuleNotFoundError):
                raise
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
            import pyrealsense2
    except ImportError as error:
        raise SourceError(
            f"RealSense cameras need pyrealsense2 ({error}): pip install 'robot-dataflow[realsense]'"
        ) from error
    return pyrealsense2
