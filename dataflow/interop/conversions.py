"""Turns messages of a bag into other types than those that they are read as: an encoded image into a plain one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dataflow.messages import CompressedDepth, CompressedImage, DepthImage, Image, Message, Odometry, Pose
from dataflow.recording.errors import RecordingError


def image_of(message: CompressedImage) -> Image:
    """Decodes a JPEG, PNG or WebP file."""
    pixels = _decoded(message.data, message.format)
    if pixels.dtype != np.uint8:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.ndim == 3:
        pixels = np.ascontiguousarray(pixels[..., 2::-1])
    return Image(stamp=message.stamp, frame=message.frame, data=pixels)


def depth_of(message: CompressedDepth) -> DepthImage:
    """Decodes a 16-bit PNG; 0 stays no return."""
    units = _decoded(message.data, "png")
    known = units > 0
    metres = np.zeros(units.shape, np.float32)
    if message.quantizer == "linear":
        metres[known] = units[known] * message.scale + message.offset
    else:
        away = units[known] - message.offset
        metres[known] = np.where(away > 0, message.scale / np.where(away > 0, away, 1), 0)
    return DepthImage(stamp=message.stamp, frame=message.frame, data=metres)


def pose_of(message: Odometry) -> Pose:
    """The pose alone."""
    return Pose(
        stamp=message.stamp,
        frame=message.frame,
        child_frame=message.child_frame,
        position=message.position,
        orientation=message.orientation,
        covariance=message.pose_covariance,
    )


def odometry_of(message: Pose) -> Odometry:
    """A pose as odometry without velocities."""
    return Odometry(
        stamp=message.stamp,
        frame=message.frame,
        child_frame=message.child_frame,
        position=message.position,
        orientation=message.orientation,
        pose_covariance=message.covariance,
    )


def _decoded(data: Any, format_: str) -> Any:
    import cv2

    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise RecordingError(f"a {format_} image of {len(data)} bytes cannot be decoded")
    return pixels


CONVERSIONS: dict[tuple[type[Message], type[Message]], Callable[[Any], Message]] = {
    (CompressedImage, Image): image_of,
    (CompressedDepth, DepthImage): depth_of,
    (Odometry, Pose): pose_of,
    (Pose, Odometry): odometry_of,
}


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
