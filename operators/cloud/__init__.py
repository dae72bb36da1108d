"""Operators that make and change point clouds."""

from operators.cloud.cloud_builder import CloudBuilder

__all__ = ["CloudBuilder"]
