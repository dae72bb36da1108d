"""Scores an ONNX detector on a folder in the COCO128 layout with pycocotools, and times it.

python benchmarks/detection.py DATA/models/FastestDet.onnx fastestdet DATA/coco128 [--outside]

With --outside FastestDet also runs without any code of the project: onnxruntime, the decoding as its author describes
it in torch, and torchvision's class-wise suppression.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from dataflow.messages import Detections2D, Image
from operators.detection import OnnxDetector


def ground_truth(folder: Path, sizes: dict[str, tuple[int, int]], classes: int) -> COCO:
    """The labels (class cx cy w h, normalised) of the named images as a COCO object; sizes are (width, height)."""
    annotations: list[dict[str, Any]] = []
    for i, (name, (width, height)) in enumerate(sizes.items(), 1):
        file = folder / "labels" / f"{name}.txt"
        for line in file.read_text().splitlines() if file.is_file() else ():
            label, cx, cy, w, h = map(float, line.split())
            box = [(cx - w / 2) * width, (cy - h / 2) * height, w * width, h * height]
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": i,
                    "category_id": int(label),
                    "bbox": box,
                    "area": box[2] * box[3],
                    "iscrowd": 0,
                }
            )
    coco = COCO()
    coco.dataset = {
        "info": {},
        "images": [{"id": i, "width": w, "height": h} for i, (w, h) in enumerate(sizes.values(), 1)],
        "annotations": annotations,
        "categories": [{"id": c, "name": str(c)} for c in range(classes)],
    }
    coco.createIndex()
    return coco


def results(found: dict[str, Detections2D]) -> list[dict[str, object]]:
    """Detections as pycocotools wants them."""
    rows: list[dict[str, object]] = []
    for i, message in enumerate(found.values(), 1):
        for (x1, y1, x2, y2), score, label in zip(
            message.boxes.tolist(), message.scores.tolist(), message.class_ids.tolist(), strict=True
        ):
            rows.append({"image_id": i, "category_id": label, "bbox": [x1, y1, x2 - x1, y2 - y1], "score": score})
    return rows


def moved(found: Detections2D, shift: float, scale: float) -> Detections2D:
    """The boxes shifted by a share of the image and grown about their centres."""
    size = np.array([found.width, found.height], np.float32)
    center = (found.boxes[:, :2] + found.boxes[:, 2:]) / 2 + np.float32(shift) * size
    half = (found.boxes[:, 2:] - found.boxes[:, :2]) / 2 * np.float32(scale)
    return found.replace(boxes=np.hstack([center - half, center + half]))


def score(folder: Path, found: dict[str, Detections2D]) -> dict[str, float]:
    """AP at IoU 0.5, AP over 0.5 to 0.95, and recall with 100 boxes an image."""
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        truth = ground_truth(folder, {name: (m.width, m.height) for name, m in found.items()}, 80)
        evaluation = COCOeval(truth, truth.loadRes(results(found)), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return {"AP50": evaluation.stats[1], "AP50:95": evaluation.stats[0], "recall@100": evaluation.stats[8]}


def outside(model: Path, threshold: float, nms_iou: float) -> Callable[[Image], Detections2D]:
    """Returns FastestDet as a function of an image, by onnxruntime, torch and torchvision alone."""
    import onnxruntime
    import torch
    from torchvision.ops import batched_nms, box_convert

    session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])

    def found(image: Image) -> Detections2D:
        pixels = cv2.resize(image.data[..., ::-1], (352, 352), interpolation=cv2.INTER_LINEAR)
        tensor = torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1)[None].float() / 255
        output = torch.from_numpy(session.run(None, {session.get_inputs()[0].name: tensor.numpy()})[0])[0]
        _, rows, columns = output.shape
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        middles = torch.stack([(x + output[1].tanh()) / columns, (y + output[2].tanh()) / rows], -1)
        boxes = torch.cat([middles, output[3:5].sigmoid().permute(1, 2, 0)], -1).reshape(-1, 4)
        best, labels = output[5:].max(dim=0)
        scores = (output[0] ** 0.6 * best**0.4).reshape(-1)
        strong = scores >= threshold
        corners = box_convert(boxes, "cxcywh", "xyxy")
        corners, scores, labels = corners[strong], scores[strong], labels.reshape(-1)[strong]
        kept = batched_nms(corners, scores, labels, nms_iou)[:100]
        return Detections2D(
            stamp=image.stamp,
            frame=image.frame,
            width=image.width,
            height=image.height,
            boxes=(corners[kept].clip(0, 1) * torch.tensor([image.width, image.height] * 2)).numpy().astype(np.float32),
            scores=scores[kept].clip(0, 1).numpy().astype(np.float32),
            class_ids=labels[kept].numpy().astype(np.int32),
        )

    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("decoder")
    parser.add_argument("data", type=Path, help="folder with images/ and labels/")
    parser.add_argument("--score-threshold", type=float, default=0.001)
    parser.add_argument("--nms-iou", type=float, default=0.45)
    parser.add_argument("--fit", help="stretch, letterbox or corner instead of the decoder's own")
    parser.add_argument("--input-size", type=int, help="side of the input instead of the registry's")
    parser.add_argument("--outside", action="store_true", help="FastestDet without code of the project, too")
    controls = parser.add_argument_group("controls, which must all lower AP if the decoding is right")
    controls.add_argument("--swap-colors", action="store_true", help="exchange red and blue")
    controls.add_argument("--shift", type=float, default=0.0, help="move boxes right and down, share of the image")
    controls.add_argument("--scale", type=float, default=1.0, help="grow boxes about their centres")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)

    detector = OnnxDetector(
        model=str(arguments.model),
        decoder=arguments.decoder,
        score_threshold=arguments.score_threshold,
        nms_iou=arguments.nms_iou,
        fit=arguments.fit,
        input_size=arguments.input_size,
    )
    detector.setup()
    peer = outside(arguments.model, arguments.score_threshold, arguments.nms_iou) if arguments.outside else None
    found, seconds, other = {}, [], {}
    for i, file in enumerate(sorted((arguments.data / "images").iterdir())):
        pixels = np.asarray(cv2.imread(str(file), cv2.IMREAD_COLOR_RGB), np.uint8)
        image = Image(stamp=i, frame="camera", data=pixels[..., ::-1] if arguments.swap_colors else pixels)
        start = time.perf_counter()
        detections = detector.process(image)
        seconds.append(time.perf_counter() - start)
        found[file.stem] = moved(detections, arguments.shift, arguments.scale)
        if peer is not None:
            other[file.stem] = peer(image)
    figures = " | ".join(f"{name} {value:.3f}" for name, value in score(arguments.data, found).items())
    print(f"{len(found)} images | {figures} | median {np.median(seconds) * 1e3:.1f} ms a frame, one thread")
    if other:
        apart = [
            float(np.abs(a.boxes - b.boxes).max(initial=0)) if a.boxes.shape == b.boxes.shape else np.inf
            for a, b in zip(found.values(), other.values(), strict=True)
        ]
        figures = " | ".join(f"{name} {value:.3f}" for name, value in score(arguments.data, other).items())
        near = [gap for gap in apart if gap < 0.01]
        print(f"outside the graph | {figures} | boxes equal within 0.01 px in {len(near)} of {len(apart)} images")


if __name__ == "__main__":
    main()
