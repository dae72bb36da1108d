"""Objects followed over time, in the image and in space."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.tracking.multi_object_tracker import MultiObjectTracker
    from operators.tracking.multi_object_tracker_3d import MultiObjectTracker3D
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {"multi_object_tracker": ("MultiObjectTracker",), "multi_object_tracker_3d": ("MultiObjectTracker3D",)},
    )

__all__ = ["MultiObjectTracker", "MultiObjectTracker3D"]
