"""Images of the bundled recording with what the shipped detector finds in them and what is there."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import dataflow
from dataflow.messages import Detections2D, Image
from operators.codec import ImageDecoder
from operators.detection import CustomDetector
from operators.detection.nms import intersection_over_union

DEMO = Path(__file__).parents[2] / "recordings" / "demo.mcap"
LEAST_VISIBLE, LEAST_PIXELS = 0.4, 60


class Drive:
    """Images of the bundled recording with the detector's boxes and the true ones, of its first seconds."""

    def __init__(self) -> None:
        streams, decoder, detector = dataflow.open(DEMO), ImageDecoder(), CustomDetector(score_threshold=0.1)
        for operator in (decoder, detector):
            operator.setup()
        truth = {m.stamp: m for m in streams["robot1/robot/objects"]}
        self.images: list[Image] = []
        self.detections: list[Detections2D] = []
        self.truth: list[Detections2D] = []
        for compressed in list(streams["robot1/robot/image_jpeg"])[:60:6]:
            self.images.append(decoder.decode(compressed))
            self.detections.append(detector.process(self.images[-1]))
            self.truth.append(truth[compressed.stamp])


def right(drive: Drive, made: list[Detections2D], names: tuple[str, ...]) -> tuple[int, int, int]:
    """Counts true things of some classes that are plainly seen, those with a box of their class, and boxes that have no
    thing."""
    counted = found = wrong = 0
    for truth, given_ in zip(drive.truth, made, strict=True):
        labels = truth.labels()
        assert truth.visible is not None
        assert truth.pixel_counts is not None
        plain = (truth.visible >= LEAST_VISIBLE) & (truth.pixel_counts >= LEAST_PIXELS)
        own = [(box, label) for box, label, score in zip(given_.boxes, given_.labels(), given_.scores, strict=True)
               if label in names and score >= 0.3]  # fmt: skip
        for k in np.flatnonzero(plain):
            if labels[k] in names:
                counted += 1
                same = np.array([box for box, label in own if label == labels[k]], np.float32).reshape(-1, 4)
                found += bool((intersection_over_union(truth.boxes[k], same) >= 0.5).any())
        for box, label in own:
            same = truth.boxes[[each == label for each in labels]]
            wrong += not (intersection_over_union(box, same) >= 0.5).any()
    return counted, found, wrong
