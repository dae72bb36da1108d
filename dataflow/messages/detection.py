"""Detections: boxes in the image and in space, and keypoints."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dataflow.messages.arrays import F32, F64, I32, I64, U8
from dataflow.messages.base import ANCHOR, Message, MessageError, array, scalar
from dataflow.messages.checks import (
    ordered_boxes,
    parallel,
    positive,
    table_indices,
    unit_quaternions,
    within,
    within_length,
)

CLASS_NAMES = "name of each class, indexed by class id; empty where they have no names"


def labels_of(class_ids: I32, class_names: tuple[str, ...]) -> tuple[str, ...]:
    """Class names by class ids (N,); the ids as text where classes have no names."""
    return tuple(class_names[i] if class_names else str(i) for i in class_ids.tolist())


class Detections2D(Message):
    """Objects found in one image."""

    frame: str = scalar("str", "optical frame of the camera", default=ANCHOR)
    width: int = scalar("int", "columns of the image, pixels")
    height: int = scalar("int", "rows of the image, pixels")
    class_names: tuple[str, ...] = scalar("strs", CLASS_NAMES, default=())
    boxes: F32 = array(
        "float32", "N 4", "(x1, y1, x2, y2), the outer edges; (0, 0) is the image's top left corner", unit="px"
    )
    scores: F32 = array("float32", "N", "confidence, [0, 1]")
    class_ids: I32 = array("int32", "N", "index into `class_names`")
    ids: I64 | None = array("int64", "N", "identity of each object over time (tracker, simulator)", default=None)
    visible: F32 | None = array("float32", "N", "share of the object that is not hidden, [0, 1]", default=None)
    pixel_counts: I64 | None = array("int64", "N", "visible pixels of each object", unit="px", default=None)
    masks: U8 | None = array(
        "uint8",
        "N H B",
        "visible pixels of each object, a bit for each of the image's, rows padded with 0 to whole bytes, highest bit "
        "first (`pack_masks`)",
        default=None,
        added=True,
    )

    def validate(self) -> None:
        positive(self, "width", "height")
        ordered_boxes(self, "boxes")
        within(self, 0.0, 1.0, "scores", "visible")
        table_indices(self, "class_ids", "class_names")
        if self.masks is not None:
            _of_image(self.masks, self.width, self.height)

    @property
    def count(self) -> int:
        """Number of objects."""
        return len(self.boxes)

    def mask(self, index: int) -> npt.NDArray[np.bool_] | None:
        """Returns the visible pixels (height, width) of an object; None where masks are not known."""
        if self.masks is None:
            return None
        return np.unpackbits(self.masks[index], axis=1, count=self.width).view(np.bool_)

    def labels(self) -> tuple[str, ...]:
        """Class name of each object, or its class id as text where classes have no names."""
        return labels_of(self.class_ids, self.class_names)


class Keypoints2D(Message):
    """Named points of objects in one image, such as the joints of people."""

    frame: str = scalar("str", "optical frame of the camera", default=ANCHOR)
    width: int = scalar("int", "columns of the image, pixels")
    height: int = scalar("int", "rows of the image, pixels")
    names: tuple[str, ...] = scalar("strs", "name of each point of an object, or empty", default=())
    links: I32 = array("int32", "L 2", "pairs of points that are drawn as one limb")
    points: F32 = array(
        "float32", "N K 2", "(x, y) of each point, as in Detections2D; NaN for one that was not found", unit="px"
    )
    scores: F32 = array("float32", "N K", "confidence, [0, 1]")
    ids: I64 | None = array("int64", "N", "what each row is about: detection or track", default=None)

    def validate(self) -> None:
        positive(self, "width", "height")
        within(self, 0.0, 1.0, "scores")
        parallel(self, "names", self.points.shape[1], "points", empty=True)
        within_length(self, "links", self.points.shape[1], "index the points of an object")

    @property
    def count(self) -> int:
        """Number of objects."""
        return len(self.points)

    def limbs(self, least: float = 0.5) -> F32:
        """Returns the ends (M, 2, 2), in pixels, of all limbs whose two points have a score of `least`."""
        sure = np.isfinite(self.points).all(axis=2) & (self.scores >= least)
        ends: F32 = self.points[:, self.links][sure[:, self.links].all(axis=2)]
        return ends


class Boxes3D(Message):
    """Objects found in space, as oriented boxes."""

    frame: str = scalar("str", "frame of the boxes", default=ANCHOR)
    class_names: tuple[str, ...] = scalar("strs", CLASS_NAMES, default=())
    centers: F64 = array("float64", "N 3", "middle of each box", unit="m")
    sizes: F64 = array("float64", "N 3", "full extents along the box's own x, y and z", unit="m")
    orientations: F64 = array("float64", "N 4", "unit quaternions (x, y, z, w) that map the box's axes to `frame`")
    scores: F32 = array("float32", "N", "confidence, [0, 1]")
    class_ids: I32 = array("int32", "N", "index into `class_names`")
    ids: I64 | None = array("int64", "N", "identity of each object over time (tracker, simulator)", default=None)
    velocities: F64 | None = array("float64", "N 3", "velocity of the centres, in `frame`", unit="m/s", default=None)
    covariances: F64 | None = array("float64", "N 3 3", "of the centres", unit="m²", default=None)
    visible: F32 | None = array("float32", "N", "share of the object that is not hidden, [0, 1]", default=None)
    point_counts: I64 | None = array("int64", "N", "points of the cloud in each box", unit="points", default=None)

    def validate(self) -> None:
        within(self, 0.0, float("inf"), "sizes")
        unit_quaternions(self, "orientations")
        within(self, 0.0, 1.0, "scores", "visible")
        table_indices(self, "class_ids", "class_names")

    @property
    def count(self) -> int:
        """Number of objects."""
        return len(self.centers)

    def labels(self) -> tuple[str, ...]:
        """Class name of each object, or its class id as text where classes have no names."""
        return labels_of(self.class_ids, self.class_names)


def pack_masks(masks: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """Returns masks (N, H, W) as `Detections2D.masks` holds them, (N, H, ceil(W / 8)): `numpy.packbits` along rows."""
    return np.packbits(masks, axis=2)


def _of_image(masks: U8, width: int, height: int) -> None:
    """Raises MessageError for masks of another image's size, or set bits beyond its last column."""
    if masks.shape[1:] != (height, -(-width // 8)):
        raise MessageError(
            f"Detections2D.masks must have shape (N, {height}, {-(-width // 8)}), the bits of {width}x{height} pixels, "
            f"got {masks.shape}"
        )
    beyond = -width % 8
    if beyond and (masks[:, :, -1] & ((1 << beyond) - 1)).any():
        raise MessageError(f"Detections2D.masks must be 0 in the {beyond} bits beyond column {width - 1}")
