"""Average precision, precision and recall of detections, by COCO's rules (Lin et al., ECCV 2014) with pycocotools."""

from __future__ import annotations

import contextlib
import io
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

_IGNORED_AREA = -1.0  # outside of COCO's area range, so neither a miss nor, when matched, a false positive
_AREA_RANGE = (0.0, 1e10)
_TOGETHER = 8
_BITS = 1 << np.arange(16)


@dataclass(frozen=True, eq=False)
class ScoredFrame:
    """Truth and detections of one image: boxes (N, 4) as corners in pixels of one image, class names (N,)."""

    truth_boxes: NDArray[np.float64]
    truth_labels: tuple[str, ...]
    ignored: NDArray[np.bool_]
    boxes: NDArray[np.float64]
    labels: tuple[str, ...]
    scores: NDArray[np.float32]


@dataclass(frozen=True)
class ClassScore:
    """Scores of one class. APs are None where the truth has no object that counts.

    `hits` and `false_alarms` count the detections at the operating point; those on ignored objects are neither.
    """

    truth: int
    ignored: int
    detections: int
    ap50: float | None
    ap50_95: float | None
    hits: int
    false_alarms: int


def precision(hits: int, false_alarms: int) -> float | None:
    """Share of the detections that are right; None without any."""
    return hits / (hits + false_alarms) if hits + false_alarms else None


def recall(hits: int, truth: int) -> float | None:
    """Share of the objects that were found; None without any."""
    return hits / truth if truth else None


def score_frames(
    frames: Iterable[ScoredFrame], classes: Sequence[str], *, max_detections: int, iou: float, score_threshold: float
) -> dict[str, ClassScore]:
    """The score of each class (`DetectionScore`); objects and detections of other classes are left out."""
    score = DetectionScore(max_detections=max_detections, iou=iou, score_threshold=score_threshold)
    for frame in frames:
        score.add(frame)
    return score.classes(classes)


class DetectionScore:
    """Scores frames as they come: COCOeval matches the boxes of every `_TOGETHER` frames, and of each detection only
    its score and what it was matched to are kept, 8 bytes; so a score may last for hours, and is soon there at its end.

    AP50 is the average precision at IoU 0.5, AP50:95 its mean over IoU 0.5, 0.55 ... 0.95; the operating point is all
    detections of at least `score_threshold`, matched at `iou`. `max_detections` holds for an image and class. An
    ignored object takes at most one detection, by plain IoU: as COCO treats objects outside of its area range, and
    not as its crowds, which would swallow every box inside of them.
    """

    def __init__(self, *, max_detections: int, iou: float, score_threshold: float) -> None:
        from pycocotools.coco import COCO
        from pycocotools.cocoeval import COCOeval

        self._coco, self._eval = COCO, COCOeval
        self._max_detections, self._iou, self._threshold = max_detections, iou, score_threshold
        self._waiting: list[ScoredFrame] = []
        self._matched: dict[str, _Matched] = {}
        self.frames = 0

    def add(self, frame: ScoredFrame) -> None:
        """Takes the next frame."""
        self.frames += 1
        self._waiting.append(frame)
        if len(self._waiting) == _TOGETHER:
            self._match()

    def detections(self) -> dict[str, int]:
        """Counts the detections of every class name, of the truth or not."""
        self._match()
        return {name: matched.detections for name, matched in self._matched.items() if matched.detections}

    def classes(self, names: Sequence[str]) -> dict[str, ClassScore]:
        """The score of each of some classes; objects and detections of others are left out."""
        self._match()
        matched = {name: self._matched.get(name) or _Matched() for name in names}
        if not names:
            return {}
        evaluation = self._evaluation(None, None)
        evaluation.params.imgIds, evaluation.params.catIds = [0], list(range(len(names)))
        evaluation.params.maxDets = [max(1, *(len(m.scores) for m in matched.values()))]  # each image has had its limit
        evaluation._paramsEval = evaluation.params
        evaluation.evalImgs = [m.as_one_image(len(evaluation.params.iouThrs)) for m in matched.values()]
        with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
            evaluation.accumulate()
        curves = evaluation.eval["precision"][:-1, :, :, 0, 0]  # IoU, recall, class; the last IoU is `iou`
        lowest = float(np.float32(self._threshold))  # scores are float32
        return {name: matched[name].score(curves[:, :, k], lowest) for k, name in enumerate(names)}

    def _evaluation(self, truth: COCO | None, found: COCO | None) -> COCOeval:
        evaluation = self._eval(truth, found, "bbox")
        params = evaluation.params
        params.iouThrs = np.append(params.iouThrs, self._iou)
        params.maxDets = [self._max_detections]
        params.areaRng, params.areaRngLbl = [list(_AREA_RANGE)], ["all"]
        return evaluation

    def _match(self) -> None:
        """Matches the frames that wait, each class by itself."""
        frames, self._waiting = self._waiting, []
        if not frames:
            return
        names = sorted({name for frame in frames for name in (*frame.truth_labels, *frame.labels)})
        numbers = {name: k for k, name in enumerate(names)}
        images = [{"id": k} for k in range(len(frames))]
        categories = [{"id": k, "name": name} for name, k in numbers.items()]
        truths, found = list(_truths(frames, numbers)), list(_found(frames, numbers))
        with contextlib.redirect_stdout(io.StringIO()):
            parts = (_coco(self._coco(), images, categories, rows) for rows in (truths, found))
            evaluation = self._evaluation(*parts)
            evaluation.evaluate()
        by_number = [self._matched.setdefault(name, _Matched()) for name in names]
        for row in truths:
            by_number[row["category_id"]].truths[row["area"] < 0] += 1
        for row in found:
            by_number[row["category_id"]].detections += 1
        for image in evaluation.evalImgs:
            if image is not None:
                by_number[image["category_id"]].take(image)


class _Matched:
    """Holds what COCOeval found of one class, images in order: of each detection its score and, a bit for each IoU,
    whether it was matched and whether it is ignored."""

    def __init__(self) -> None:
        self.scores, self.matches, self.ignored = array("f"), array("H"), array("H")
        self.truths = [0, 0]
        """Objects that count, and ignored ones."""
        self.detections = 0
        """All of them, also those beyond the limit of an image."""

    def take(self, image: Mapping[str, Any]) -> None:
        """Takes one image's result of `COCOeval.evaluateImg`."""
        if not image["dtScores"]:
            return
        self.scores.extend(image["dtScores"])
        for kept, flags in ((self.matches, image["dtMatches"] > 0), (self.ignored, image["dtIgnore"])):
            kept.frombytes((_BITS[: len(flags)] @ flags).astype(np.uint16).tobytes())

    def as_one_image(self, thresholds: int) -> dict[str, Any]:
        """Returns what `COCOeval.accumulate` takes, as if all detections were of one image."""
        bits = _BITS[:thresholds, None]
        return {
            "dtScores": np.frombuffer(self.scores, np.float32).astype(np.float64),
            "dtMatches": (np.frombuffer(self.matches, np.uint16) & bits) > 0,
            "dtIgnore": (np.frombuffer(self.ignored, np.uint16) & bits) > 0,
            "gtIgnore": np.repeat([0, 1], self.truths),
        }

    def score(self, curves: NDArray[np.float64], lowest: float) -> ClassScore:
        """`curves`: precision by IoU and recall; `lowest`: score of the operating point, matched at the last IoU.

        Matching is greedy by score, so weaker boxes change none.
        """
        counted, ignored = self.truths
        last = _BITS[len(curves)]
        judged = (np.frombuffer(self.scores, np.float32) >= lowest) & (
            np.frombuffer(self.ignored, np.uint16) & last == 0
        )
        matched = np.frombuffer(self.matches, np.uint16) & last > 0
        return ClassScore(
            counted,
            ignored,
            self.detections,
            float(curves[0].mean()) if counted else None,
            float(curves.mean()) if counted else None,
            int(np.count_nonzero(judged & matched)),
            int(np.count_nonzero(judged & ~matched)),
        )


def _truths(frames: Sequence[ScoredFrame], numbers: dict[str, int]) -> Iterator[dict[str, Any]]:
    for k, frame in enumerate(frames):
        for box, label, ignored in zip(frame.truth_boxes, frame.truth_labels, frame.ignored, strict=True):
            if label in numbers:
                row = _row(k, numbers[label], box)
                yield row | {"iscrowd": 0, "area": _IGNORED_AREA if ignored else row["area"]}


def _found(frames: Sequence[ScoredFrame], numbers: dict[str, int]) -> Iterator[dict[str, Any]]:
    for k, frame in enumerate(frames):
        for box, label, score in zip(frame.boxes, frame.labels, frame.scores, strict=True):
            if label in numbers:
                yield _row(k, numbers[label], box) | {"score": float(score)}


def _row(image: int, category: int, box: NDArray[np.float64]) -> dict[str, Any]:
    x1, y1, x2, y2 = box.tolist()
    size = (x2 - x1, y2 - y1)
    return {"image_id": image, "category_id": category, "bbox": [x1, y1, *size], "area": size[0] * size[1]}


def _coco(coco: COCO, images: Any, categories: Any, rows: list[dict[str, Any]]) -> COCO:
    for number, row in enumerate(rows, 1):  # COCOeval takes the id 0 for no match
        row["id"] = number
    coco.dataset = {"info": {}, "images": images, "categories": categories, "annotations": rows}
    coco.createIndex()
    return coco
