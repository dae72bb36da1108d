"""A network that `dataflow train detector` wrote, in use: first look, and second look where the file has one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operators.detection.custom.first_look import FirstLook
from operators.detection.custom.refiner import Refiner
from operators.detection.decode import Candidates


class GridFinder:
    """Raises FileNotFoundError, or NetworkFileError for a file that is no such network."""

    def __init__(self, file: Path) -> None:
        self._look = FirstLook(file)
        self.names: tuple[str, ...] = self._look.network.classes
        self._refiner = Refiner.within(self._look.network)
        if self._refiner is not None:
            self._look.reveal(self._refiner.maps)

    def find(self, pixels: NDArray[np.uint8], threshold: float, nms_iou: float, most: int) -> Candidates:
        """Finds the best `most` objects in an image (H, W, 3), RGB, in its pixels, by falling score.

        Raises NetworkFileError where the network's output is not what its metadata say.
        """
        looked = self._look.look(pixels, threshold, nms_iou, most)
        refiner = self._refiner
        return looked.found if refiner is None else refiner.refined(pixels, looked, nms_iou)
