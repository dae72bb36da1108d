"""A second look at each box that a grid detector found: where its sides are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operators.detection.custom.closeup import closeups, moved, numbers, places, windows
from operators.detection.custom.first_look import FirstStage, FirstStageDetections
from operators.detection.custom.surroundings import surroundings
from operators.detection.decode import Candidates
from operators.detection.nms import class_wise_nms
from operators.weights import Network, SecondNetwork, open_second

KIND = "refiner"
INT8, DEQUANTIZED = "int8", "_DequantizeLinear_Output"
"""The word for 8 bits in a network's metadata, and the ending of its inner values' names."""
Answer = Callable[[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]
"""(close-ups, surroundings, places) → by which shares of the windows the sides move (N, 4)."""


@dataclass(frozen=True)
class RefinerSettings:
    """Settings of a second look, at the best `most` boxes of `classes` classes that score at least `least`: close-ups
    have `side` pixels along a side."""

    classes: int
    side: int
    least: float
    most: int


class Refiner:
    """A small network that sees the close-up of each box in the image's full resolution, and what the detector's inner
    maps show of its surroundings.

    It moves the four sides; scores stay. One network for all classes, with the class as input. Method: Cai and
    Vasconcelos, "Cascade R-CNN", 2018: a second regression, from the boxes of the first.
    """

    def __init__(self, second: SecondNetwork, network: Network) -> None:
        facts, side = second.facts, int(second.facts["side"])
        self.look = RefinerSettings(len(facts["classes"]), side, float(facts["least_score"]), int(facts["most_boxes"]))
        self.maps = inner_names(network, facts["maps"])
        self._second = second
        around = second.inputs.get("surroundings", ("", [0]))[1]
        second.expect(
            {
                "closeups": ("tensor(uint8)", [side, side, 3]),
                "surroundings": ("tensor(float)", around),
                "places": ("tensor(float)", [numbers(self.look.classes)]),
            }
        )

    @classmethod
    def within(cls, network: Network) -> Refiner | None:
        """The refiner in a detector's file; None where it has none. Raises NetworkFileError."""
        second = open_second(network, KIND, ("side", "least_score", "most_boxes", "maps"))
        return None if second is None else cls(second, network)

    def refined(self, pixels: NDArray[np.uint8], looked: FirstStageDetections, nms_iou: float) -> Candidates:
        """The boxes in the pixels of an image (H, W, 3), RGB, after a second look, by falling score.

        Those that score less than `look.least`, and all but the best `look.most`, stay as they are. Boxes of a class
        that have come to overlap by more than halfway from `nms_iou` to 1 are one: they are around the same object,
        while boxes of neighbours may come to overlap by more than they did.
        """
        return look_again(self._answer, pixels, looked, self.look, nms_iou)

    def _answer(
        self, seen: NDArray[np.uint8], around: NDArray[np.float32], known: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        return self._second.sides({"closeups": seen, "surroundings": around, "places": known})


class GridFinder:
    """A network that `dataflow train detector` wrote, in use: first look, and second look where the file has one.

    Raises FileNotFoundError, or NetworkFileError for a file that is no such network.
    """

    def __init__(self, file: Path) -> None:
        self._look = FirstStage(file)
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


def inner_names(network: Network, names: Sequence[str]) -> list[str]:
    """The names of inner values in a network's file, of their names in the file that training wrote."""
    ending = DEQUANTIZED if network.facts.get("arithmetic") == INT8 else ""
    return [f"{name}{ending}" for name in names]


def look_again(
    answer: Answer, pixels: NDArray[np.uint8], looked: FirstStageDetections, look: RefinerSettings, nms_iou: float
) -> Candidates:
    """`Refiner.refined`, by what `answer` gives."""
    found = looked.found
    count = min(look.most, int(np.count_nonzero(found.scores >= look.least)))
    if count == 0:
        return found
    seen = found.select(np.arange(count))
    size, window = (pixels.shape[1], pixels.shape[0]), windows(seen.boxes)
    sides = answer(
        closeups(pixels, window, look.side),
        surroundings(looked.inner, window, looked.fit),
        places(seen.boxes, seen.scores, seen.classes, look.classes, size),
    )
    boxes = np.concatenate([moved(seen.boxes, sides, size), found.boxes[count:]])
    kept = class_wise_nms(boxes, found.scores, found.classes, (1 + nms_iou) / 2)
    return Candidates(boxes, found.scores, found.classes).select(kept)
