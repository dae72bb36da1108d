"""Images against their calibrations."""

from __future__ import annotations

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Image


def told_again(known: CameraInfo | None, given: CameraInfo) -> bool:
    """Returns whether a calibration repeats the known one, whatever its stamp: many cameras send it with each image.

    None is known of nothing.
    """
    return known is given or (known is not None and known.replace(stamp=given.stamp) == given)


def check_fit(port: str, image: DepthImage | Image, info: CameraInfo) -> None:
    """Raises ValueError unless an image has the size and frame of its calibration.

    `port` names the input; its calibration is named `<port>_info`.
    """
    if (image.width, image.height) != (info.width, info.height):
        raise ValueError(
            f"{port} has {image.width}x{image.height} pixels, but {port}_info describes {info.width}x{info.height}"
        )
    if image.frame != info.frame:
        raise ValueError(f"{port} is in frame {image.frame!r}, but {port}_info in {info.frame!r}")


def check_calibration(port: str, image: DepthImage | Image, info: CameraInfo) -> None:
    """Raises ValueError unless an image fits its calibration, which must be without distortion."""
    check_fit(port, image, info)
    if info.distortion is not None and np.any(info.distortion):
        raise ValueError(f"{port}_info has lens distortion ({info.distortion_model}); undistort the images first")
