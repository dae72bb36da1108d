"""RGB-D datasets on disk as a source."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo, DepthImage, Image, Message, Pose, Transforms
from dataflow.messages.depth_units import FIFTHS, INVALID, MILLIMETRES, DepthSpan
from dataflow.messages.geometry import normalize
from dataflow.operator import Out, Param, Source, SourceError
from operators.passed_over import PassedOver
from operators.sources.rgbd_layouts import Frame, Intrinsics, Place, detect_layout, list_7scenes, list_tum

Size = tuple[int, int]

_PROBED = 12
"""Depth images, evenly spread over the folder, that show its unit."""
_IDENTITY: Place = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class RgbdFolder(Source):
    """Reads a folder of RGB-D frames in the 7-Scenes or the TUM RGB-D layout.

    Image and depth of a frame carry one stamp: the colour image's in TUM, first_stamp + N / rate for frame N of
    7-Scenes, exact in nanoseconds and the same for any start, stop and stride. Ground truth is the depth camera's pose
    and absent at frames that have none. A frame whose files are missing, cannot be decoded or have another size than
    the first is passed over with a warning, and so is a pose that is none and a line of a list that cannot be read.
    Colour images of TUM's layout without depth within 20 ms are counted.

    Without `depth_scale`, a unit is the layout's, unless depth images from all over the folder show that it is the
    other common one: a depth camera sees little that is nearer than 0.3 m or farther than 10 m. That is logged as a
    warning, and so is doubt.
    """

    image: Out[Image] = Out(doc="colour")
    depth: Out[DepthImage] = Out(doc="depth, metres; 0 where there was no return or it lies beyond max_depth")
    image_info: Out[CameraInfo] = Out(static=True, doc="calibration of the colour camera")
    depth_info: Out[CameraInfo] = Out(static=True, doc="calibration of the depth camera")
    extrinsics: Out[Transforms] = Out(
        static=True, doc="the colour camera in the depth camera's frame, and that on its base if its place is given"
    )
    ground_truth: Out[Pose] = Out(doc="T_world_camera of the depth camera")

    path: str = Param(doc="folder of the dataset")
    layout: Literal["auto", "7scenes", "tum"] = Param("auto", doc="how the files lie")
    rate: float = Param(30.0, gt=0, doc="frames a second where the layout has no stamps (7-Scenes)", unit="Hz")
    first_stamp: int = Param(0, ge=0, doc="stamp of frame 0 where the layout has no stamps (7-Scenes)", unit="ns")
    start: int = Param(0, ge=0, doc="first frame read, counted in the folder")
    stop: int | None = Param(None, ge=1, doc="frame to stop before; none reads to the end")
    stride: int = Param(1, ge=1, doc="read every stride-th frame")
    depth_scale: float | None = Param(
        None,
        gt=0,
        doc="units of the depth images: how many a metre has (1000: millimetres); none takes the layout's (7-Scenes: "
        "1000, TUM: 5000) or the other of these, whichever the values show",
        unit="1/m",
    )
    registered: bool | None = Param(
        None,
        doc="depth lies on the pixels of the colour image, as if one camera took both; none is as in the layout "
        "(7-Scenes: false, TUM: true)",
    )
    max_depth: float = Param(6.0, gt=0, doc="larger depths are taken as no return", unit="m")
    image_intrinsics: tuple[float, float, float, float] | None = Param(
        None,
        doc="fx, fy, cx, cy of the colour camera instead of the layout's (7-Scenes: 525 px, for its intrinsics file "
        "describes the depth camera only)",
        unit="px",
    )
    depth_intrinsics: tuple[float, float, float, float] | None = Param(
        None, doc="fx, fy, cx, cy of the depth camera instead of the folder's camera-intrinsics.txt", unit="px"
    )
    T_depth_image: Place | None = Param(
        None,
        doc="x, y, z, qx, qy, qz, qw of the colour camera in the depth camera's frame instead of the layout's "
        "(7-Scenes: 2.5 cm to the right, as a Kinect v1 is built; TUM: none, for its depth is registered)",
        unit="m",
    )
    T_base_depth: Place | None = Param(
        None,
        doc="x, y, z, qx, qy, qz, qw of the depth camera on what carries it, z up; none leaves the base out",
        unit="m",
    )
    strict: bool = Param(False, doc="what cannot be read is an error, instead of being passed over and counted")
    base_frame: str = Param("base_link", min_length=1, doc="frame of what carries the camera")
    world_frame: str = Param("world", min_length=1, doc="frame of the ground truth")
    image_frame: str = Param("camera_color_optical", min_length=1, doc="optical frame of the colour camera")
    depth_frame: str = Param("camera_depth_optical", min_length=1, doc="optical frame of the depth camera")

    def setup(self) -> None:
        """Raises SourceError for a folder, list, calibration or parameter that cannot be used."""
        if self.image_frame == self.depth_frame:
            raise SourceError(f"image_frame and depth_frame must differ, both are {self.image_frame!r}")
        folder = Path(self.path).expanduser()
        self._passed = PassedOver(self.log, strict=self.strict)
        layout = detect_layout(folder) if self.layout == "auto" else self.layout
        self._dataset = list_tum(folder) if layout == "tum" else list_7scenes(folder, self.rate, self.first_stamp)
        for reason in self._dataset.lacking:
            self._passed.take(SourceError(reason))
        self._frames = [f for f in self._dataset.frames[self.start : self.stop : self.stride] if self._is_there(f)]
        if not self._frames:
            raise SourceError(
                f"{folder} has {len(self._dataset.frames)} frames: start={self.start}, stop={self.stop}, "
                f"stride={self.stride} leaves none"
            )
        if (folder / "camera-intrinsics.txt").is_file():
            self.use_file(folder / "camera-intrinsics.txt")
        self._image_size, self._depth_size = self._passed.first(
            self._frames, lambda frame: (_size(read_color(frame)), _size(read_depth(frame)))
        )
        self._place = self._placed()
        self._image_camera, self._depth_camera = self._cameras()
        self._scale = self._dataset.depth_scale if self.depth_scale is None else self.depth_scale
        if self.depth_scale is None:
            self._scale = self._probed(self._scale)

    def _is_there(self, frame: Frame) -> bool:
        missing = next((file for file in (frame.image, frame.depth) if not file.is_file()), None)
        if missing is not None:
            self._passed.take(SourceError(f"frame {frame.name}: no file {missing}"))
        return missing is None

    def static_outputs(self) -> Mapping[str, Message]:
        stamp = self._frames[0].stamp
        places = {(self.depth_frame, self.image_frame): _transform("T_depth_image", self._place)}
        if self.T_base_depth is not None:
            places = {(self.base_frame, self.depth_frame): _transform("T_base_depth", self.T_base_depth), **places}
        return {
            "image_info": _info(stamp, self.image_frame, self._image_size, self._image_camera),
            "depth_info": _info(stamp, self.depth_frame, self._depth_size, self._depth_camera),
            "extrinsics": Transforms(
                stamp=stamp,
                frames=tuple(frame for frame, _ in places),
                child_frames=tuple(child for _, child in places),
                translations=np.array([place[0] for place in places.values()]),
                rotations=np.array([place[1] for place in places.values()]),
            ),
        }

    def stream(self) -> Iterator[Mapping[str, Message]]:
        """Raises SourceError that names the frame and file where it is strict and one cannot be read."""
        for frame in self._frames:
            try:
                color, raw = read_color(frame), read_depth(frame)
                self._check_size(frame, frame.image, _size(color), self._image_size)
                self._check_size(frame, frame.depth, _size(raw), self._depth_size)
            except SourceError as error:
                self._passed.take(error)
                continue
            depth = depth_in_metres(raw, self._scale, self.max_depth)
            messages: dict[str, Message] = {
                "image": Image(stamp=frame.stamp, frame=self.image_frame, data=color),
                "depth": DepthImage(stamp=frame.stamp, frame=self.depth_frame, data=depth),
            }
            try:
                T = frame.T_world_camera()
            except SourceError as error:
                self._passed.take(error)
                T = None
            if T is not None:
                messages["ground_truth"] = Pose.from_matrix(
                    T, stamp=frame.stamp, frame=self.world_frame, child_frame=self.depth_frame
                )
            yield messages

    def length(self) -> int | None:
        return len(self._frames) if hasattr(self, "_frames") else None

    def summary(self) -> Mapping[str, int]:
        unpaired = {"without_depth": self._dataset.unpaired} if self._dataset.unpaired else {}
        return {"passed_over": self._passed.number, **unpaired}

    @property
    def _registered(self) -> bool:
        return self._dataset.registered if self.registered is None else self.registered

    def _placed(self) -> Place:
        """T_depth_image."""
        if self.registered and self.T_depth_image is not None:
            raise SourceError("registered: true and T_depth_image exclude each other: registered depth has its place")
        if self.T_depth_image is not None:
            return self.T_depth_image
        if self._registered:
            return _IDENTITY
        if self._dataset.T_depth_image is None:
            raise SourceError("registered: false needs T_depth_image, the place of the colour camera at the depth one")
        return self._dataset.T_depth_image

    def _cameras(self) -> tuple[Intrinsics, Intrinsics]:
        """Those of colour and of depth, which are one where depth is registered."""
        data = self._dataset
        if not self._registered or (self.image_intrinsics and self.depth_intrinsics):
            image = Intrinsics(*self.image_intrinsics) if self.image_intrinsics else data.image_intrinsics
            return image, Intrinsics(*self.depth_intrinsics) if self.depth_intrinsics else data.depth_intrinsics
        if self._image_size != self._depth_size:
            raise SourceError(
                f"{self.path}: depth is registered to colour, but its images have {_pixels(self._depth_size)} pixels "
                f"and those of colour {_pixels(self._image_size)}: give registered: false and T_depth_image, or the "
                "image_intrinsics and depth_intrinsics of these sizes"
            )
        given = self.image_intrinsics or self.depth_intrinsics
        camera = Intrinsics(*given) if given else data.depth_intrinsics
        return camera, camera

    def _probed(self, own: float) -> float:
        """The units a metre that depth images from all over the folder show; `own` are the layout's."""
        frames = self._dataset.frames
        read = (_depth_pixels(frame) for frame in frames[:: max(1, len(frames) // _PROBED)])
        probed = [pixels[::4, ::4].ravel() for pixels in read if pixels is not None and pixels.dtype == np.uint16]
        if not probed:
            return own
        span = DepthSpan.of(np.concatenate(probed), own)
        if span is None:
            return own
        other = MILLIMETRES if own == FIFTHS else FIFTHS
        verdict, there = span.judged(own / other), span.times(own / other)
        if verdict == "other":
            self.log.warning(
                f"depth images are read as {other:g} units a metre, where their layout has {own:g}: depth is then "
                f"{there}, not {span}; depth_scale: {own:g} reads them as the layout has it"
            )
            return other
        if verdict == "neither":
            self.log.warning(f"depth is {span}, with {own:g} units a metre; depth_scale sets another unit")
        if verdict == "either":
            self.log.log(
                logging.INFO if span.seen else logging.WARNING,
                f"depth images are read as {own:g} units a metre, as their layout has it: depth is then {span}; "
                f"depth_scale: {other:g} would make it {there}",
            )
        return own

    def _check_size(self, frame: Frame, file: Path, found: Size, expected: Size) -> None:
        if found != expected:
            raise SourceError(
                f"frame {frame.name}: {file} has {_pixels(found)} pixels, but the first frame {_pixels(expected)}"
            )


def read_color(frame: Frame) -> NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises SourceError."""
    pixels = cv2.imread(str(frame.image), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        raise SourceError(f"frame {frame.name}: {_why(frame.image)} as a colour image")
    return np.asarray(pixels, np.uint8)


def read_depth(frame: Frame) -> NDArray[np.uint16]:
    """(H, W) in the dataset's own units. Raises SourceError."""
    pixels = _depth_pixels(frame)
    if pixels is None:
        raise SourceError(f"frame {frame.name}: {_why(frame.depth)} as a depth image")
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise SourceError(
            f"frame {frame.name}: {frame.depth} must have one 16-bit channel, has {pixels.dtype} {pixels.shape}"
        )
    return np.asarray(pixels, np.uint16)


def _depth_pixels(frame: Frame) -> NDArray[np.generic] | None:
    return cv2.imread(str(frame.depth), cv2.IMREAD_UNCHANGED)


def depth_in_metres(raw: NDArray[np.uint16], scale: float, max_depth: float) -> NDArray[np.float32]:
    """Metres (H, W) float32 of raw values, `scale` units a metre; 0 for invalid ones and those beyond `max_depth`."""
    metres = (np.arange(65536) / scale).astype(np.float32)
    metres[metres > np.float32(max_depth)] = 0
    metres[list(INVALID)] = 0
    return metres[raw]


def _transform(name: str, numbers: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns translation (3,) and unit quaternion (4,). Raises SourceError."""
    translation, rotation = np.array(numbers[:3], np.float64), np.array(numbers[3:], np.float64)
    if not abs(np.linalg.norm(rotation) - 1) < 1e-3:
        raise SourceError(f"{name}: its last four numbers must be a unit quaternion, got {tuple(numbers[3:])}")
    return translation, normalize(rotation)


def _why(file: Path) -> str:
    return f"cannot decode {file} ({file.stat().st_size} bytes)" if file.is_file() else f"no file {file} to read"


def _pixels(size: Size) -> str:
    return f"{size[0]}x{size[1]}"


def _size(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> Size:
    return pixels.shape[1], pixels.shape[0]


def _info(stamp: int, frame: str, size: Size, camera: Intrinsics) -> CameraInfo:
    return CameraInfo.from_intrinsics(
        stamp=stamp, frame=frame, width=size[0], height=size[1],
        fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy,
    )  # fmt: skip
