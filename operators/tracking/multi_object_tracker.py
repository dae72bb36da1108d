"""Tracking of objects in the image as an operator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Diagnostics, FeatureVector, Tracks, TrackState
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.status import counted_status
from operators.tracking.assignment import class_ids_of
from operators.tracking.box_filter import BoxFilter, BoxNoise, FilterpyBoxFilter, boxes_of
from operators.tracking.box_tracker import BoxTrack, BoxTracker, BoxTrackerSettings

Array = NDArray[np.float64]


@dataclass(kw_only=True)
class State(Counts):
    """Holds the tracks, what they are of, and the names of their classes in the order of their arrival."""

    tracker: BoxTracker
    view: tuple[str, int, int] | None = None
    classes: list[str] = field(default_factory=list)


class MultiObjectTracker(Operator):
    """Follows objects in the image: Kalman boxes, two-stage association, identities that outlast a short occlusion.

    A track is tentative until its detections make it probable, confirmed while it is matched, coasting on its predicted
    box while it is not, and listed once as ended. Its score is the probability that the object is there and visible.
    Boxes match only within their class. Detections may have any score: give the weak ones too. A detector may give one
    object two boxes: tracks that were never seen apart become one when only one of them still has strong detections.

    Method: Zhang et al., "ByteTrack: multi-object tracking by associating every detection box", 2022.
    """

    detections: In[Detections2D] = In(doc="boxes of one camera, weak ones included")
    features: Sampled[FeatureVector] = Sampled(
        required=False, doc="one vector for each detection, in their order and with their stamp; others are not used"
    )
    tracks: Out[Tracks] = Out(doc="tentative, confirmed, coasting and just ended tracks, by rising id")
    looks: Out[FeatureVector] = Out(
        doc="mean direction of the vectors of each track that was matched now, by its id; where `features` are used"
    )
    status: Out[Diagnostics] = Out(doc="tracks by state; a warning where boxes are unusable or the image size changes")

    strong: float = Param(0.5, ge=0, le=1, doc="weaker detections continue confirmed tracks and do nothing else")
    birth: float = Param(0.55, ge=0, le=1, doc="least score of a detection that begins a track")
    confirm: float = Param(0.8, ge=0, doc="evidence that confirms a track, the sum of its detections' log odds")
    memory: float = Param(2.0, gt=0, doc="a track ends that was not matched for so long", unit="s")
    strong_overlap: float = Param(0.4, gt=0, le=1, doc="least IoU of a strong detection with a track's predicted box")
    weak_overlap: float = Param(0.35, gt=0, le=1, doc="least IoU of a weak one")
    appearance: float = Param(0.3, ge=0, le=1, doc="weight of the likeness of vectors beside that of boxes")
    position_noise: float = Param(0.03, gt=0, doc="standard deviation of a box's middle, share of its height")
    acceleration: float = Param(4.0, gt=0, doc="standard deviation of its acceleration", unit="heights/s²")
    filter: Literal["numpy", "filterpy"] = Param("numpy", doc="what runs the Kalman filters; filterpy takes longer")
    state: State

    def initial_state(self) -> State:
        noise = BoxNoise(position=self.position_noise, acceleration=self.acceleration)
        tracker = BoxTracker(
            BoxTrackerSettings(
                strong=self.strong,
                birth=self.birth,
                confirm=self.confirm,
                memory=self.memory,
                strong_overlap=self.strong_overlap,
                weak_overlap=self.weak_overlap,
                appearance=self.appearance,
                noise=noise,
                filter=FilterpyBoxFilter if self.filter == "filterpy" else BoxFilter,
            )
        )
        return State(tracker=tracker)

    def process(self, detections: Detections2D, features: FeatureVector | None = None) -> dict[str, Any]:
        """Raises ValueError where boxes of another camera arrive."""
        view = (detections.frame, detections.width, detections.height)
        resized = self.state.view is not None and view[1:] != self.state.view[1:]
        if self.state.view is not None and view[0] != self.state.view[0]:
            raise ValueError(f"detections are of camera {view[0]}, those before were of {self.state.view[0]}")
        if resized:
            self.state.counts["image sizes changed"] += 1
            self.state.tracker.forget()
        self.state.view = view
        boxes = detections.boxes.astype(np.float64)
        usable = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        rows = np.flatnonzero(usable)
        vectors = self._vectors(detections, features, rows)
        tracks = self.state.tracker.update(
            detections.stamp,
            boxes[rows],
            detections.scores[rows].astype(np.float64),
            class_ids_of(detections, self.state.classes)[rows],
            view[1:],
            vectors,
        )
        counts = Counter(t.state.name.lower() for t in tracks)
        counts["unusable boxes"] = detections.count - len(rows)
        self.state.counts.update(
            {"images": 1, "detections": detections.count, "unusable boxes": counts["unusable boxes"]}
        )
        self.state.counts["tracks ended"] += counts["ended"]
        made = {"tracks": self._message(detections, tracks, rows), "status": _status(detections.stamp, counts, resized)}
        return made if vectors is None or features is None else made | {"looks": _looks(features, tracks)}

    def on_reset(self, input: str) -> None:
        """Drops all tracks: the clock of an input was reset."""
        self.state.tracker.forget()

    def _vectors(
        self, detections: Detections2D, features: FeatureVector | None, rows: NDArray[np.intp]
    ) -> Array | None:
        if features is None or features.stamp != detections.stamp or len(features.vectors) != detections.count:
            self.state.counts["features not used"] += features is not None
            return None
        vectors = features.vectors[rows].astype(np.float64)
        return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))

    def _message(self, detections: Detections2D, tracks: list[BoxTrack], rows: NDArray[np.intp]) -> Tracks:
        now = detections.stamp
        return Tracks(
            stamp=now,
            frame=detections.frame,
            width=detections.width,
            height=detections.height,
            class_names=tuple(self.state.classes),
            ids=np.array([t.id for t in tracks], np.int64),
            states=np.array([t.state for t in tracks], np.uint8),
            scores=np.array([t.score for t in tracks], np.float32),
            class_ids=np.array([t.class_id for t in tracks], np.int32),
            ages=np.array([(now - t.born) * 1e-9 for t in tracks], np.float32),
            unseen=np.array([(now - t.seen) * 1e-9 for t in tracks], np.float32),
            boxes=boxes_of([t.filter for t in tracks]).astype(np.float32),
            detections=np.array([rows[t.row] if t.row >= 0 else -1 for t in tracks], np.int64),
        )


def _looks(features: FeatureVector, tracks: list[BoxTrack]) -> FeatureVector:
    now = [t for t in tracks if t.seen == features.stamp]
    known = [(t.id, t.feature) for t in now if t.feature is not None and t.feature.any()]
    vectors = np.array([mean for _, mean in known], np.float32).reshape(len(known), -1 if known else 0)
    return features.replace(labels=(), vectors=vectors, ids=np.array([i for i, _ in known], np.int64))


def _status(stamp: int, counts: Mapping[str, int], resized: bool) -> Diagnostics:
    shown = {s.name.lower(): counts.get(s.name.lower(), 0) for s in TrackState}
    text = ", ".join(f"{n} {name}" for name, n in shown.items())
    unusable = counts.get("unusable boxes", 0)
    if resized:
        text = "the image size changed: all tracks begin anew"
    elif unusable:
        text += f"; {unusable} boxes without extent"
    level = Level.WARN if resized or unusable else Level.OK
    return counted_status("multi_object_tracker", stamp, text, level, shown | {"unusable boxes": unusable})
