"""Checks that calibrations are those of the images beside them: of their size, with the axis within the image."""

from __future__ import annotations

from collections.abc import Iterator

from dataflow.lint.inputs import Finding, LintInput
from dataflow.messages import CameraInfo, CompressedDepth, CompressedImage, DepthImage, Image, Image16, Message

_TYPES = {cls.SCHEMA for cls in (CameraInfo, CompressedDepth, CompressedImage, DepthImage, Image, Image16)}


def check_cameras(data: LintInput) -> Iterator[Finding]:
    """Looks at the first image and calibration of each stream; one frame is taken for one camera.

    Images of several sizes in one frame are right where each size has a calibration. An image and the `camera_info`
    beside it are of one camera.
    """
    images: dict[str, tuple[str, int, int]] = {}
    infos: dict[str, dict[str, CameraInfo]] = {}
    for name, facts in data.streams.items():
        if not (facts.readable and facts.count and facts.type in _TYPES):
            continue
        message = next(iter(data.messages(name)), None)
        if isinstance(message, CameraInfo):
            infos.setdefault(message.frame, {})[name] = message
        elif message is not None and (size := _size(message)) is not None:
            images[name] = (getattr(message, "frame", ""), *size)
    for name, (frame, width, height) in images.items():
        known = infos.get(frame, {})
        if known and (width, height) not in {(info.width, info.height) for info in known.values()}:
            sizes = ", ".join(f"{stream} of {info.width}x{info.height}" for stream, info in known.items())
            text = f"its images have {width}x{height} pixels, the calibration of frame {frame!r} others: {sizes}"
            yield Finding("calibration", name, "warning", text)
    beside = {
        name.rpartition("/")[0]: (name, info)
        for known in infos.values()
        for name, info in known.items()
        if name.rpartition("/")[2] == "camera_info"
    }
    for name, (frame, _, _) in images.items():
        stream, info = beside.get(name.rpartition("/")[0], ("", None))
        if info is not None and frame and info.frame and info.frame != frame:
            text = f"its images are of frame {frame!r}, and {stream} is the calibration of frame {info.frame!r}"
            yield Finding("calibration", name, "warning", text)
    for of_frame in infos.values():
        for name, info in of_frame.items():
            if not (0 < info.cx < info.width and 0 < info.cy < info.height):
                text = (
                    f"its principal point ({info.cx:.0f}, {info.cy:.0f}) lies outside its {info.width}x{info.height} "
                    "pixels: is it the calibration of another resolution?"
                )
                yield Finding("calibration", name, "warning", text)


def _size(message: Message) -> tuple[int, int] | None:
    """Columns and rows of an image; None for a file that cannot be decoded, and for other messages."""
    if isinstance(message, DepthImage | Image | Image16):
        return message.data.shape[1], message.data.shape[0]
    if isinstance(message, CompressedDepth | CompressedImage):
        import cv2

        pixels = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
        return None if pixels is None else (pixels.shape[1], pixels.shape[0])
    return None
