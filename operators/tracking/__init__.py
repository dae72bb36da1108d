"""Objects followed over time, in the image and in space."""

from operators.tracking.multi_object_tracker import MultiObjectTracker
from operators.tracking.multi_object_tracker_3d import MultiObjectTracker3D

__all__ = ["MultiObjectTracker", "MultiObjectTracker3D"]
