"""Turns messages of a bag into other types than those that they are read as: an encoded image into a plain one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.messages import (
    CompressedDepth,
    CompressedImage,
    DepthImage,
    Image,
    Image16,
    Measurement,
    Message,
    Number,
    Odometry,
    Pose,
    RangeReading,
)
from dataflow.messages.depth_units import MILLIMETRES
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.pixels import as_depth, as_millimetres


def image_of(message: CompressedImage) -> Image:
    """Decodes a JPEG, PNG or WebP file."""
    pixels = decoded(message.data, message.format)
    if pixels.dtype != np.uint8:
        pixels = (pixels >> 8).astype(np.uint8)
    return Image(stamp=message.stamp, frame=message.frame, data=rgb(pixels))


def depth_of(message: CompressedDepth) -> DepthImage:
    """Decodes a 16-bit PNG; 0 stays no return."""
    units = decoded(message.data, "png")
    if message.quantizer == "inverse":
        metres = inverse_depth(units, message.scale, message.offset)
    else:
        known, metres = units > 0, np.zeros(units.shape, np.float32)
        metres[known] = units[known] * message.scale + message.offset
    return DepthImage(stamp=message.stamp, frame=message.frame, data=metres)


def inverse_depth(units: Any, scale: float, offset: float) -> npt.NDArray[np.float32]:
    """Metres of inverse depth in whole steps: scale / (units - offset), 0 where there is no return."""
    known = units > 0
    metres = np.zeros(units.shape, np.float32)
    away = units[known] - offset
    metres[known] = np.where(away > 0, scale / np.where(away > 0, away, 1), 0)
    return metres


def image16_of(message: CompressedImage) -> Image16:
    """Decodes a PNG of 16 bits; raises `RecordingError` for one of 8."""
    pixels = decoded(message.data, message.format)
    if pixels.dtype != np.uint16:
        raise RecordingError(f"a {message.format} image of 8 bits is no Image16")
    return Image16(stamp=message.stamp, frame=message.frame, data=rgb(pixels))


def depth_in_millimetres(message: Image16) -> DepthImage:
    """Depth that a device sends as grey values, in millimetres; 0 stays no return."""
    if message.data.ndim != 2:
        raise RecordingError("an image of three channels is no depth")
    metres = as_depth("16UC1", message.data)
    return DepthImage(stamp=message.stamp, frame=message.frame, data=metres)


def in_units(message: Message, scale: float) -> Message:
    """Depth that is read as 16-bit millimetres as that of `scale` units a metre; raises `RecordingError` for other."""
    if scale == MILLIMETRES:
        return message
    if isinstance(message, CompressedDepth) and message.quantizer == "linear":
        return message.replace(scale=1 / scale)
    raw = as_millimetres(message.data) if isinstance(message, DepthImage) else None
    if raw is None:
        raise RecordingError("its depth is not of 16-bit units, so that its scale is given")
    assert isinstance(message, DepthImage)
    return message.replace(data=(raw / scale).astype(np.float32))


def pose_of(message: Odometry) -> Pose:
    """The pose alone."""
    return Pose(**_placed(message), covariance=message.pose_covariance)


def odometry_of(message: Pose) -> Odometry:
    """A pose as odometry without velocities."""
    return Odometry(**_placed(message), pose_covariance=message.covariance)


def _placed(message: Pose | Odometry) -> dict[str, Any]:
    names = ("stamp", "frame", "child_frame", "position", "orientation")
    return {name: getattr(message, name) for name in names}


def decoded(data: Any, format_: str) -> Any:
    """The pixels of an encoded image, as OpenCV has them: BGR, of any depth. Raises `RecordingError`."""
    import cv2

    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        begin = bytes(data[:4]).hex(" ")
        raise RecordingError(
            f"a {format_} image of {len(data)} bytes that begins with {begin} cannot be decoded; JPEG, PNG, WebP, TIFF "
            "and BMP can, if they are whole"
        )
    return pixels


def rgb(pixels: Any) -> Any:
    """Pixels of OpenCV as RGB or grey, without an alpha channel."""
    return np.ascontiguousarray(pixels[..., 2::-1]) if pixels.ndim == 3 else pixels


CONVERSIONS: dict[tuple[type[Message], type[Message]], Callable[[Any], Message]] = {
    (CompressedImage, Image): image_of,
    (CompressedDepth, DepthImage): depth_of,
    (CompressedImage, Image16): image16_of,
    (CompressedImage, DepthImage): lambda m: depth_in_millimetres(image16_of(m)),
    (Image16, Image): lambda m: Image(stamp=m.stamp, frame=m.frame, data=(m.data >> 8).astype(np.uint8)),
    (Image16, DepthImage): depth_in_millimetres,
    (Measurement, Number): lambda m: Number(stamp=m.stamp, value=m.value, unit=m.unit),
    (RangeReading, Number): lambda m: Number(stamp=m.stamp, value=m.range, unit="m"),
    (Odometry, Pose): pose_of,
    (Pose, Odometry): odometry_of,
}


TOLD = {(CompressedImage, Image16), (CompressedImage, DepthImage), (Image16, DepthImage)}
"""Conversions that are right for the messages of some devices only: done where a mapping names them."""
NARROWING = {(Image16, Image): "16 bits become 8", (Odometry, Pose): "velocities", (RangeReading, Number): "limits"}
"""By conversion, the content that it does not carry over."""


def proposed(read_as: type[Message]) -> tuple[type[Message], ...]:
    """The types that a topic read as `read_as` is played as by default, that one first."""
    return tuple(to for to in offers(read_as) if (read_as, to) not in TOLD)


def offers(read_as: type[Message]) -> tuple[type[Message], ...]:
    """The types that a topic read as `read_as` can be played as, that one first."""
    return (read_as, *(to for source, to in CONVERSIONS if source is read_as))


def convert(message: Message, wanted: type[Message]) -> Message:
    """Returns a message as another type; raises `RecordingError` where there is no way."""
    if type(message) is wanted:
        return message
    found = CONVERSIONS.get((type(message), wanted))
    if found is None:
        raise RecordingError(f"a {type(message).__name__} cannot become a {wanted.__name__}")
    return found(message)
