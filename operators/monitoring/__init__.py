"""Operators that watch sensors: each by itself, and against each other, before anything averages them."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.monitoring.color_depth_check import ColorDepthCheck
    from operators.monitoring.depth_scan_check import DepthScanCheck
    from operators.monitoring.image_watch import DepthWatch, ImageWatch
    from operators.monitoring.motion_check import MotionCheck
    from operators.monitoring.scan_watch import ScanWatch
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "color_depth_check": ("ColorDepthCheck",),
            "depth_scan_check": ("DepthScanCheck",),
            "image_watch": ("DepthWatch", "ImageWatch"),
            "motion_check": ("MotionCheck",),
            "scan_watch": ("ScanWatch",),
        },
    )

__all__ = ["ColorDepthCheck", "DepthScanCheck", "DepthWatch", "ImageWatch", "MotionCheck", "ScanWatch"]
