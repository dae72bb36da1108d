"""Operators that make and change point clouds."""

from operators.cloud.cloud_builder import CloudBuilder
from operators.cloud.cloud_filter import CloudFilter

__all__ = ["CloudBuilder", "CloudFilter"]
