"""Images, compressed images and camera calibrations of ROS as messages."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from dataflow.interop.access_tracking import lose
from dataflow.interop.conversions import decoded, inverse_depth, rgb
from dataflow.interop.ros.rvl import unpacked_rvl
from dataflow.interop.ros.values import first, known, optional
from dataflow.messages import CameraInfo, CompressedDepth, CompressedImage, CompressedVideo, DepthImage, Image, Image16
from dataflow.messages.camera import COEFFICIENTS
from dataflow.messages.images import PNG_SIGNATURE, START_CODES, file_format
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.foxglove.images import video_format
from dataflow.recording.streams.pixels import (
    as_depth,
    as_image,
    as_image16,
    is_16_bit,
    is_depth,
    row_bytes,
    stored_height,
    stored_rows,
)

_DEPTH_HEADER = struct.Struct("<iff")
"""The header that compressed_depth_image_transport puts before the PNG: format, quantisation parameters A and B."""
_RVL_SIZE = struct.Struct("<II")
"""Columns and rows, which it puts before RVL data."""
_DEPTH_UNIT = 0.001


Raw = Image | Image16 | DepthImage
_CONVERTED = {
    **dict.fromkeys(("rgba8", "bgra8", "8UC4", "rgba16", "bgra16", "16UC4"), "the alpha channel"),
    **dict.fromkeys(("yuv422", "uyvy", "yuv422_yuy2", "yuyv"), "YUV 4:2:2 (it is RGB here, each value rounded)"),
    **dict.fromkeys(("nv12", "nv21"), "YUV 4:2:0 (it is RGB here, each value rounded)"),
    "nv24": "YUV (it is RGB here, each value rounded)",
    **{
        f"bayer_{pattern}{bits}": "the Bayer mosaic (interpolated)"
        for pattern in ("rggb", "bggr", "gbrg", "grbg")
        for bits in (8, 16)
    },
}
"""By encoding, what an `Image` does not hold of it."""


def image(message: Any, stamp: int) -> Raw:
    """sensor_msgs/Image: depth for a depth encoding, and all 16 bits of greys and colours that have them."""
    step, height = int(message.step), stored_height(message.encoding, int(message.height))
    used = row_bytes(message.encoding, message.width)
    if 0 < step < used and len(message.data) == used * height:
        lose(message, f"a step of {step:,}, where rows have {used:,} bytes")
        step = 0
    rows = stored_rows(
        message.encoding, message.width, message.height, step, message.data, big_endian=bool(message.is_bigendian)
    )
    frame = message.header.frame_id
    rest = len(message.data) - height * (step or rows[0].nbytes)
    if rest > 0:
        lose(message, f"{rest:,} bytes behind the last of {message.height} rows (is step right?)")
    if is_depth(message.encoding):
        with np.errstate(over="ignore"):
            narrowed = message.encoding == "64FC1" and (rows.astype(np.float32) != rows)[np.isfinite(rows)].any()
        if narrowed:
            lose(message, "depth beyond 32 bits")
        return DepthImage(stamp=stamp, frame=frame, data=as_depth(message.encoding, rows))
    if message.encoding in _CONVERTED:
        lose(message, _CONVERTED[message.encoding])
    if is_16_bit(message.encoding):
        return Image16(stamp=stamp, frame=frame, data=as_image16(message.encoding, rows))
    return Image(stamp=stamp, frame=frame, data=as_image(message.encoding, rows))


def compressed_image(message: Any, stamp: int) -> CompressedImage | CompressedDepth | CompressedVideo | Raw:
    """sensor_msgs/CompressedImage, those of compressed_depth_image_transport and packets of video too; formats that a
    `CompressedImage` does not have (TIFF, BMP) are decoded."""
    data = np.asarray(message.data, np.uint8)
    if data[:4].tobytes().startswith(START_CODES):
        format_ = video_format(message.format)
        return CompressedVideo(stamp=stamp, frame=message.header.frame_id, format=format_, data=data)
    return compressed(message.format, data, message.header.frame_id, stamp)


def compressed(format_: str, data: Any, frame: str, stamp: int) -> CompressedImage | CompressedDepth | Raw:
    """An encoded image or depth image, told apart by the text of its format (`16UC1; compressedDepth png`).

    A 16-bit grey PNG whose format does not name its pixels (`png`) is depth in millimetres, as devices send it.
    """
    if "compresseddepth" in format_.lower():
        return _compressed_depth(format_, data, frame, stamp)
    if not len(data):
        raise RecordingError(f"an image of format {format_!r} without a byte")
    head = data[:26].tobytes()
    pixels = format_.partition(";")[0].strip()
    named = pixels if is_16_bit(pixels) or is_depth(pixels) or pixels in ("mono8", "rgb8", "bgr8") else ""
    if head.startswith(PNG_SIGNATURE) and head[24:26] == b"\x10\x00" and (not named or is_depth(named)):
        return CompressedDepth(stamp=stamp, frame=frame, scale=_DEPTH_UNIT, data=data)
    if kind := file_format(head):
        return CompressedImage(stamp=stamp, frame=frame, format=kind, data=data)
    if any(part in format_.lower() for part in ("264", "265", "hevc")):
        raise RecordingError(f"a packet of {format_!r} without a start code (as in MP4 files); Annex B form is wanted")
    found = rgb(decoded(data, repr(format_)))
    if found.dtype == np.uint16 and not is_depth(named):
        return Image16(stamp=stamp, frame=frame, data=found)
    if found.dtype == np.uint8:
        return Image(stamp=stamp, frame=frame, data=found)
    encoding = {"float32": "32FC1", "float64": "64FC1", "uint16": "16UC1"}.get(found.dtype.name)
    if encoding is None or found.ndim != 2:
        shape = "x".join(map(str, found.shape))
        raise RecordingError(
            f"an image of format {format_!r} holds {found.dtype} of {shape}, which no message here holds"
        )
    return DepthImage(stamp=stamp, frame=frame, data=as_depth(encoding, found))


def compressed_video(message: Any, stamp: int) -> CompressedVideo:
    """foxglove_msgs/CompressedVideo: a picture in Annex B form."""
    data = np.asarray(message.data, np.uint8)
    return CompressedVideo(stamp=stamp, frame=message.frame_id, format=video_format(message.format), data=data)


def ffmpeg_packet(message: Any, stamp: int) -> CompressedVideo:
    """ffmpeg_image_transport_msgs/FFMPEGPacket; its size, time and flags stand in the packet itself."""
    data = np.asarray(message.data, np.uint8)
    _ = message.width, message.height, message.flags, message.is_bigendian
    return CompressedVideo(stamp=stamp, frame=message.header.frame_id, format=video_format(message.encoding), data=data)


def _compressed_depth(format_: str, data: Any, frame: str, stamp: int) -> CompressedDepth | DepthImage:
    """A PNG or RVL of compressed_depth_image_transport: of 16 bits as they are, or of inverse depth in whole steps."""
    if data[: len(PNG_SIGNATURE)].tobytes() == PNG_SIGNATURE and format_.startswith("16UC1"):
        return CompressedDepth(stamp=stamp, frame=frame, scale=_DEPTH_UNIT, data=data)  # its header was left out
    head, body = data[: _DEPTH_HEADER.size].tobytes(), data[_DEPTH_HEADER.size :]
    rvl = "rvl" in format_.lower()
    if len(body) < _RVL_SIZE.size or not (rvl or body[: len(PNG_SIGNATURE)].tobytes() == PNG_SIGNATURE):
        raise RecordingError(
            f"a compressed depth image of format {format_!r} must hold a PNG after its header of "
            f"{_DEPTH_HEADER.size} bytes, or RVL where its format names it"
        )
    _, scale, offset = _DEPTH_HEADER.unpack(head)
    inverse = format_.startswith("32FC1") or (not format_.startswith("16UC1") and scale > 0)
    if rvl:
        columns, rows = _RVL_SIZE.unpack(body[: _RVL_SIZE.size].tobytes())
        units = unpacked_rvl(body[_RVL_SIZE.size :], columns * rows).reshape(rows, columns)
        metres = inverse_depth(units, scale, offset) if inverse else as_depth("16UC1", units)
        return DepthImage(stamp=stamp, frame=frame, data=metres)
    if inverse:
        return CompressedDepth(stamp=stamp, frame=frame, quantizer="inverse", scale=scale, offset=offset, data=body)
    return CompressedDepth(stamp=stamp, frame=frame, scale=_DEPTH_UNIT, data=body)


_MODELS = {
    **dict.fromkeys(("fisheye", "kannala_brandt", "kannala_brandt4", "opencv_fisheye"), "equidistant"),
    **dict.fromkeys(("radtan", "radial_tangential", "radial-tangential", "pinhole", "perspective"), "plumb_bob"),
}
"""Other names of the distortion models that CameraInfo has."""


def camera_info(message: Any, stamp: int) -> CameraInfo:
    """sensor_msgs/CameraInfo, as it is for the image that comes: of the sensor's size where it is binned or a part is
    read out (REP 104), with K and P of those pixels. Raises `RecordingError` for a camera that is not calibrated (K
    of zeros), and for coefficients that its lens model does not have."""
    K, D = first(message, "k", "K"), first(message, "d", "D")
    R, P = first(message, "r", "R"), first(message, "p", "P")
    named = str(message.distortion_model)
    model = _MODELS.get(named.lower(), named)
    if model != named:
        model = model if len(D) else "none"
        lose(message, f"the name {named!r} of the distortion model (it is {model!r} here)")
    if model == "plumb_bob" and len(D) in COEFFICIENTS["rational_polynomial"]:
        lose(message, f"the model plumb_bob, which has no {len(D)} coefficients (rational_polynomial has)")
        model = "rational_polynomial"
    elif np.isfinite(D).all():
        D = _fitting(model, D)
    else:
        lose(message, "a distortion that is not finite")
    made = calibration(stamp, message.header.frame_id, message.width, message.height, model, K, D, R, P)
    roi, binning = message.roi, (int(message.binning_x) or 1, int(message.binning_y) or 1)
    if max(binning) > 1 and made.cx > 0.8 * made.width:
        # some drivers give the size of the image beside the K of the sensor
        made = made.replace(width=made.width * binning[0], height=made.height * binning[1])
    offset = (int(roi.x_offset), int(roi.y_offset))
    part = (int(roi.width) or made.width - offset[0], int(roi.height) or made.height - offset[1])
    if roi.do_rectify:
        lose(message, "roi.do_rectify")
    return as_read_out(made, offset, part, binning)


def _fitting(model: str, D: Any) -> Any:
    """Coefficients with as many zeros behind them as a model takes. Raises `RecordingError` where it takes fewer."""
    counts = COEFFICIENTS.get(model)
    if counts is None or len(D) in (0, *counts):
        return D
    held = np.trim_zeros(np.asarray(D, np.float64), "b")
    if len(held) > counts[-1]:
        raise RecordingError(f"a distortion of {len(held)} coefficients, of which {model} has {counts[-1]} at most")
    return np.append(held, np.zeros(min(count for count in counts if count >= len(held)) - len(held)))


def as_read_out(
    info: CameraInfo, offset: tuple[int, int], part: tuple[int, int], binning: tuple[int, int]
) -> CameraInfo:
    """A calibration of a whole sensor as one of the image that is read out: `part` (columns, rows) from `offset`,
    `binning` pixels of each as one (REP 104). Raises `RecordingError` for a part outside the sensor."""
    if offset == (0, 0) and part == (info.width, info.height) and binning == (1, 1):
        return info
    width, height = part[0] // binning[0], part[1] // binning[1]
    fits = part[0] > 0 and part[1] > 0 and offset[0] + part[0] <= info.width and offset[1] + part[1] <= info.height
    if not fits or not width or not height:
        raise RecordingError(
            f"its region of {part[0]}x{part[1]} at {offset}, binned {binning[0]}x{binning[1]}, does not lie in the "
            f"sensor of {info.width}x{info.height} pixels"
        )
    scale = np.array([1 / binning[0], 1 / binning[1], 1.0])[:, None]
    shift = np.array([[offset[0]], [offset[1]]], np.float64)

    def moved(matrix: Any) -> Any:
        changed = np.array(matrix)
        changed[:2, 2:3] -= shift
        return changed * scale

    return info.replace(width=width, height=height, K=moved(info.K), P=None if info.P is None else moved(info.P))


def calibration(
    stamp: int, frame: str, width: int, height: int, model: str, K: Any, D: Any, R: Any, P: Any
) -> CameraInfo:
    """A calibration; matrices of zeros or with NaN are not known."""
    intrinsics = np.asarray(K, np.float64)
    if not intrinsics.any():
        raise RecordingError(f"the camera {frame!r} is not calibrated: its K is all zeros")
    rectification, projection = known(R), known(P)
    distortion = optional(D, "<f8")
    if distortion is not None and not np.isfinite(distortion).all():
        distortion, model = None, "none"
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
        R=None if rectification is None else rectification.reshape(3, 3),
        P=None if projection is None else projection.reshape(3, 4),
    )
