"""Images, compressed images and camera calibrations of ROS as messages."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from dataflow.interop.ros.values import first, optional
from dataflow.messages import CameraInfo, CompressedDepth, CompressedImage, DepthImage, Image
from dataflow.messages.images import PNG_SIGNATURE
from dataflow.recording.errors import RecordingError
from dataflow.recording.pixels import as_depth, as_image, is_depth, stored_rows

_DEPTH_HEADER = struct.Struct("<iff")
"""The header that compressed_depth_image_transport puts before the PNG: format, quantisation parameters A and B."""
_DEPTH_UNIT = 0.001
_JPEG = b"\xff\xd8\xff"


def image(message: Any, stamp: int) -> Image | DepthImage:
    """sensor_msgs/Image: depth where its encoding says so."""
    rows = stored_rows(
        message.encoding,
        message.width,
        message.height,
        message.step,
        message.data,
        big_endian=bool(message.is_bigendian),
    )
    frame = message.header.frame_id
    if is_depth(message.encoding):
        return DepthImage(stamp=stamp, frame=frame, data=as_depth(message.encoding, rows))
    return Image(stamp=stamp, frame=frame, data=as_image(message.encoding, rows))


def compressed_image(message: Any, stamp: int) -> CompressedImage | CompressedDepth:
    """sensor_msgs/CompressedImage, those of compressed_depth_image_transport too."""
    data = np.asarray(message.data, np.uint8)
    return compressed(message.format, data, message.header.frame_id, stamp)


def compressed(format_: str, data: Any, frame: str, stamp: int) -> CompressedImage | CompressedDepth:
    """An encoded image or depth image, told apart by the text of its format (`16UC1; compressedDepth png`)."""
    if "compressedDepth" in format_:
        return _compressed_depth(format_, data, frame, stamp)
    head = data[:26].tobytes()
    if head.startswith(PNG_SIGNATURE) and head[24:26] == b"\x10\x00":
        return CompressedDepth(stamp=stamp, frame=frame, scale=_DEPTH_UNIT, data=data)
    kind = "jpeg" if head.startswith(_JPEG) else "png" if head.startswith(PNG_SIGNATURE) else "webp"
    return CompressedImage(stamp=stamp, frame=frame, format=kind, data=data)


def _compressed_depth(format_: str, data: Any, frame: str, stamp: int) -> CompressedDepth:
    head = data[: _DEPTH_HEADER.size].tobytes()
    png = data[_DEPTH_HEADER.size :]
    if len(head) < _DEPTH_HEADER.size or not png[: len(PNG_SIGNATURE)].tobytes() == PNG_SIGNATURE:
        raise RecordingError(
            f"a compressed depth image of format {format_!r} must hold a PNG after its header of "
            f"{_DEPTH_HEADER.size} bytes; others (RVL) are not read"
        )
    _, scale, offset = _DEPTH_HEADER.unpack(head)
    if format_.startswith("32FC1") or (not format_.startswith("16UC1") and scale > 0):
        return CompressedDepth(stamp=stamp, frame=frame, quantizer="inverse", scale=scale, offset=offset, data=png)
    return CompressedDepth(stamp=stamp, frame=frame, scale=_DEPTH_UNIT, data=png)


def camera_info(message: Any, stamp: int) -> CameraInfo:
    """sensor_msgs/CameraInfo; raises `RecordingError` for a camera that is not calibrated (K of zeros)."""
    K, D = first(message, "k", "K"), first(message, "d", "D")
    R, P = first(message, "r", "R"), first(message, "p", "P")
    return calibration(
        stamp, message.header.frame_id, message.width, message.height, message.distortion_model, K, D, R, P
    )


def calibration(
    stamp: int, frame: str, width: int, height: int, model: str, K: Any, D: Any, R: Any, P: Any
) -> CameraInfo:
    """A calibration; matrices of zeros are not known."""
    intrinsics = np.asarray(K, np.float64)
    if not intrinsics.any():
        raise RecordingError(f"the camera {frame!r} is not calibrated: its K is all zeros")
    rectification, projection = np.asarray(R, np.float64), np.asarray(P, np.float64)
    distortion = optional(D, "<f8")
    if distortion is None or (not model and not distortion.any()):
        model, distortion = (model or "none") if distortion is None else "none", None
    return CameraInfo(
        stamp=stamp,
        frame=frame,
        width=width,
        height=height,
        distortion_model=model or "plumb_bob",
        K=intrinsics.reshape(3, 3),
        distortion=distortion,
        R=rectification.reshape(3, 3) if rectification.any() else None,
        P=projection.reshape(3, 4) if projection.any() else None,
    )
