"""Tracking of image boxes: two-stage association, births, deaths, identities."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import TrackState
from dataflow.operator import Remembered
from operators.tracking.assignment import assign, log_odds, overlap
from operators.tracking.box_filter import BoxFilter, BoxNoise, boxes_of, predict

Array = NDArray[np.float64]
_MOST = 4.0  # evidence is bounded, so that a long life does not hide a present absence


@dataclass(frozen=True)
class BoxTrackerSettings:
    """Parameters of the association and of the lives of tracks.

    `strong` parts detections into those that may begin a track and those that only continue one; `birth` is the least
    score that begins one. Overlaps are least IoUs of each stage; `reach` grows boxes by this share of their size in the
    last stage. Evidence is the sum of the log odds of a track's detections; it falls by `fade` a second unseen.
    `filter` is the class of the Kalman filters.
    """

    strong: float = 0.5
    birth: float = 0.55
    strong_overlap: float = 0.4
    weak_overlap: float = 0.35
    reach: float = 0.3
    reach_overlap: float = 0.2
    confirm: float = 0.8
    fade: float = 20.0
    memory: float = 2.0
    appearance: float = 0.3
    noise: BoxNoise = field(default_factory=BoxNoise)
    filter: type[BoxFilter] = BoxFilter


@dataclass
class BoxTrack:
    """One object that is followed. Times in nanoseconds; `evidence` in log odds.

    `row` is that of the detection that it was matched with now, -1 for none. `twins` are the ids of tracks that it was
    never seen apart from: they may be of the same object.
    """

    id: int
    filter: BoxFilter
    class_id: int
    evidence: float
    born: int
    seen: int
    state: TrackState
    hits: int = 1
    feature: Array | None = None
    row: int = -1
    twins: set[int] = field(default_factory=set)

    @property
    def score(self) -> float:
        """Probability that the object is there, from its evidence."""
        return 1 / (1 + math.exp(-self.evidence))


class BoxTracker(Remembered):
    """Follows boxes through an image stream.

    Strong detections are matched with all tracks by the overlap with predicted boxes and, where there are feature
    vectors, their cosine. Confirmed tracks that are left are matched with strong detections that are left, by the
    overlap of enlarged boxes (Yang et al., "Hard to track objects with irregular motions", 2023), then with weak ones
    (Zhang et al., "ByteTrack", 2022). Boxes of different classes never match.

    Detectors give some objects two strong boxes in one image, and weak ones beside a strong one. So a track that begins
    over another of its class is its twin until both have strong detections that overlap too little to be of one track.
    Until then weak boxes are not evidence for the one while the other has a strong detection; if the evidence for it
    is used up, they are one track, which keeps the older id.
    """

    tracks: list[BoxTrack]
    _next: int
    _stamp: int | None

    def __init__(self, settings: BoxTrackerSettings) -> None:
        self._settings = settings
        self.tracks, self._next, self._stamp = [], 1, None

    def new_part(self, kind: type[Any]) -> BoxFilter:
        return self._settings.filter(np.array([0.0, 0, 1, 1]), 1.0, self._settings.noise)

    def update(
        self,
        stamp: int,
        boxes: Array,
        scores: Array,
        class_ids: NDArray[np.int32],
        size: tuple[int, int],
        features: Array | None = None,
    ) -> list[BoxTrack]:
        """Takes the detections of one image: boxes (N, 4), scores and classes (N,), unit vectors (N, D).

        Returns the tracks, with those that end now, in the order of their ids.
        """
        s = self._settings
        seconds = 0.0 if self._stamp is None else (stamp - self._stamp) * 1e-9
        self._stamp = stamp
        predict([t.filter for t in self.tracks], s.noise, seconds)
        free = set(range(len(self.tracks)))
        strong = [k for k in range(len(boxes)) if scores[k] >= s.strong]
        weak = [k for k in range(len(boxes)) if scores[k] < s.strong]
        taken: dict[int, int] = {}
        self._match(taken, free, strong, boxes, class_ids, s.strong_overlap, 0.0, features)
        known = {i for i in free if self.tracks[i].state != TrackState.TENTATIVE}
        left = [k for k in strong if k not in taken.values()]
        self._match(taken, known, left, boxes, class_ids, s.reach_overlap, s.reach, features)
        self._part(taken, boxes)
        strongly = {self.tracks[i].id for i in taken}
        known = {i for i in known if not self.tracks[i].twins & strongly}
        self._match(taken, known, weak, boxes, class_ids, s.weak_overlap, 0.0, None)
        for i, k in taken.items():
            self._see(self.tracks[i], stamp, boxes[k], float(scores[k]), None if features is None else features[k])
        for i, track in enumerate(self.tracks):
            track.row = taken.get(i, -1)
            if i not in taken:
                self._miss(track, stamp, seconds, size)
        matched = set(taken.values())
        for k in strong:
            if k not in matched and scores[k] >= s.birth:
                feature = None if features is None else features[k]
                self._begin(stamp, boxes[k], float(scores[k]), int(class_ids[k]), feature, k)
        self._join_twins(strongly)
        result = sorted(self.tracks, key=lambda t: t.id)
        self.tracks = [t for t in result if t.state != TrackState.ENDED]
        alive = {t.id for t in self.tracks}
        for track in self.tracks:
            track.twins &= alive
        return result

    def forget(self) -> None:
        """Drops all tracks; their ids are not used again."""
        self.tracks, self._stamp = [], None

    def _match(
        self,
        taken: dict[int, int],
        free: set[int],
        detections: list[int],
        boxes: Array,
        class_ids: NDArray[np.int32],
        least: float,
        grow: float,
        features: Array | None,
    ) -> None:
        """Matches free tracks with detections; moves what fits from `free` to `taken`."""
        rows = sorted(free)
        if not rows or not detections:
            return
        tracks = [self.tracks[i] for i in rows]
        found = boxes[detections]
        close = overlap(_grown(boxes_of([t.filter for t in tracks]), grow), _grown(found, grow))
        same = np.array([t.class_id for t in tracks])[:, None] == class_ids[detections][None, :]
        value = close
        if features is not None and self._settings.appearance > 0:
            alike = np.array([[_cosine(t.feature, features[k]) for k in detections] for t in tracks])
            value = (1 - self._settings.appearance) * close + self._settings.appearance * alike
        for a, b in assign(value, (close >= least) & same):
            taken[rows[a]] = detections[b]
            free.discard(rows[a])

    def _part(self, taken: Mapping[int, int], boxes: Array) -> None:
        """Parts twins whose strong detections, by index of track, overlap too little to be of one track."""
        by_id = {self.tracks[i].id: i for i in taken}
        for i, k in taken.items():
            track = self.tracks[i]
            for twin in sorted(track.twins & by_id.keys()):
                j = by_id[twin]
                if overlap(boxes[[k]], boxes[[taken[j]]])[0, 0] < self._settings.strong_overlap:
                    track.twins.discard(twin)
                    self.tracks[j].twins.discard(track.id)

    def _join_twins(self, strongly: Collection[int]) -> None:
        """Makes one of each track whose evidence is used up and a twin that has a strong detection now."""
        for track in self.tracks:
            seen = [t for t in self.tracks if t.id in track.twins and t.id in strongly]
            if seen and track.row < 0 and track.evidence < 0:
                self._join(track, seen[0])

    def _join(self, lost: BoxTrack, kept: BoxTrack) -> None:
        """Ends one of two twins; the other one has the older id and what either was never seen apart from."""
        older, younger = sorted((lost, kept), key=lambda t: t.id)
        if lost.state == TrackState.COASTING:  # it was confirmed
            kept.state = TrackState.CONFIRMED
        others = (lost.twins | kept.twins) - {lost.id, kept.id}
        (kept.id, kept.born), (lost.id, lost.born) = (older.id, older.born), (younger.id, younger.born)
        kept.twins, lost.twins, lost.state = others, set(), TrackState.ENDED
        for track in self.tracks:
            if track.id in others:
                track.twins.add(kept.id)

    def _see(self, track: BoxTrack, stamp: int, box: Array, score: float, feature: Array | None) -> None:
        track.filter.update(box, score)
        track.evidence = min(max(track.evidence, 0.0) + log_odds(score), _MOST)
        track.seen, track.hits = stamp, track.hits + 1
        if track.state != TrackState.TENTATIVE or track.evidence >= self._settings.confirm:
            track.state = TrackState.CONFIRMED
        if feature is not None:
            mixed = feature if track.feature is None else 0.9 * track.feature + 0.1 * feature
            track.feature = mixed / max(float(np.linalg.norm(mixed)), 1e-12)

    def _miss(self, track: BoxTrack, stamp: int, seconds: float, size: tuple[int, int]) -> None:
        track.evidence -= self._settings.fade * seconds
        track.filter.hold_size()
        unseen = (stamp - track.seen) * 1e-9
        if track.state == TrackState.TENTATIVE:
            ended = track.evidence < -1
        else:
            track.state = TrackState.COASTING
            x, y = track.filter.mean[:2, 0]
            ended = unseen > self._settings.memory or not (0 <= x <= size[0] and 0 <= y <= size[1])
        if ended:
            track.state = TrackState.ENDED

    def _begin(self, stamp: int, box: Array, score: float, class_id: int, feature: Array | None, row: int) -> None:
        evidence = log_odds(score)
        state = TrackState.CONFIRMED if evidence >= self._settings.confirm else TrackState.TENTATIVE
        filter = self._settings.filter(box, score, self._settings.noise)
        track = BoxTrack(self._next, filter, class_id, evidence, stamp, stamp, state, feature=feature, row=row)
        known = [t for t in self.tracks if t.class_id == class_id and t.state != TrackState.ENDED]
        over = overlap(box[None], boxes_of([t.filter for t in known]))[0] >= self._settings.strong_overlap
        for twin in [t for t, near in zip(known, over.tolist(), strict=True) if near]:
            twin.twins.add(track.id)
            track.twins.add(twin.id)
        self.tracks.append(track)
        self._next += 1


def _grown(boxes: Array, share: float) -> Array:
    size = boxes[:, 2:] - boxes[:, :2]
    return np.concatenate([boxes[:, :2] - share * size, boxes[:, 2:] + share * size], axis=1)


def _cosine(known: Array | None, feature: Array) -> float:
    """Likeness in [0, 1]; a half where the track has no vector yet."""
    return 0.5 if known is None else (1 + float(known @ feature)) / 2
