"""Scores detections against ground truth."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D
from dataflow.operator import Batch, Duration, In, Operator, Param
from operators.evaluation.detection_score import ClassScore, DetectionScore, ScoredFrame, precision, recall
from operators.evaluation.figures import Figures, check_names, check_view
from operators.evaluation.pairing import Pairing


class DetectionMetrics(Figures, Operator):
    """Collects detections and the true objects and computes COCO's AP50 and AP50:95 when the detections end.

    Frames are paired after the fact, each with the truth nearest in time within `tolerance`; frames without a partner
    are counted and not scored. Classes are matched by name (by id where neither side has names), so their order may
    differ. A class that the truth holds and the detector does not know counts with AP 0 and is listed as
    `unknown_classes`, then `ap50_known_classes` is the mean without such classes. Detections of classes that the truth
    does not name cannot be judged: they are counted as `detections_not_judged`. Boxes in a smaller or larger version
    of the truth's image are scaled to it.

    True objects that are mostly hidden or tiny are ignored: missing one is no miss, and a detection that matches one
    is no false positive, as COCO treats objects outside of its area range. It takes the share or the count in the
    truth message; without them the limit does not apply. AP asks for the whole curve, so run the detector with a low
    score threshold (0.01) and give the one of your robot here, for precision and recall.

    Method: Lin et al., "Microsoft COCO: common objects in context", 2014, by pycocotools.
    """

    detections: In[Detections2D] = In(doc="the boxes to score")
    truth: Batch[Detections2D] = Batch(doc="the true boxes of the same camera")

    tolerance: Duration = Param("1ms", doc="farthest in time that the truth of a frame may be")
    min_visible: float = Param(0.6, ge=0, le=1, doc="true objects with a smaller visible share are ignored")
    min_pixels: int = Param(200, ge=0, doc="true objects with fewer visible pixels are ignored", unit="px")
    max_detections: int = Param(100, ge=1, doc="score the best so many of an image and class")
    score_threshold: float = Param(0.3, ge=0, le=1, doc="operating point: precision and recall are of these and better")
    iou: float = Param(0.5, gt=0, le=1, doc="overlap at which precision and recall take a box for right")
    out: str | None = Param(None, doc="JSON file for the figures and a table of the classes; its folder is made")

    def setup(self) -> None:
        super().setup()
        self._pairs: Pairing[Detections2D, Detections2D] = Pairing(self.tolerance)
        self._score = DetectionScore(
            max_detections=self.max_detections, iou=self.iou, score_threshold=self.score_threshold
        )
        self._known_to: int | None = None
        self._known: set[str] = set()
        self._classes: set[str] = set()

    def process(self, detections: Detections2D, truth: tuple[Detections2D, ...]) -> None:
        """Raises ValueError where detections and truth are of different cameras or views, or only one has names."""
        for true in truth:
            check_view(_view(detections), _view(true))
            if detections.count and true.count:
                check_names(detections.class_names, true.class_names)
            self._classes.update(true.class_names or true.labels())
            self._pairs.add_truth(true.stamp, true)
        self._known.update(detections.class_names)
        self._pairs.add_found(detections.stamp, detections)
        if truth:
            self._known_to = truth[-1].stamp
        if self._known_to is not None:  # in a live run the truth may come late
            self._take(self._pairs.settle(min(self._known_to, detections.stamp)))

    def finish(self) -> None:
        """Computes the figures and writes the file."""
        self._take(self._pairs.finish())
        classes = self._score.classes(sorted(self._classes))
        self._figures = {
            "frames": self._score.frames,
            "unmatched_detections": self._pairs.unmatched_found,
            "unmatched_truths": self._pairs.unmatched_truths,
            "truth_objects": sum(score.truth for score in classes.values()),
            "ignored_objects": sum(score.ignored for score in classes.values()),
            "detections": sum(score.detections for score in classes.values()),
        } | self._averages(classes)
        beyond = {name: n for name, n in self._score.detections().items() if name not in self._classes}
        if beyond:
            self._figures["detections_not_judged"] = sum(beyond.values())
            self._figures["classes_not_in_truth"] = ", ".join(sorted(beyond))
        if self.out is not None:
            self._write(Path(self.out).expanduser(), classes)

    def _ignored(self, truth: Detections2D) -> NDArray[np.bool_]:
        ignored = np.zeros(truth.count, np.bool_)
        if truth.visible is not None:
            ignored |= truth.visible < np.float32(self.min_visible)
        if truth.pixel_counts is not None:
            ignored |= truth.pixel_counts < self.min_pixels
        return ignored

    def _take(self, pairs: list[tuple[Detections2D, Detections2D]]) -> None:
        for found, truth in pairs:
            self._score.add(_scored(found, truth, self._ignored(truth)))

    def _averages(self, classes: Mapping[str, ClassScore]) -> dict[str, float | int | str]:
        ap50 = {name: score.ap50 for name, score in classes.items() if score.ap50 is not None}
        if not ap50:
            return {"ap50": "not computed: the paired frames hold no true object that counts"}
        hits = sum(score.hits for score in classes.values())
        right = precision(hits, sum(score.false_alarms for score in classes.values()))
        found = recall(hits, sum(score.truth for score in classes.values()))
        worst = min(ap50, key=lambda name: (ap50[name], name))
        figures: dict[str, float | int | str] = {
            "ap50": float(np.mean(list(ap50.values()))),
            "ap50_95": float(np.mean([score.ap50_95 for score in classes.values() if score.ap50_95 is not None])),
            "worst_class": worst,
            "worst_class_ap50": ap50[worst],
            "score_threshold": self.score_threshold,
            "precision": f"not computed: no detection reaches {self.score_threshold:g}" if right is None else right,
            "recall": 0.0 if found is None else found,
        }
        unknown = set(ap50) - self._known
        if self._known and unknown:
            figures["unknown_classes"] = ", ".join(sorted(unknown))
            if len(unknown) < len(ap50):
                figures["ap50_known_classes"] = float(np.mean([ap50[name] for name in ap50 if name not in unknown]))
        return figures

    def _write(self, file: Path, classes: Mapping[str, ClassScore]) -> None:
        table = {
            name: asdict(score)
            | {
                "precision": precision(score.hits, score.false_alarms),
                "recall": recall(score.hits, score.truth),
                "known": name in self._known or not self._known,
            }
            for name, score in classes.items()
        }
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"figures": self._figures, "classes": table}, indent=2) + "\n", encoding="utf-8")


def _view(message: Detections2D) -> tuple[str, int, int]:
    return message.frame, message.width, message.height


def _scored(found: Detections2D, truth: Detections2D, ignored: NDArray[np.bool_]) -> ScoredFrame:
    scale = np.tile([truth.width / found.width, truth.height / found.height], 2)
    boxes = found.boxes.astype(np.float64) * scale
    return ScoredFrame(truth.boxes.astype(np.float64), truth.labels(), ignored, boxes, found.labels(), found.scores)
