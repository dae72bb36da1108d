"""Geometry that many operators share: rigid motions, pinhole cameras, calibrations, extrinsics."""
