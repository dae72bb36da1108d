"""The focus network in use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.detection.decode import Candidates
from operators.detection.focus.cells import MULTIPLE, STRIDE
from operators.detection.focus.regions import Region
from operators.detection.nms import merging_nms
from operators.weights import open_kind

if TYPE_CHECKING:
    import onnxruntime

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
KIND = "focus"
Answer = Callable[[U8], tuple[F32, F32]]
"""Pixels (H, W, 3) → scores (C, H/2, W/2) and pixels to the sides (4, H/2, W/2)."""

_CUT = 1.5  # pixels from a region's border at which a box may be cut off
_PEAKS = 300  # cells of a region that are boxes, at most


@dataclass(frozen=True, eq=False)
class FocusModel:
    """An opened network. It runs on one CPU thread, so equal images give equal boxes."""

    classes: tuple[str, ...]
    session: onnxruntime.InferenceSession

    @classmethod
    def open(cls, file: Path) -> FocusModel:
        """Raises FileNotFoundError, or NetworkFileError where the file is no focus network of our cells."""
        session, facts = open_kind(file, KIND, ("classes",), {"stride": STRIDE, "multiple": MULTIPLE})
        return cls(tuple(map(str, facts["classes"])), session)

    def found(self, pixels: U8, regions: Sequence[Region], least: float, nms_iou: float, most: int) -> Candidates:
        """Returns the best `most` boxes in regions of an image (H, W, 3), RGB, in its pixels, by falling score."""
        return found_in(self._answer, pixels, regions, least, nms_iou, most)

    def _answer(self, pixels: U8) -> tuple[F32, F32]:
        scores, sides = self.session.run(None, {"pixels": pixels[None]})
        return scores[0], sides[0]


def found_in(
    answer: Answer, pixels: U8, regions: Sequence[Region], least: float, nms_iou: float, most: int
) -> Candidates:
    """`FocusModel.found`, by what `answer` gives."""
    parts = [_of_region(answer, pixels, region, least) for region in regions]
    boxes = np.concatenate([np.zeros((0, 4), np.float32), *(part.boxes for part in parts)])
    scores = np.concatenate([np.zeros(0, np.float32), *(part.scores for part in parts)])
    classes = np.concatenate([np.zeros(0, np.int32), *(part.classes for part in parts)])
    kept, merged = merging_nms(boxes, scores, classes, nms_iou, most)
    return Candidates(merged, scores[kept], classes[kept])


def _of_region(answer: Answer, pixels: U8, region: Region, least: float) -> Candidates:
    """Returns what the cells of a region say that are surer than those around them.

    Boxes at a border of the region that is not the image's are left out: what they show may go on beyond it (Najibi,
    Singh and Davis, "AutoFocus", 2019).
    """
    height, width = pixels.shape[:2]
    x1, y1, x2, y2 = region
    beyond = max(0, y2 - height), max(0, x2 - width)
    own = cv2.copyMakeBorder(pixels[y1:y2, x1:x2], 0, beyond[0], 0, beyond[1], cv2.BORDER_REPLICATE)
    scores, sides = answer(np.ascontiguousarray(own))
    best = scores.max(axis=0)
    rows, columns = np.nonzero((best >= least) & (best >= cv2.dilate(best, np.ones((3, 3), np.uint8))))
    if len(rows) > _PEAKS:
        kept = np.sort(np.argsort(-best[rows, columns], kind="stable")[:_PEAKS])
        rows, columns = rows[kept], columns[kept]
    x, y = ((each + 0.5) * STRIDE for each in (columns, rows))
    left, up, right, down = sides[:, rows, columns]
    boxes = np.stack([x - left, y - up, x + right, y + down], axis=1).astype(np.float32)
    boxes += np.array([x1, y1, x1, y1], np.float32)
    lowest = np.array([x1 + _CUT if x1 else -np.inf, y1 + _CUT if y1 else -np.inf])
    highest = np.array([x2 - _CUT if x2 < width else np.inf, y2 - _CUT if y2 < height else np.inf])
    inside = (boxes[:, :2] > lowest).all(axis=1) & (boxes[:, 2:] < highest).all(axis=1)
    boxes = np.clip(boxes, 0, np.array([width, height] * 2, np.float32))
    classes = scores[:, rows, columns].argmax(axis=0).astype(np.int32)
    return Candidates(boxes, best[rows, columns], classes).select(
        np.asarray(inside & (boxes[:, 2:] > boxes[:, :2]).all(axis=1))
    )
