"""A clock that jumps back begins a score anew, of what comes after; earlier stamps are no error then."""

from __future__ import annotations

import numpy as np

from dataflow.messages import Detections2D, Odometry, Pose, SegmentationMap
from operators.evaluation import DetectionMetrics, SegmentationMetrics, TrajectoryMetrics

STAMPS = [10, 20, 30]


def test_a_trajectory_is_scored_from_the_last_jump_on() -> None:
    metrics = TrajectoryMetrics(alignment="none")
    metrics.setup()
    for shift in (0.0, 5.0):
        for k, stamp in enumerate(STAMPS):
            T = np.eye(4)
            T[0, 3] = k
            truth = Pose.from_matrix(T, stamp=stamp * 10**8, frame="world", child_frame="camera")
            T[1, 3] = shift
            found = Odometry.from_matrix(T, stamp=stamp * 10**8, frame="odom", child_frame="camera")
            metrics.process(found, (truth,))
        if not shift:
            metrics.on_reset("estimate")
    metrics.finish()

    assert metrics.summary()["matched"] == 3
    assert metrics.summary()["ate_rmse_m"] == 5.0


def boxes(stamp: int, count: int) -> Detections2D:
    return Detections2D(
        stamp=stamp, frame="camera", width=100, height=100, class_names=("cup",), scores=np.ones(count, np.float32),
        boxes=np.array([[10, 10, 50, 50]] * count).reshape(-1, 4), class_ids=np.zeros(count, np.int32),
    )  # fmt: skip


def test_detections_are_scored_from_the_last_jump_on() -> None:
    metrics = DetectionMetrics()
    metrics.setup()
    for stamp in STAMPS:
        metrics.process(boxes(stamp, 0), (boxes(stamp, 1),))
    metrics.on_reset("detections")
    for stamp in STAMPS[:2]:
        metrics.process(boxes(stamp, 1), (boxes(stamp, 1),))
    metrics.finish()

    assert metrics.summary()["frames"] == 2
    assert metrics.summary()["recall"] == 1.0


def test_segmentation_is_scored_from_the_last_jump_on() -> None:
    def classes(stamp: int, value: int) -> SegmentationMap:
        pixels = np.full((4, 4), value, np.uint8)
        return SegmentationMap(stamp=stamp, frame="camera", class_names=("floor", "wall"), void=255, classes=pixels)

    metrics = SegmentationMetrics()
    metrics.setup()
    for found, stamps in ((1, STAMPS), (0, STAMPS[:2])):
        for stamp in stamps:
            metrics.process(classes(stamp, found), (classes(stamp, 0),))
        if found:
            metrics.on_reset("segmentation")
    metrics.finish()

    assert metrics.summary()["frames"] == 2
    assert metrics.summary()["pixel_accuracy"] == 1.0
