"""Images, depth images and calibrations as Foxglove protobufs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage as CompressedImageProto
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo as CompressedVideoProto
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from dataflow.messages import CameraInfo, CompressedImage, CompressedVideo, DepthImage, Image, Image16
from dataflow.messages.images import VIDEO_FORMATS
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.foxglove.values import Fields, Parts, frozen, matrix, timestamp_of, with_field
from dataflow.recording.streams.pixels import as_millimetres, stored_rows

UINT32_MAX = 2**32 - 1


def _raw_image(
    message: Image | Image16 | DepthImage, encoding: str, data: npt.NDArray[Any]
) -> tuple[Parts, tuple[str, ...]]:
    height, width = data.shape[:2]
    proto = RawImage(
        timestamp=timestamp_of(message.stamp),
        frame_id=message.frame,
        width=width,
        height=height,
        encoding=encoding,
        step=width * (data.itemsize * (3 if data.ndim == 3 else 1)),
    )
    return with_field(proto, "data", data), ()


def encode_image(message: Image) -> tuple[Parts, tuple[str, ...]]:
    return _raw_image(message, "rgb8" if message.data.ndim == 3 else "mono8", message.data)


def encode_image16(message: Image16) -> tuple[Parts, tuple[str, ...]]:
    return _raw_image(message, "rgb16" if message.data.ndim == 3 else "mono16", message.data)


def encode_depth(message: DepthImage) -> tuple[Parts, tuple[str, ...]]:
    whole = as_millimetres(message.data)
    return _raw_image(message, "32FC1", message.data) if whole is None else _raw_image(message, "16UC1", whole)


def decode_raw(pixels_of: Callable[[str, npt.NDArray[Any]], npt.NDArray[Any]], proto: RawImage) -> Fields:
    """The fields of an image, its pixels by its encoding."""
    data = np.frombuffer(proto.data, np.uint8)
    pixels = pixels_of(proto.encoding, stored_rows(proto.encoding, proto.width, proto.height, proto.step, data))
    pixels.flags.writeable = False
    return {"frame": proto.frame_id, "data": pixels}


def encode_compressed(message: CompressedImage) -> tuple[Parts, tuple[str, ...]]:
    proto = CompressedImageProto(timestamp=timestamp_of(message.stamp), frame_id=message.frame, format=message.format)
    return with_field(proto, "data", message.data), ()


def decode_compressed(proto: CompressedImageProto) -> Fields:
    data = np.frombuffer(proto.data, np.uint8)
    named = proto.format.lower().removeprefix("image/")
    return {"frame": proto.frame_id, "format": "jpeg" if named == "jpg" else named, "data": data}


def encode_video(message: CompressedVideo) -> tuple[Parts, tuple[str, ...]]:
    proto = CompressedVideoProto(timestamp=timestamp_of(message.stamp), frame_id=message.frame, format=message.format)
    return with_field(proto, "data", message.data), ()


def decode_video(proto: CompressedVideoProto) -> Fields:
    return {"frame": proto.frame_id, "format": video_format(proto.format), "data": np.frombuffer(proto.data, np.uint8)}


def video_format(named: str) -> str:
    """The format of a video by another program's name of it or of its encoder; raises `RecordingError`."""
    name = named.lower().partition(";")[0].strip()
    found = next((format_ for format_, part in _VIDEO_NAMES if part in name), None)
    if found is None:
        raise RecordingError(
            f"video of format {named!r} is not read: those known are {' and '.join(VIDEO_FORMATS)}. OpenCV's wheels "
            "decode neither AV1 nor other formats packet by packet; encode it anew as one of these"
        )
    return found


_VIDEO_NAMES = (("h264", "264"), ("h264", "avc"), ("h265", "265"), ("h265", "hevc"))


def encode_camera(message: CameraInfo) -> tuple[Parts, tuple[str, ...]]:
    rectification = np.eye(3) if message.R is None else message.R
    projection = np.hstack([message.K, np.zeros((3, 1))]) if message.P is None else message.P
    named = message.distortion_model != "none"
    proto = CameraCalibration(
        timestamp=timestamp_of(message.stamp),
        frame_id=message.frame,
        width=min(message.width, UINT32_MAX),
        height=min(message.height, UINT32_MAX),
        distortion_model=message.distortion_model if named else "",
        D=[] if message.distortion is None else message.distortion.tolist(),
        K=message.K.ravel().tolist(),
        R=rectification.ravel().tolist(),
        P=projection.ravel().tolist(),
    )
    lacks = [name for name in ("R", "P") if getattr(message, name) is None]
    if message.distortion is not None and not message.distortion.size:
        lacks.append("distortion")
    if message.distortion_model == "":
        lacks.append("distortion_model")
    lacks += [name for name in ("width", "height") if getattr(message, name) != getattr(proto, name)]
    return [proto.SerializeToString()], tuple(lacks)


def decode_camera(proto: CameraCalibration) -> Fields:
    return {
        "frame": proto.frame_id,
        "width": proto.width,
        "height": proto.height,
        "distortion_model": proto.distortion_model or "none",
        "distortion": frozen(proto.D, "<f8", (-1,)) if proto.D else None,
        "K": matrix(proto.K, "K", (3, 3)),
        "R": matrix(proto.R, "R", (3, 3)) if proto.R else None,
        "P": matrix(proto.P, "P", (3, 4)) if proto.P else None,
    }
