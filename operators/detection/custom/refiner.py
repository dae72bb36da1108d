"""A second look at each box that a grid detector found: where its sides are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operators.detection.custom.closeup import closeups, moved, numbers, places, windows
from operators.detection.custom.first_look import Looked
from operators.detection.custom.surroundings import surroundings
from operators.detection.decode import Candidates
from operators.detection.nms import class_wise_nms
from operators.weights import Network, NetworkFileError, open_second

if TYPE_CHECKING:
    import onnxruntime

KIND = "refiner"
INT8, DEQUANTIZED = "int8", "_DequantizeLinear_Output"
"""The word for 8 bits in a network's metadata, and the ending of its inner values' names."""
Answer = Callable[[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]
"""(close-ups, surroundings, places) → by which shares of the windows the sides move (N, 4)."""


@dataclass(frozen=True)
class Look:
    """Settings of a second look, at the best `most` boxes of `classes` classes that score at least `least`: close-ups
    have `side` pixels along a side."""

    classes: int
    side: int
    least: float
    most: int


class Refiner:
    """A small network that sees the close-up of each box in the image's full resolution, and what the detector's inner
    maps tell of its surroundings.

    It moves the four sides; scores stay. One network for all classes, which is told the class. Method: Cai and
    Vasconcelos, "Cascade R-CNN", 2018: a second regression, from the boxes of the first.
    """

    def __init__(self, facts: dict[str, Any], session: onnxruntime.InferenceSession, network: Network) -> None:
        classes, side = len(facts["classes"]), int(facts["side"])
        self.look = Look(classes, side, float(facts["least_score"]), int(facts["most_boxes"]))
        self.maps = inner_names(network, facts["maps"])
        self._session = session
        shapes = {each.name: (each.type, list(each.shape[1:])) for each in session.get_inputs()}
        self._surroundings = shapes.get("surroundings", ("", [0]))[1]
        wanted = {
            "closeups": ("tensor(uint8)", [side, side, 3]),
            "surroundings": ("tensor(float)", self._surroundings),
            "places": ("tensor(float)", [numbers(classes)]),
        }
        if shapes != wanted:
            raise NetworkFileError(f"the second network in {network.file} must have the inputs {wanted}, has {shapes}")

    @classmethod
    def within(cls, network: Network) -> Refiner | None:
        """The refiner in a detector's file; None where it has none. Raises NetworkFileError."""
        second = open_second(network)
        if second is None:
            return None
        facts, session = second
        lacking = [name for name in ("side", "least_score", "most_boxes", "maps") if name not in facts]
        if facts["kind"] != KIND or lacking or tuple(facts["classes"]) != network.classes:
            raise NetworkFileError(
                f"the second network in {network.file} must be a refiner of the classes {network.classes}; it is a "
                f"{facts['kind']} of {facts['classes']}" + (f" without {', '.join(lacking)}" if lacking else "")
            )
        return cls(facts, session, network)

    def refined(self, pixels: NDArray[np.uint8], looked: Looked, nms_iou: float) -> Candidates:
        """The boxes in the pixels of an image (H, W, 3), RGB, after a second look, by falling score.

        Those that score less than `look.least`, and all but the best `look.most`, stay as they are. Boxes of a class
        that have come to overlap by more than halfway from `nms_iou` to 1 are one: they are around the same object,
        while boxes of neighbours may come to overlap by more than they did.
        """
        return look_again(self._answer, pixels, looked, self.look, nms_iou)

    def _answer(
        self, seen: NDArray[np.uint8], around: NDArray[np.float32], known: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        given = {"closeups": seen, "surroundings": around, "places": known}
        sides: NDArray[np.float32] = self._session.run(["sides"], given)[0]
        return sides


def inner_names(network: Network, names: Sequence[str]) -> list[str]:
    """The names of inner values in a network's file, of their names in the file that training wrote."""
    ending = DEQUANTIZED if network.facts.get("arithmetic") == INT8 else ""
    return [f"{name}{ending}" for name in names]


def look_again(answer: Answer, pixels: NDArray[np.uint8], looked: Looked, look: Look, nms_iou: float) -> Candidates:
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
