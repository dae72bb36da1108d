"""A grid detector's file in use: an image → its boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operators.detection.custom.decode import find_boxes
from operators.detection.decode import Candidates
from operators.image.letterbox import ImageFit
from operators.weights import NetworkFileError, open_network


@dataclass(frozen=True, eq=False)
class FirstStageDetections:
    """Holds what was found in an image, in its pixels, by falling score; the revealed inner maps (1, C, h, w) of the
    network; and how the image was fitted into its input."""

    found: Candidates
    inner: Sequence[NDArray[np.float32]]
    fit: ImageFit


class FirstStage:
    """Raises FileNotFoundError, or NetworkFileError for a file that is no detector or lacks its anchors."""

    def __init__(self, file: Path) -> None:
        self.network = open_network(file, "detector")
        facts = self.network.facts
        self._anchors = np.array(facts.get("anchors", []), np.float32)
        self._strides = [int(s) for s in facts.get("strides", [])]
        if self._anchors.ndim != 3 or self._anchors.shape[::2] != (len(self._strides), 2) or not self._strides:
            raise NetworkFileError(
                f"{file}: its metadata must hold anchors (levels, anchors, 2) and a stride for each level, "
                f"has anchors {self._anchors.shape} and strides {self._strides}"
            )

    def reveal(self, names: Sequence[str]) -> None:
        """Lets the network give inner maps as well. Raises ModelError for a name that it does not have."""
        self.network = self.network.revealing(names)

    def look(self, pixels: NDArray[np.uint8], threshold: float, nms_iou: float, most: int) -> FirstStageDetections:
        """Finds the best `most` boxes in an image (H, W, 3), RGB.

        Raises NetworkFileError where the network's output is not what its metadata say.
        """
        network = self.network
        fit = ImageFit.plan("letterbox", (pixels.shape[1], pixels.shape[0]), network.size)
        outputs = network.run(fit.apply(pixels))
        levels = len(self._strides)
        try:
            found = find_boxes(
                outputs[:levels], self._anchors, self._strides, len(network.classes), threshold, nms_iou, most
            )
        except ValueError as error:
            raise NetworkFileError(f"{network.file} does not fit its metadata: {error}") from None
        return FirstStageDetections(replace(found, boxes=fit.restore(found.boxes)), outputs[levels:], fit)
