"""The table of detector networks that can be read, by the name of their decoder."""

from __future__ import annotations

from typing import Literal

from operators.detection.decode import Layout
from operators.detection.instance_masks import by_planes, by_probabilities, by_prototypes
from operators.detection.suppressed import (
    decode_detr,
    decode_end2end,
    decode_owlvit,
    decode_rfdetr,
    decode_rtdetr,
    decode_ssd,
    decode_tensorflow,
    decode_torchvision,
    detr_pair,
    ssd_pair,
)
from operators.detection.yolo import (
    decode_fastestdet,
    decode_nanodet,
    decode_yolov5,
    decode_yolov8,
    decode_yolox,
    prototypes_in,
)
from operators.network_input import NORMALIZATIONS

DecoderName = Literal[
    "fastestdet",
    "yolov5",
    "yolov8",
    "yolox",
    "nanodet",
    "ssd",
    "end2end",
    "rtdetr",
    "detr",
    "rfdetr",
    "owlvit",
    "torchvision",
    "tensorflow",
]

_ONE = (1.0, 1.0, 1.0)
_CLIP = NORMALIZATIONS["clip"]
_MEAN, _DEVIATION = NORMALIZATIONS["imagenet"]

LAYOUTS: dict[DecoderName, Layout] = {
    "fastestdet": Layout(decode_fastestdet, bgr=True, fit="stretch", classes=lambda o: int(o[0].shape[1]) - 5),
    "yolov5": Layout(
        decode_yolov5,
        bgr=False,
        fit="letterbox",
        classes=lambda o: int(o[0].shape[2]) - 5 - prototypes_in(o),
        draw=by_prototypes,
    ),
    "yolov8": Layout(
        decode_yolov8,
        bgr=False,
        fit="letterbox",
        classes=lambda o: int(o[0].shape[1]) - 4 - prototypes_in(o),
        draw=by_prototypes,
    ),
    "yolox": Layout(decode_yolox, bgr=True, fit="corner", classes=lambda o: int(o[0].shape[2]) - 5, scale=_ONE),
    "nanodet": Layout(
        decode_nanodet,
        bgr=True,
        fit="stretch",
        classes=lambda o: int(o[0].shape[2]) - 32,
        mean=_MEAN,
        scale=_DEVIATION,
        nms_iou=0.6,
        grid=64,
    ),
    "ssd": Layout(
        decode_ssd,
        bgr=False,
        fit="stretch",
        classes=lambda o: int(ssd_pair(o)[0].shape[1]) - 1,
        mean=(127.0, 127.0, 127.0),
        scale=(128.0, 128.0, 128.0),
    ),
    "end2end": Layout(decode_end2end, bgr=False, fit="letterbox", classes=None, nms_iou=1.0, draw=by_prototypes),
    "rtdetr": Layout(
        decode_rtdetr,
        bgr=False,
        fit="stretch",
        classes=None,
        nms_iou=1.0,
        sized=True,
        names=("labels", "boxes", "scores"),
    ),
    "detr": Layout(
        decode_detr,
        bgr=False,
        fit="stretch",
        classes=lambda o: int(detr_pair(o, False)[1].shape[1]),
        nms_iou=1.0,
        draw=by_planes,
    ),
    "rfdetr": Layout(
        decode_rfdetr,
        bgr=False,
        fit="stretch",
        classes=lambda o: int(detr_pair(o, True)[1].shape[1]),
        mean=_MEAN,
        scale=_DEVIATION,
        nms_iou=1.0,
        draw=by_planes,
    ),
    "owlvit": Layout(
        decode_owlvit,
        bgr=False,
        fit="stretch",
        classes=lambda o: int(o[0].shape[2]),
        mean=_CLIP[0],
        scale=_CLIP[1],
        nms_iou=1.0,
        words=16,
        names=("logits", "pred_boxes"),
    ),
    "torchvision": Layout(
        decode_torchvision, bgr=False, fit="stretch", classes=None, nms_iou=1.0, draw=by_probabilities
    ),
    "tensorflow": Layout(
        decode_tensorflow,
        bgr=False,
        fit="stretch",
        classes=None,
        scale=_ONE,
        nms_iou=1.0,
        names=("detection_boxes", "detection_classes", "detection_scores"),
    ),
}
"""Input, outputs and suppression of each family."""
