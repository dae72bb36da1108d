"""Renders the training data, and scores and times the shipped networks on simulated worlds that they have not seen.

python benchmarks/networks.py render DATA [--worlds 150] [--frames 16]
python benchmarks/networks.py score [--worlds 12] [--frames 16] [--size 640x480] [--readme]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from operators.detection import CustomDetector
from operators.detection.custom.evaluation import ScoredImage, score_detections
from operators.detection.decode import Candidates
from operators.segmentation import Segmenter
from operators.segmentation.score import confusion, mean_iou, named
from operators.sources.simulator.classes import CLASSES, THINGS
from operators.training.simulated_worlds import WorldImage, render, worlds, write_data
from operators.weights import read_facts, shipped

TRAINING, VALIDATION, HELD_OUT = 10_000, 20_000, 30_000
"""First seeds; every world has the next one."""
KINDS = ("office", "table_top", "corridor", "office", "table_top")
"""Corridors show few objects, so fewer of them are trained on; held-out worlds are of the three kinds in turn."""
VALIDATION_WORLDS = 10
VISIBLE, PIXELS = 0.6, 200
"""What counts: objects of which at least this share and so many pixels of the image are visible."""
README = Path(__file__).parent.parent / "operators" / "weights" / "README.md"


@dataclass
class WorldScore:
    """The figures of one world."""

    name: str
    scored: list[ScoredImage] = field(default_factory=list)
    table: np.ndarray = field(default_factory=lambda: np.zeros((len(CLASSES), len(CLASSES) + 1), np.int64))
    detector_ms: list[float] = field(default_factory=list)
    segmenter_ms: list[float] = field(default_factory=list)

    @property
    def ap50(self) -> float:
        return score_detections(self.scored, THINGS).ap50

    @property
    def miou(self) -> float:
        return mean_iou(self.table)


def add(score: WorldScore, taken: WorldImage, detector: CustomDetector, segmenter: Segmenter) -> None:
    """Runs both operators on an image and compares with the truth."""
    began = time.perf_counter()
    found = detector.process(taken.image)
    between = time.perf_counter()
    classes = segmenter.process(taken.image)
    ended = time.perf_counter()
    score.detector_ms.append(1000 * (between - began))
    score.segmenter_ms.append(1000 * (ended - between))
    truth = taken.objects
    assert truth.visible is not None
    assert truth.pixel_counts is not None
    assert found.class_names == THINGS, f"the detector knows {found.class_names}, the worlds have {THINGS}"
    assert classes.class_names == CLASSES, f"the segmenter knows {classes.class_names}, the worlds have {CLASSES}"
    ignored = (truth.visible < VISIBLE) | (truth.pixel_counts < PIXELS)
    boxes = Candidates(found.boxes, found.scores, found.class_ids)
    score.scored.append(ScoredImage(truth.boxes, truth.class_ids, ignored, boxes))
    score.table += confusion(taken.masks.classes.astype(np.uint8), classes.classes.astype(np.uint8), len(CLASSES))


def score_worlds(
    count: int, frames: int, size: tuple[int, int], detector_file: Path, segmenter_file: Path
) -> list[WorldScore]:
    detector = CustomDetector(weights=str(detector_file), score_threshold=0.01)
    segmenter = Segmenter(weights=str(segmenter_file))
    detector.setup()
    segmenter.setup()
    scores = []
    for world, seed in track(worlds(HELD_OUT, count), description="held-out worlds"):
        score = WorldScore(f"{world} {seed}")
        for taken in render(world, seed, frames, size, varied=False):
            add(score, taken, detector, segmenter)
        scores.append(score)
    return scores


def summary(scores: list[WorldScore]) -> dict[str, Any]:
    """All figures as plain values."""
    every = [image for score in scores for image in score.scored]
    table = sum(score.table for score in scores)
    pooled = score_detections(every, THINGS)
    ap50, miou = {s.name: s.ap50 for s in scores}, {s.name: s.miou for s in scores}
    return {
        "worlds": len(scores),
        "images": len(every),
        "objects": pooled.objects,
        "ap50": float(np.mean(list(ap50.values()))),
        "ap50_worst": min(ap50.items(), key=lambda item: item[1]),
        "ap50_pooled": pooled.ap50,
        "ap_pooled": pooled.ap,
        "ap50_of_worlds": ap50,
        "ap50_of_classes": pooled.per_class,
        "miou": float(np.mean(list(miou.values()))),
        "miou_worst": min(miou.items(), key=lambda item: item[1]),
        "miou_pooled": mean_iou(table),
        "miou_of_worlds": miou,
        "iou_of_classes": named(table, CLASSES),
        "detector_ms": float(np.median([t for s in scores for t in s.detector_ms])),
        "segmenter_ms": float(np.median([t for s in scores for t in s.segmenter_ms])),
        "detector_ms_least": float(min(t for s in scores for t in s.detector_ms)),
        "segmenter_ms_least": float(min(t for s in scores for t in s.segmenter_ms)),
    }


def markdown(found: dict[str, dict[str, Any]], files: dict[str, Path], command: str) -> str:
    """The tables of the README beside the weights."""
    lines = ["# The networks that come with the project", ""]
    lines += ["Written by `" + command + "`; do not edit.", ""]
    lines += [
        "| file | kB | network | input | best epoch | hours | seed | validation |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, file in files.items():
        facts = read_facts(file)
        score = ", ".join(f"{k} {v:.3f}" for k, v in facts["scores"].items() if k != "score")
        lines.append(
            f"| `{name}` | {file.stat().st_size // 1000} | {facts['architecture']} | {facts['width']}x{facts['height']} | "
            f"{facts['epoch']} of {facts['epochs']} | {facts['hours']} | {facts['seed']} | {score} |"
        )
    lines += ["", f"Weights are stored as float16. Timed on {platform.processor() or platform.machine()}, "
              f"{os.cpu_count()} cores, one thread, load {os.getloadavg()[0]:.1f}.", ""]  # fmt: skip
    for size, figures in found.items():
        lines += _figures(size, figures)
    return "\n".join(lines) + "\n"


def _figures(size: str, figures: dict[str, Any]) -> list[str]:
    name, worst = figures["ap50_worst"]
    other, least = figures["miou_worst"]
    lines = [
        f"## {figures['worlds']} held-out worlds, {figures['images']} images of {size}",
        "",
        f"{figures['objects']} objects of which at least {VISIBLE:.0%} and {PIXELS} pixels are visible; seeds from "
        f"{HELD_OUT}, while training used those from {TRAINING} and validation those from {VALIDATION}.",
        "",
        "| | mean over worlds | worst world | all images pooled | ms an image, median | least |",
        "|---|---|---|---|---|---|",
        f"| detector, AP50 | **{figures['ap50']:.3f}** | {worst:.3f} ({name}) | {figures['ap50_pooled']:.3f} "
        f"(AP {figures['ap_pooled']:.3f}) | {figures['detector_ms']:.1f} | {figures['detector_ms_least']:.1f} |",
        f"| segmenter, mIoU | **{figures['miou']:.3f}** | {least:.3f} ({other}) | {figures['miou_pooled']:.3f} "
        f"| {figures['segmenter_ms']:.1f} | {figures['segmenter_ms_least']:.1f} |",
        "",
        "| class | AP50 | IoU |",
        "|---|---|---|",
    ]
    for label in CLASSES:
        row = [figures[key].get(label) for key in ("ap50_of_classes", "iou_of_classes")]
        lines.append(f"| {label} | " + " | ".join("–" if v is None else f"{v:.3f}" for v in row) + " |")
    lines += ["", "| world | AP50 | mIoU |", "|---|---|---|"]
    for label, value in figures["ap50_of_worlds"].items():
        lines.append(f"| {label} | {value:.3f} | {figures['miou_of_worlds'][label]:.3f} |")
    return [*lines, ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("render")
    making.add_argument("data", type=Path)
    making.add_argument("--worlds", type=int, default=150)
    making.add_argument("--frames", type=int, default=16)
    scoring = commands.add_parser("score")
    scoring.add_argument("--worlds", type=int, default=12)
    scoring.add_argument("--frames", type=int, default=16)
    scoring.add_argument("--size", nargs="+", default=["640x480", "320x240"])
    scoring.add_argument("--detector", type=Path, default=shipped("detector.onnx"))
    scoring.add_argument("--segmenter", type=Path, default=shipped("segmenter.onnx"))
    scoring.add_argument("--readme", action="store_true", help="write the README beside the weights")
    options = parser.parse_args()
    if options.command == "render":
        chosen = worlds(TRAINING, options.worlds, KINDS), worlds(VALIDATION, VALIDATION_WORLDS, KINDS)
        total = options.worlds + VALIDATION_WORLDS
        for _ in track(write_data(options.data, *chosen, options.frames), total=total, description="worlds"):
            pass
        return
    found = {}
    for size in options.size:
        width, height = map(int, size.split("x"))
        found[size] = summary(
            score_worlds(options.worlds, options.frames, (width, height), options.detector, options.segmenter)
        )
    print(json.dumps(found, indent=1))
    if options.readme:
        command = (
            f"python benchmarks/networks.py score --worlds {options.worlds} --frames {options.frames} "
            f"--size {' '.join(options.size)} --readme"
        )
        files = {"detector.onnx": options.detector, "segmenter.onnx": options.segmenter}
        README.write_text(markdown(found, files, command), encoding="utf-8")


if __name__ == "__main__":
    main()
