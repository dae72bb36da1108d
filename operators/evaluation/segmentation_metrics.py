"""Scores segmentation against ground truth."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from dataflow.messages import SegmentationMap
from dataflow.operator import Batch, Duration, In, Operator, Param
from operators.evaluation.figures import Figures, check_names, check_view
from operators.evaluation.pairing import Pairing
from operators.segmentation.score import Confusion, class_iou


class SegmentationMetrics(Figures, Operator):
    """Counts how pixels of each true class were classified and computes the IoU of each class when the maps end.

    Frames are paired each with the truth nearest in time within `tolerance`; frames without a partner are counted and
    not scored. The IoU of a class is over all pixels of all frames; `miou` is the mean over the classes that the truth
    shows. Classes are matched by name (by id where neither side has names), so their order may differ. A pixel whose
    class was found to be void, or one that the truth does not name, is a miss of its true class; a class that the truth
    shows and the segmenter does not know counts with IoU 0 and is listed as `unknown_classes`. Pixels that are void in
    the truth are not judged. A map that is a smaller or larger version of the truth's is scaled to it, without
    interpolation.

    Method: Everingham et al., "The Pascal visual object classes challenge", 2010: intersection over union.
    """

    segmentation: In[SegmentationMap] = In(doc="the class maps to score")
    truth: Batch[SegmentationMap] = Batch(doc="the true class maps of the same camera")

    tolerance: Duration = Param("1ms", doc="farthest in time that the truth of a frame may be")
    lateness: Duration = Param("1s", doc="truth may arrive so much later than the map it belongs to; kept in memory")
    out: str | None = Param(None, doc="JSON file for the figures and the IoU of each class; its folder is made")

    def setup(self) -> None:
        super().setup()
        self._pairing: Pairing[SegmentationMap, SegmentationMap] = Pairing(self.tolerance)
        self._pixels: Counter[tuple[str, str | None]] = Counter()
        self._known: set[str] = set()

    def process(self, segmentation: SegmentationMap, truth: tuple[SegmentationMap, ...]) -> None:
        """Raises ValueError where result and truth are of different cameras or views, or only one has names."""
        for true in truth:
            check_view(_view(segmentation), _view(true))
            check_names(segmentation.class_names, true.class_names)
            self._pairing.add_truth(true.stamp, true)
        self._pairing.add_found(segmentation.stamp, segmentation)
        self._known.update(segmentation.class_names)
        self._count(self._pairing.settle(segmentation.stamp - self.lateness))

    def finish(self) -> None:
        """Computes the figures and writes the file."""
        self._count(self._pairing.finish())
        names = sorted({true for true, _ in self._pixels} | {found for _, found in self._pixels if found is not None})
        table = self._table(names)
        classes = {name: float(iou) for name, iou in zip(names, class_iou(table), strict=True) if np.isfinite(iou)}
        self._figures = {
            "frames": self._pairing.pairs,
            "unmatched_segmentations": self._pairing.unmatched_found,
            "unmatched_truths": self._pairing.unmatched_truths,
            "pixels": int(table.sum()),
        }
        if classes:
            self._figures |= self._averages(classes, table)
        else:
            self._figures["miou"] = "not computed: the paired frames hold no pixel whose true class is known"
        if self.out is not None:
            file = Path(self.out).expanduser()
            file.parent.mkdir(parents=True, exist_ok=True)
            written = {"figures": self._figures, "class_iou": classes}
            file.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")

    def _count(self, pairs: list[tuple[SegmentationMap, SegmentationMap]]) -> None:
        for found, true in pairs:
            self._pixels.update(_counted(found, true))

    def _table(self, names: list[str]) -> Confusion:
        number: dict[str | None, int] = {name: k for k, name in enumerate(names)} | {None: len(names)}
        table = np.zeros((len(names), len(names) + 1), np.int64)
        for (true, found), count in self._pixels.items():
            table[number[true], number[found]] = count
        return table

    def _averages(self, classes: Mapping[str, float], table: Confusion) -> dict[str, float | int | str]:
        worst = sorted(classes, key=lambda name: (classes[name], name))
        figures: dict[str, float | int | str] = {
            "miou": float(np.mean(list(classes.values()))),
            "pixel_accuracy": float(np.trace(table) / table.sum()),
            "worst_class": worst[0],
            "worst_class_iou": classes[worst[0]],
            "class_iou": ", ".join(f"{name} {classes[name]:.3f}" for name in worst),
        }
        unknown = set(classes) - self._known
        if self._known and unknown:
            figures["unknown_classes"] = ", ".join(sorted(unknown))
            if len(unknown) < len(classes):
                figures["miou_known_classes"] = float(
                    np.mean([classes[name] for name in classes if name not in unknown])
                )
        return figures


def _view(message: SegmentationMap) -> tuple[str, int, int]:
    height, width = message.classes.shape
    return message.frame, width, height


def _counted(found: SegmentationMap, true: SegmentationMap) -> dict[tuple[str, str | None], int]:
    """Pixels by true class and found class (None: void, or not a class of the truth)."""
    height, width = true.classes.shape
    given = found.classes.astype(np.uint16, copy=False)
    if given.shape != true.classes.shape:
        given = np.asarray(cv2.resize(given, (width, height), interpolation=cv2.INTER_NEAREST_EXACT), np.uint16)
    codes, counts = np.unique(true.classes.astype(np.uint32) << 16 | given, return_counts=True)
    pixels: Counter[tuple[str, str | None]] = Counter()
    for code, count in zip(codes.tolist(), counts.tolist(), strict=True):
        name = _name(true, code >> 16)
        if name is not None:
            guess = _name(found, code & 0xFFFF)
            pixels[name, guess if not true.class_names or guess in true.class_names else None] += count
    return pixels


def _name(message: SegmentationMap, class_id: int) -> str | None:
    """Name of a class id, its number as text where classes have no names; None for void."""
    if class_id == message.void:
        return None
    return message.class_names[class_id] if message.class_names else str(class_id)
