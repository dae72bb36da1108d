"""Decoders of networks whose boxes need no suppression: it is inside the export, or the network was trained without."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.detection.decode import Candidates, Outputs, Size, best_class, corners, shapes_of, sigmoid
from operators.detection.yolo import prototypes_in


def decode_end2end(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """Exports with their suppression inside; corners in input pixels. Forms:

    - (1, N, 6): corners, score, class (YOLOv10, YOLO26, Ultralytics with nms); with prototypes (1, K, h, w) and K
      coefficients behind the six, it has masks.
    - (N, 7): number of the image, corners, class, score (YOLOv7).
    - (1, N, 5) and (1, N): corners and score, class (MMDeploy).
    - (1, 1), (1, N, 4), (1, N) and (1, N): count, corners, scores, classes (EfficientNMS of TensorRT).
    """
    first = outputs[0]
    if first.ndim == 2 and first.shape[1] == 7 and len(outputs) == 1:
        return _kept(first[:, 1:5], first[:, 6], first[:, 5], threshold)
    if len(outputs) == 2 and first.ndim == 3 and first.shape[2] == 5 and outputs[1].shape == first.shape[:2]:
        return _kept(first[0, :, :4], first[0, :, 4], outputs[1][0], threshold)
    if len(outputs) == 4 and first.size == 1 and outputs[1].ndim == 3 and outputs[1].shape[2] == 4:
        count = int(first.reshape(-1)[0])
        return _kept(outputs[1][0, :count], outputs[2][0, :count], outputs[3][0, :count], threshold)
    kinds = prototypes_in(outputs)
    if first.ndim != 3 or first.shape[0] != 1 or first.shape[2] != 6 + kinds:
        raise ValueError(
            f"end-to-end outputs are (1, N, 6), (N, 7), (1, N, 5) with (1, N), or count, boxes, scores and classes; "
            f"got {shapes_of(outputs)}"
        )
    rows = first[0]
    return _kept(rows[:, :4], rows[:, 4], rows[:, 5], threshold, rows[:, 6:] if kinds else None)


def decode_rtdetr(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """RT-DETR, D-FINE and DEIM as their authors export them: labels (1, N), boxes (1, N, 4), scores (1, N).

    Boxes are corners in the pixels of the second input's size. Source: `RTDETRPostProcessor` with `deploy` of RT-DETR
    (Zhao et al., 2023; Apache-2.0).
    """
    if len(outputs) != 3 or outputs[1].ndim != 3 or outputs[1].shape[2] != 4 or outputs[1].shape[0] != 1:
        raise ValueError(f"RT-DETR's outputs have shapes (1, N), (1, N, 4) and (1, N), got {shapes_of(outputs)}")
    labels, boxes, scores = outputs[0], outputs[1][0], outputs[2]
    if not np.issubdtype(labels.dtype, np.integer) or labels.shape != scores.shape:
        raise ValueError(f"RT-DETR's outputs are labels, boxes and scores in this order, got {shapes_of(outputs)}")
    return _kept(boxes, scores[0], labels[0], threshold)


def decode_detr(outputs: Outputs, size: Size, threshold: float, boxes_first: bool = False) -> Candidates:
    """Networks of the DETR family before their post-processing: logits (1, N, C), boxes (1, N, 4), in either order.

    Of four classes the logits come first, or the boxes with `boxes_first`. Boxes are centre and size as shares of the
    input; of N · C sigmoids the best N are taken, so a query may answer for several classes. Mask logits (1, N, h, w)
    may follow. Source: `PostProcess` of RF-DETR (Roboflow, 2025; Apache-2.0), that of RT-DETR in Hugging Face's
    transformers, both after Zhu et al., "Deformable DETR", 2020.
    """
    boxes, logits = detr_pair(outputs, boxes_first)
    masks = next((o[0] for o in outputs if o.ndim == 4), None)
    scores = sigmoid(logits.astype(np.float32))
    best = np.argsort(-scores, axis=None, kind="stable")[: len(boxes)]
    best = best[scores.reshape(-1)[best] >= threshold]
    rows, classes = np.divmod(best, logits.shape[1])
    made = corners(*boxes[rows].T) * np.array([*size, *size], np.float32)
    return _kept(made, scores.reshape(-1)[best], classes, threshold, None if masks is None else masks[rows])


def decode_rfdetr(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """RF-DETR's export: as `decode_detr`, the boxes first."""
    return decode_detr(outputs, size, threshold, boxes_first=True)


def decode_owlvit(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """OWL-ViT: logits (1, N, C) of the C names that were asked for, and boxes (1, N, 4); more outputs are not used.

    Boxes are centre and size as shares of the input, a score is the sigmoid of the best logit. Source:
    `post_process_object_detection` of Hugging Face's `OwlViTImageProcessor` (Apache-2.0), after Minderer et al.,
    "Simple open-vocabulary object detection with vision transformers", 2022.
    """
    logits, boxes = outputs[0], outputs[1] if len(outputs) > 1 else outputs[0]
    if logits.ndim != 3 or boxes.shape != (1, logits.shape[1], 4) or logits.shape[0] != 1:
        raise ValueError(f"OWL-ViT's outputs are (1, N, C) and (1, N, 4), got {shapes_of(outputs)}")
    scaled = boxes[0].astype(np.float32) * np.array([*size, *size], np.float32)
    return best_class(scaled, sigmoid(logits[0].astype(np.float32)), threshold)


def detr_pair(outputs: Outputs, boxes_first: bool) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns boxes (N, 4) and logits (N, C) of a network of the DETR family. Raises ValueError for other outputs."""
    flat = [o for o in outputs if o.ndim == 3 and o.shape[0] == 1]
    placed = sorted(flat if boxes_first else flat[::-1], key=lambda o: o.shape[2] != 4)  # stable
    if len(flat) != 2 or placed[0].shape[2] != 4 or placed[0].shape[1] != placed[1].shape[1]:
        raise ValueError(
            f"a DETR's outputs have shapes (1, N, 4) and (1, N, classes), and with masks (1, N, h, w), "
            f"got {shapes_of(outputs)}"
        )
    return placed[0][0], placed[1][0]


def decode_torchvision(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """A detector of torchvision as exported whole: boxes (N, 4) in input pixels, labels (N,), scores (N,).

    Labels count from 1, as in its checkpoints, whose class 0 is the background; suppression has been done. Mask R-CNN
    gives masks (N, 1, H, W) of the input, or (N, 1, h, w) of each box, as probabilities.
    """
    if len(outputs) not in (3, 4) or outputs[0].ndim != 2 or outputs[0].shape[1] != 4:
        raise ValueError(f"torchvision's outputs have shapes (N, 4), (N,) and (N,), got {shapes_of(outputs)}")
    flat = [o for o in outputs[1:] if o.shape == (len(outputs[0]),)]
    labels = next((o for o in flat if np.issubdtype(o.dtype, np.integer)), None)
    scores = next((o for o in flat if np.issubdtype(o.dtype, np.floating)), None)
    masks = next((o for o in outputs[1:] if o.ndim in (3, 4) and len(o) == len(outputs[0])), None)
    if labels is None or scores is None or (len(outputs) == 4) != (masks is not None):
        raise ValueError(
            f"torchvision's outputs are boxes, integer labels, scores and perhaps masks, got {shapes_of(outputs)}"
        )
    found = np.flatnonzero(labels > 0)
    masks = None if masks is None else masks.reshape(len(masks), *masks.shape[-2:])[found]
    return _kept(outputs[0][found], scores[found], labels[found] - 1, threshold, masks)


def decode_ssd(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """SSD as exported before its suppression: scores (1, N, 1 + C), class 0 the background, and boxes (1, N, 4).

    Boxes are corners as shares of the input. A prior may answer for several classes. The outputs come in either order;
    of three classes the scores come first.
    """
    scores, boxes = ssd_pair(outputs)
    priors, classes = np.nonzero(scores[:, 1:] >= threshold)
    made = boxes[priors] * np.array([*size, *size], np.float32)
    return _kept(made, scores[priors, classes + 1], classes, threshold)


def decode_tensorflow(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """Detectors of TensorFlow's object detection API: boxes (1, N, 4), classes, scores (1, N), in this order.

    Boxes are y1, x1, y2, x2 as shares of the input; classes are whole numbers from 1 in COCO's own numbering, as
    floats. The number of boxes may follow. Source: ONNX's SSD-MobileNet v1, and the TFLite detection post-process.
    """
    if len(outputs) not in (3, 4) or outputs[0].ndim != 3 or outputs[0].shape[2] != 4:
        raise ValueError(
            f"outputs of TensorFlow's detectors have shapes (1, N, 4), (1, N) and (1, N), got {shapes_of(outputs)}"
        )
    boxes = outputs[0][0][:, [1, 0, 3, 2]] * np.array([*size, *size], np.float32)
    return _kept(boxes, outputs[2].reshape(-1), outputs[1].reshape(-1), threshold)


def ssd_pair(outputs: Outputs) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns scores (N, 1 + C) and boxes (N, 4) of an SSD. Raises ValueError for other outputs."""
    flat = [o[0] for o in outputs if o.ndim == 3 and o.shape[0] == 1]
    if len(outputs) != 2 or len(flat) != 2 or len(flat[0]) != len(flat[1]) or 4 not in [o.shape[1] for o in flat]:
        raise ValueError(f"an SSD's outputs have shapes (1, N, 1 + classes) and (1, N, 4), got {shapes_of(outputs)}")
    first, second = flat
    return (first, second) if second.shape[1] == 4 else (second, first)


def _kept(
    boxes: NDArray[Any],
    scores: NDArray[Any],
    classes: NDArray[Any],
    threshold: float,
    masks: NDArray[Any] | None = None,
) -> Candidates:
    keep = np.flatnonzero((scores >= threshold) & (classes >= 0))  # exports fill up rows with a class of -1
    made = boxes[keep].astype(np.float32), scores[keep].astype(np.float32), classes[keep].astype(np.int32)
    return Candidates(*made, None if masks is None else masks[keep].astype(np.float32))
