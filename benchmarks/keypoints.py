"""MoveNet's keypoints of people in a recording, against the network called directly, and what the joints say.

    dataflow run graphs/webcam.yaml --set source=VideoFile --set input=DATA/videos/people.mp4 --set skeletons=true \
        --set keypoints=MODEL --set keypoints.decoder=movenet --record RECORDING
    python benchmarks/keypoints.py RECORDING MODEL

Prints the largest distance of a point from that of the network called directly on a crop that is cut here, and how
often SkeletonPosture takes the people for standing and for sitting.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

import dataflow
from dataflow.messages import Classification, Detections2D, Image, Keypoints2D
from operators.recognition import SkeletonPosture

SCORE = 0.3  # of the detections that KeypointDetector looks at
KINDS = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(uint8)": np.uint8}


def directly(session: onnxruntime.InferenceSession, pixels: NDArray[np.uint8], box: list[float]) -> NDArray[np.float64]:
    """Returns the network's points (17, 2) in the square around a box (x1, y1, x2, y2), in pixels of the image."""
    taken = session.get_inputs()[0]
    side = taken.shape[1]
    x1, y1, x2, y2 = box
    extent = max(x2 - x1, y2 - y1)
    left, top = (x1 + x2 - extent) / 2, (y1 + y2 - extent) / 2
    scale = side / extent
    cut = cv2.warpAffine(pixels, np.array([[scale, 0, -left * scale], [0, scale, -top * scale]]), (side, side))
    answer = session.run(None, {taken.name: cut[None].astype(KINDS[taken.type])})[0][0, 0]
    return np.stack([left + answer[:, 1] * extent, top + answer[:, 0] * extent], axis=1)


def main() -> None:
    recording, model = Path(sys.argv[1]), sys.argv[2]
    stream = dataflow.open(recording)
    named = {name.rpartition("/")[2]: name for name in stream}
    images = {m.stamp: m for m in stream[named["image"]] if isinstance(m, Image)}
    found = {m.stamp: m for m in stream[named["detections"]] if isinstance(m, Detections2D)}
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    posture, distances, postures = SkeletonPosture(), [], Counter[str]()
    posture.setup()
    for message in stream[named["keypoints"]]:
        if not isinstance(message, Keypoints2D) or not len(message.points):
            continue
        detections = found[message.stamp]
        persons = [k for k, name in enumerate(detections.labels()) if name == "person"]
        boxes = [detections.boxes[k].tolist() for k in persons if detections.scores[k] >= SCORE]
        for box, points in zip(boxes, message.points, strict=True):
            distances.append(np.abs(directly(session, images[message.stamp].data, box) - points).max())
        told = posture.process(message.replace(ids=np.arange(len(message.points))))
        said = [told.class_names[k] for k in told.class_ids] if isinstance(told, Classification) else []
        postures.update(said)
        postures["unknown"] += len(boxes) - len(said)
    print(f"{len(distances)} people in images: at most {max(distances):.3f} px from the network called directly")
    print(", ".join(f"{name} {count}" for name, count in postures.most_common()))


if __name__ == "__main__":
    main()
