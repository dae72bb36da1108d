"""Average precision, precision and recall of detections, by COCO's rules (Lin et al., ECCV 2014)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Numbers = NDArray[np.int64]

AVERAGED: Floats = np.linspace(0.5, 0.95, 10)
"""The overlaps over which AP50:95 is the mean."""
_RECALLS: Floats = np.linspace(0.0, 1.0, 101)
_LARGEST = 1e10  # the greatest area that COCO's range "all" takes
_SAME = 1 - 1e-10  # an overlap of 1 may come out a little less


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


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes of all images, as left, top, width and height (N, 4); `group`: the number of their image and class."""

    group: Numbers
    boxes: Floats
    area: Floats

    @classmethod
    def of(cls, group: list[int], corners: list[Floats]) -> _Boxes:
        at = np.concatenate([np.zeros((0, 4)), *corners])
        size = at[:, 2:] - at[:, :2]
        return cls(np.array(group, np.int64), np.hstack([at[:, :2], size]), size[:, 0] * size[:, 1])

    def taken(self, order: Numbers) -> _Boxes:
        return _Boxes(self.group[order], self.boxes[order], self.area[order])


def precision(hits: int, false_alarms: int) -> float | None:
    """Share of the detections that are right; None without any."""
    return hits / (hits + false_alarms) if hits + false_alarms else None


def recall(hits: int, truth: int) -> float | None:
    """Share of the objects that were found; None without any."""
    return hits / truth if truth else None


def score_frames(
    frames: Sequence[ScoredFrame], classes: Sequence[str], *, max_detections: int, iou: float, score_threshold: float
) -> dict[str, ClassScore]:
    """The score of each class; objects and detections of other classes are left out.

    AP50 is the average precision at IoU 0.5, AP50:95 its mean over IoU 0.5, 0.55 ... 0.95; the operating point is all
    detections of at least `score_threshold`, matched at `iou`. `max_detections` holds for an image and class. An
    ignored object takes at most one detection, by plain IoU: as COCO treats objects outside of its area range, and
    not as its crowds, which would swallow every box inside of them.

    The figures are those of pycocotools to the last bit, which takes ten times as long.
    """
    if not frames or not classes:
        return {name: ClassScore(0, 0, 0, None, None, 0, 0) for name in classes}
    numbers, count = {name: k for k, name in enumerate(classes)}, len(classes)
    truth_group, truth_rows = _grouped([frame.truth_labels for frame in frames], numbers)
    truth = _Boxes.of(truth_group, [f.truth_boxes[rows] for f, rows in zip(frames, truth_rows, strict=True)])
    marked = np.concatenate([f.ignored[rows] for f, rows in zip(frames, truth_rows, strict=True)]).astype(np.bool_)
    marked |= truth.area < 0
    found_group, found_rows = _grouped([frame.labels for frame in frames], numbers)
    found = _Boxes.of(found_group, [f.boxes[rows] for f, rows in zip(frames, found_rows, strict=True)])
    scores = np.concatenate([f.scores[rows] for f, rows in zip(frames, found_rows, strict=True)]).astype(np.float64)
    detections = np.bincount(found.group % count, minlength=count)

    ignored = marked | (truth.area > _LARGEST)
    order = np.lexsort((ignored, truth.group))  # those that count come first
    sorted_truth, sorted_ignored = truth.taken(order), ignored[order]
    order = np.lexsort((-scores, found.group))
    order = order[_rank(found.group[order]) < max_detections]
    found, scores = found.taken(order), scores[order]
    overlaps = np.append(AVERAGED, iou)
    matched, left_out = _matches(found, sorted_truth, sorted_ignored, overlaps)
    left_out |= ~matched & ((found.area < 0) | (found.area > _LARGEST))

    lowest = float(np.float32(score_threshold))  # scores are float32
    of_class, truth_class = found.group % count, truth.group % count
    curves = np.full((len(AVERAGED), len(_RECALLS), count), -1.0)
    result = {}
    for name, k in numbers.items():
        own = np.flatnonzero(of_class == k)
        counted = (scores[own] >= lowest) & ~left_out[-1, own]
        hits = int(np.count_nonzero(counted & matched[-1, own]))
        positives = int(np.count_nonzero((truth_class == k) & ~ignored))
        if positives:
            own = own[np.argsort(-scores[own], kind="stable")]
            curves[:, :, k] = _curves(matched[:-1, own], left_out[:-1, own], positives)
        objects, passed = int(np.count_nonzero(truth_class == k)), int(np.count_nonzero(marked & (truth_class == k)))
        scored = objects > passed
        result[name] = ClassScore(
            objects - passed,
            passed,
            int(detections[k]),
            float(curves[0, :, k].mean()) if scored else None,
            float(curves[:, :, k].mean()) if scored else None,
            hits,
            int(np.count_nonzero(counted)) - hits,
        )
    return result


def _grouped(labels: Sequence[tuple[str, ...]], numbers: dict[str, int]) -> tuple[list[int], list[list[int]]]:
    """Returns the group of every row of a known class, over all images, and those rows of each image."""
    groups: list[int] = []
    rows: list[list[int]] = []
    for image, names in enumerate(labels):
        first = image * len(numbers)
        known = [row for row, name in enumerate(names) if name in numbers]
        groups += [first + numbers[names[row]] for row in known]
        rows.append(known)
    return groups, rows


def _rank(groups: Numbers) -> Numbers:
    """Returns the place of each row in its group; `groups` is sorted."""
    return np.arange(len(groups)) - np.searchsorted(groups, groups)


def _matches(found: _Boxes, truth: _Boxes, ignored: Flags, overlaps: Floats) -> tuple[Flags, Flags]:
    """Matches the detections of each group, best first, at every overlap: which took an object, and which of those an
    ignored one, (overlaps, detections) each."""
    least = np.minimum(overlaps, _SAME)
    matched = np.zeros((len(overlaps), len(found.group)), np.bool_)
    left_out = np.zeros_like(matched)
    near = list(_near(found, truth, float(least.min())))
    passed = ignored.tolist()
    for row, needed in enumerate(least.tolist()):
        taken: set[int] = set()
        for detection, candidates in near:
            best, place = needed, -1
            for object_, overlap in candidates:
                if object_ in taken:
                    continue
                if place >= 0 and passed[object_] and not passed[place]:
                    break  # an object that counts goes before every ignored one
                if overlap >= best:
                    best, place = overlap, object_
            if place >= 0:
                taken.add(place)
                matched[row, detection], left_out[row, detection] = True, passed[place]
    return matched, left_out


def _near(found: _Boxes, truth: _Boxes, least: float) -> Iterator[tuple[int, list[tuple[int, float]]]]:
    """Yields the detections that overlap objects of their group by `least` or more, with those and the overlaps."""
    first = np.searchsorted(truth.group, found.group)
    many = np.searchsorted(truth.group, found.group, side="right") - first
    detection = np.repeat(np.arange(len(found.group)), many)
    object_ = np.arange(len(detection)) - np.repeat(np.cumsum(many) - many, many) + np.repeat(first, many)
    overlap = _iou(found.boxes[detection], found.area[detection], truth.boxes[object_], truth.area[object_])
    kept = overlap >= least
    candidates: dict[int, list[tuple[int, float]]] = {}
    for d, o, value in zip(detection[kept].tolist(), object_[kept].tolist(), overlap[kept].tolist(), strict=True):
        candidates.setdefault(d, []).append((o, value))
    yield from candidates.items()


def _iou(a: Floats, a_area: Floats, b: Floats, b_area: Floats) -> Floats:
    """Intersection over union of boxes, row by row."""
    size = np.minimum(a[:, 2:] + a[:, :2], b[:, 2:] + b[:, :2]) - np.maximum(a[:, :2], b[:, :2])
    both = np.where((size > 0).all(1), size[:, 0] * size[:, 1], 0.0)
    union = a_area + b_area - both
    return np.divide(both, union, out=np.zeros_like(both), where=both > 0)


def _curves(matched: Flags, left_out: Flags, positives: int) -> Floats:
    """Returns the precision at each recall of COCO (overlaps, recalls), of detections in the order of their scores."""
    hits = np.cumsum(matched & ~left_out, axis=1).astype(np.float64)
    alarms = np.cumsum(~matched & ~left_out, axis=1).astype(np.float64)
    reached = hits / positives
    right = hits / (alarms + hits + np.spacing(1))
    right = np.maximum.accumulate(right[:, ::-1], axis=1)[:, ::-1]
    right = np.hstack([right, np.zeros((len(right), 1))])
    places = [np.searchsorted(each, _RECALLS, side="left") for each in reached]
    return np.take_along_axis(right, np.stack(places), axis=1)
