"""Times the tracker of image boxes with both of its Kalman filters: `python benchmarks/tracking_filters.py`."""

from __future__ import annotations

import time

import numpy as np

from operators.tracking.box_filter import BoxFilter, FilterpyBoxFilter
from operators.tracking.box_tracker import BoxTracker, BoxTrackerSettings

FRAMES = 300


def seconds(tracks: int, filter: type[BoxFilter]) -> float:
    """Returns the CPU time of tracking boxes that move steadily through 300 images."""
    rng = np.random.default_rng(0)
    corners, rates = rng.uniform(0, 600, (tracks, 2)), rng.uniform(-20, 20, (tracks, 2))
    tracker = BoxTracker(BoxTrackerSettings(filter=filter))
    began = time.process_time()
    for k in range(FRAMES):
        corner = corners + 0.1 * k * rates + rng.normal(0, 0.5, (tracks, 2))
        boxes = np.concatenate([corner, corner + 50], axis=1)
        scores = np.full(tracks, 0.8)
        tracker.update(k * 100_000_000, boxes, scores, np.zeros(tracks, np.int32), (10_000, 10_000))
    return time.process_time() - began


def main() -> None:
    """Prints milliseconds per image and the ratio of filterpy to numpy, each the least of three."""
    for tracks in (3, 10, 20):
        ours, theirs = (min(seconds(tracks, each) for _ in range(3)) for each in (BoxFilter, FilterpyBoxFilter))
        print(f"{tracks:3} tracks: numpy {1e3 * ours / FRAMES:.2f} ms, filterpy {theirs / ours:.1f} times as long")


if __name__ == "__main__":
    main()
