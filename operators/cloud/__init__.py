"""Operators that make and change point clouds."""

from operators.cloud.cloud_builder import CloudBuilder
from operators.cloud.cloud_colorizer import CloudColorizer
from operators.cloud.cloud_filter import CloudFilter
from operators.cloud.cloud_registration import CloudRegistration
from operators.cloud.clusterer import Clusterer
from operators.cloud.plane_segmenter import PlaneSegmenter

__all__ = ["CloudBuilder", "CloudColorizer", "CloudFilter", "CloudRegistration", "Clusterer", "PlaneSegmenter"]
