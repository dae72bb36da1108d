"""Operators that make and change point clouds."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.cloud.camera_mount import CameraMount
    from operators.cloud.cloud_builder import CloudBuilder
    from operators.cloud.cloud_colorizer import CloudColorizer
    from operators.cloud.cloud_filter import CloudFilter
    from operators.cloud.cloud_registration import CloudRegistration
    from operators.cloud.clusterer import Clusterer
    from operators.cloud.plane_segmenter import PlaneSegmenter
else:  # most need scipy, which a graph without them need not load
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "camera_mount": ("CameraMount",),
            "cloud_builder": ("CloudBuilder",),
            "cloud_colorizer": ("CloudColorizer",),
            "cloud_filter": ("CloudFilter",),
            "cloud_registration": ("CloudRegistration",),
            "clusterer": ("Clusterer",),
            "plane_segmenter": ("PlaneSegmenter",),
        },
    )

__all__ = [
    "CameraMount",
    "CloudBuilder",
    "CloudColorizer",
    "CloudFilter",
    "CloudRegistration",
    "Clusterer",
    "PlaneSegmenter",
]
