"""Runs the trackers of the `trackers` package on detections, and judges them and other results with trackeval.

    VENV/bin/python benchmarks/peers/image_tracking.py FOLDER

FOLDER holds `sequences.json` ({name: {rate, frames: [{truth: [[id, x1, y1, x2, y2]...], found: [[x1, y1, x2, y2,
score]...]}...]}}), `ours.json` ({label: {name: [[[id, x1, y1, x2, y2]...]...]}}) and `peers.json` ({label: {use,
parameters}}); `figures.json` ({label: {name: {HOTA, IDF1, MOTA}}}) is written. VENV has `trackers` and `trackeval`.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import supervision as sv
import trackers
from numpy.typing import NDArray
from trackeval.metrics import CLEAR, HOTA, Identity

Frames = list[dict[str, Any]]
Rows = list[list[list[float]]]
Array = NDArray[np.float64]


def track(use: str, parameters: dict[str, Any], rate: float, frames: Frames) -> Rows:
    tracker = getattr(trackers, use)(frame_rate=rate, **parameters)
    result = []
    for frame in frames:
        found = np.array(frame["found"], np.float64).reshape(-1, 5)
        detections = sv.Detections(xyxy=found[:, :4], confidence=found[:, 4], class_id=np.zeros(len(found), int))
        tracked = tracker.update(detections)
        ids = np.asarray(tracked.tracker_id if tracked.tracker_id is not None else [])
        result.append([[int(i), *box.tolist()] for i, box in zip(ids, tracked.xyxy, strict=True) if i >= 0])
    return result


def iou(a: Array, b: Array) -> Array:
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=2)
    areas = [np.prod(x[:, 2:] - x[:, :2], axis=1) for x in (a, b)]
    return np.asarray(shared / np.maximum(areas[0][:, None] + areas[1][None, :] - shared, 1e-9))


def judge(frames: Frames, results: Rows) -> dict[str, float]:
    sides = []
    for rows in ([f["truth"] for f in frames], results):
        names = {i: k for k, i in enumerate(sorted({int(r[0]) for frame in rows for r in frame}))}
        ids = [np.array([names[int(r[0])] for r in frame], int) for frame in rows]
        boxes = [np.array([r[1:] for r in frame], np.float64).reshape(-1, 4) for frame in rows]
        sides.append((len(names), ids, boxes))
    (gt_count, gt_ids, gt_boxes), (count, ids, boxes) = sides
    data = {
        "num_timesteps": len(frames),
        "num_gt_ids": gt_count,
        "num_tracker_ids": count,
        "num_gt_dets": sum(map(len, gt_ids)),
        "num_tracker_dets": sum(map(len, ids)),
        "gt_ids": gt_ids,
        "tracker_ids": ids,
        "similarity_scores": [iou(a, b) for a, b in zip(gt_boxes, boxes, strict=True)],
    }
    with contextlib.redirect_stdout(io.StringIO()):
        hota, clear, identity = (m.eval_sequence(data) for m in (HOTA(), CLEAR(), Identity()))
    return {"HOTA": float(np.mean(hota["HOTA"])), "IDF1": float(identity["IDF1"]), "MOTA": float(clear["MOTA"])}


def main() -> None:
    folder = Path(sys.argv[1])
    sequences, ours, peers = (json.loads((folder / f"{n}.json").read_text()) for n in ("sequences", "ours", "peers"))
    figures: dict[str, dict[str, Any]] = {}
    for name, sequence in sequences.items():
        frames = sequence["frames"]
        results = {label: made[name] for label, made in ours.items()}
        results |= {label: track(p["use"], p["parameters"], sequence["rate"], frames) for label, p in peers.items()}
        for label, result in results.items():
            figures.setdefault(label, {})[name] = judge(frames, result)
    (folder / "figures.json").write_text(json.dumps(figures))


if __name__ == "__main__":
    main()
