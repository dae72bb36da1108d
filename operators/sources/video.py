"""Video as a source: a file, or a camera of this machine or of the network."""

from __future__ import annotations

import glob
import math
import threading
import time
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo, Image, Message
from dataflow.operator import Duration, Out, Param, Source, SourceError
from operators.geometry.calibration_files import CalibrationFileError, read_camera
from operators.sources.pacing import frame_stamp

Pixels = NDArray[np.uint8]
SILENT = 3
"""Reads in a row that give nothing, after which a camera counts as unplugged."""


class CalibratedImages(Source, abstract=True):
    """Holds what a file and a camera have in common: images, and a calibration by the field of view."""

    image: Out[Image] = Out(doc="RGB images")
    image_info: Out[CameraInfo] = Out(static=True, doc="calibration, or a pinhole of the given field of view")

    frame: str = Param("camera_optical", min_length=1, doc="optical frame of the camera")
    fov: float = Param(
        math.radians(60), gt=0, lt=math.pi, unit="rad", doc="horizontal field of view, if not calibrated"
    )
    focal: float | None = Param(None, gt=0, unit="px", doc="focal length from a calibration; none takes `fov`")
    calibration: str | None = Param(
        None, min_length=1, doc="file of `dataflow calibrate` or ROS's camera_calibration; none takes `focal` or `fov`"
    )

    _size: tuple[int, int] = (0, 0)
    _calibrated: CameraInfo | None = None

    def _calibrate(self, bgr: Pixels) -> None:
        """Takes the size of the images, and the calibration from its file. Raises SourceError, FileNotFoundError."""
        self._size = (bgr.shape[1], bgr.shape[0])
        if self.calibration is None:
            return
        try:
            found = read_camera(self.use_file(self.calibration), self.frame)
        except CalibrationFileError as error:
            raise SourceError(str(error)) from error
        if (found.width, found.height) != self._size:
            raise SourceError(
                f"{self.calibration} calibrates images of {found.width}x{found.height} pixels; these have "
                f"{self._size[0]}x{self._size[1]}"
            )
        self._calibrated = found

    @abstractmethod
    def _first_stamp(self) -> int:
        """The stamp of what holds from the beginning."""

    def static_outputs(self) -> Mapping[str, Message]:
        if self._calibrated is not None:
            return {"image_info": self._calibrated.replace(stamp=self._first_stamp())}
        width, height = self._size
        focal = self.focal or width / 2 / math.tan(self.fov / 2)
        info = CameraInfo.from_intrinsics(
            stamp=self._first_stamp(),
            frame=self.frame,
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=(width - 1) / 2,
            cy=(height - 1) / 2,
        )
        return {"image_info": info}

    def _image(self, stamp: int, bgr: Pixels) -> Mapping[str, Message]:
        return {"image": Image(stamp=stamp, frame=self.frame, data=np.ascontiguousarray(bgr[:, :, ::-1]))}


class VideoFile(CalibratedImages):
    """Reads a video file (whatever the installed OpenCV decodes: AVI, MP4, MKV, ...), frame by frame, all of them.

    A frame is stamped `first_stamp` plus its time in the file, at least 1 ns after the one before, or with `rate`, plus
    its number divided by the rate; B-frames come in the order of their times. Which pixels a lossy codec gives may
    depend on the version of OpenCV.
    """

    input: str = Param(min_length=1, doc="the file")
    rate: float | None = Param(None, gt=0, unit="Hz", doc="frames a second, in place of the file's times")
    first_stamp: int = Param(0, ge=0, unit="ns", doc="stamp of the file's beginning")
    start: int = Param(0, ge=0, doc="first frame read")
    stop: int | None = Param(None, ge=1, doc="frame to stop before; none reads to the end")

    def setup(self) -> None:
        """Raises SourceError, FileNotFoundError."""
        path = self.use_file(Path(self.input).expanduser())
        self._video = cv2.VideoCapture(str(path))
        if not self._video.isOpened():
            raise SourceError(f"{path} is no video that OpenCV {cv2.__version__} can decode")
        read, first = self._video.read()
        if not read:
            code = int(self._video.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
            codec = code.to_bytes(4, "little").decode("ascii", "replace").strip("\0 ")
            raise SourceError(
                f"{path} holds no frame that can be decoded; its codec is {codec or 'unknown'}. OpenCV's wheels decode "
                "H.264 and H.265, and no AV1: encode it anew"
            )
        self._calibrate(np.asarray(first, np.uint8))
        self._rate = self.rate or self._video.get(cv2.CAP_PROP_FPS) or 25.0
        self._video.set(cv2.CAP_PROP_POS_FRAMES, 0)

    def stream(self) -> Iterator[Mapping[str, Message]]:
        last = -1
        for number in range(self.stop if self.stop is not None else 2**62):
            read, bgr = self._video.read()
            if not read:
                self._compare(number)
                return
            if number < self.start:
                continue
            stamp = frame_stamp(number, self._rate, self.first_stamp)
            if self.rate is None:
                stamp = max(self.first_stamp + round(self._video.get(cv2.CAP_PROP_POS_MSEC) * 1e6), last + 1)
            last = stamp
            yield self._image(stamp, np.asarray(bgr, np.uint8))

    def _compare(self, came: int) -> None:
        """Warns where a file that counts its frames (MP4, AVI) has given fewer."""
        promised = int(self._video.get(cv2.CAP_PROP_FRAME_COUNT))
        with Path(self.input).expanduser().open("rb") as file:
            head = file.read(8)
        if came < promised and (head.startswith(b"RIFF") or head[4:] == b"ftyp"):
            self.log.warning("%s states %s frames, and %s can be decoded", self.input, f"{promised:,}", f"{came:,}")

    def close(self) -> None:
        if hasattr(self, "_video"):
            self._video.release()

    def _first_stamp(self) -> int:
        return self.first_stamp


SET_BACK = 100_000_000
"""Nanoseconds from which on a clock that is behind the last stamp was set back: stamps go on from there, as live runs
allow. Of less, images are left out until the clock is ahead again."""


class Webcam(CalibratedImages):
    """Reads a camera: of this machine by its number or device file, of the network by its address (RTSP, HTTP).

    An image is stamped when it has arrived, less `latency`. A camera that is unplugged, or gives nothing any more, is
    looked for again every `retry` until it is back; meanwhile there are no images, and what takes them finds them
    stale. One that comes back with images of another size ends the source with an error, as their calibration would be
    wrong: a `restart` policy begins anew.
    """

    real_time = True

    _unplugged, _past = 0, 0

    input: str = Param("0", min_length=1, doc="number, device file or address of the camera")
    width: int | None = Param(None, ge=1, unit="px", doc="width to ask for; the camera may give another")
    height: int | None = Param(None, ge=1, unit="px", doc="height to ask for")
    rate: float | None = Param(None, gt=0, unit="Hz", doc="images a second to ask for")
    latency: Duration = Param(
        "0s", ge=0, doc="time from the exposure to the arrival, as `dataflow calibrate camera-imu` finds"
    )
    retry: Duration = Param("1s", ge=10_000_000, doc="pause between two looks for a camera that is gone")

    def setup(self) -> None:
        """Raises SourceError where there is no camera, or it gives no image."""
        self._stopped = threading.Event()
        self._camera = self._open()
        if self._camera is None:
            raise SourceError(f"camera {self.input!r} does not open; {_cameras()}")
        bgr = self._read()
        if bgr is None:
            raise SourceError(f"camera {self.input!r} gives no image: another program may be using it")
        self._calibrate(bgr)

    def stream(self) -> Iterator[Mapping[str, Message]]:
        last = 0
        while not self._stopped.is_set():
            bgr = self._read()
            stamp = time.time_ns() - self.latency
            if bgr is None:
                self._look_for_it()
            elif stamp > last or last - stamp > SET_BACK:
                last = stamp
                yield self._image(stamp, np.asarray(bgr, np.uint8))
            else:
                self._past += 1

    def stop_reading(self) -> None:
        self._stopped.set()

    def summary(self) -> Mapping[str, int | str]:
        return {"clock": "machine", "unplugged": self._unplugged, "past": self._past}

    def close(self) -> None:
        camera: cv2.VideoCapture | None = getattr(self, "_camera", None)
        if camera is not None:
            camera.release()

    def _first_stamp(self) -> int:
        return time.time_ns()

    def _open(self) -> cv2.VideoCapture | None:
        camera = cv2.VideoCapture(int(self.input) if self.input.isdecimal() else self.input)
        if not camera.isOpened():
            camera.release()
            return None
        camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest image, not one that has waited
        for key, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, self.width),
            (cv2.CAP_PROP_FRAME_HEIGHT, self.height),
            (cv2.CAP_PROP_FPS, self.rate),
        ):
            if value is not None:
                camera.set(key, value)
        return camera

    def _read(self) -> Pixels | None:
        """The next image; None when the camera gives nothing several times in a row."""
        for _ in range(SILENT):
            if self._camera is None or self._stopped.is_set():
                return None
            read, bgr = self._camera.read()
            if read and bgr is not None:
                return np.asarray(bgr, np.uint8)
        return None

    def _look_for_it(self) -> None:
        """Waits until the camera is back, or the run ends. Raises SourceError for images of another size."""
        if self._stopped.is_set():
            return
        self._unplugged += 1
        self.log.warning("camera %s gives no image any more: looking for it every %g s", self.input, self.retry * 1e-9)
        self.close()
        self._camera = None
        while not self._stopped.wait(self.retry * 1e-9):
            self._camera = self._open()
            bgr = self._read()
            if bgr is None:
                self.close()
                self._camera = None
                continue
            if (bgr.shape[1], bgr.shape[0]) != self._size:
                raise SourceError(
                    f"camera {self.input!r} came back with {bgr.shape[1]}x{bgr.shape[0]} pixels instead of "
                    f"{self._size[0]}x{self._size[1]}"
                )
            self.log.info("camera %s is back", self.input)
            return


def _cameras() -> str:
    found = sorted(glob.glob("/dev/video*"))
    return f"this machine has {', '.join(found)}" if found else "this machine has no camera (/dev/video*)"
