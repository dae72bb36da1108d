"""Scores and times the shipped networks on simulated worlds that they have not seen, and on the bundled recording.

python benchmarks/networks.py [--worlds 12] [--frames 16] [--size 640x480 320x240] [--focals 0.5 1.2] [--before FOLDER]
                              [--write]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from dataflow.messages import CompressedImage, Detections2D, Image, Message, SegmentationMap
from dataflow.recording.streams.reader import Recording
from operators.codec import ImageDecoder
from operators.detection import CustomDetector
from operators.detection.custom.evaluation import ScoredImage, score_detections
from operators.detection.decode import Candidates
from operators.segmentation import Segmenter
from operators.segmentation.score import Confusion, confusion, mean_iou, named
from operators.simulator.classes import CLASSES, THINGS
from operators.training.simulated_worlds import FOCAL, HELD_OUT, TRAINING, VALIDATION, WorldImage, render, worlds
from operators.weights import read_facts, shipped

VISIBLE, PIXELS = 0.6, 200
"""Least visible share, and least number of pixels at VGA, of objects that count."""
VGA = 640 * 480
REPOSITORY = Path(__file__).resolve().parent.parent
RECORDING, RECORDED = REPOSITORY / "recordings" / "demo.mcap", "recordings/demo.mcap"
REPORT = Path(__file__).with_suffix(".md")
Pair = tuple[CustomDetector, Segmenter]


@dataclass
class WorldScore:
    """The figures of one world."""

    name: str
    scored: list[ScoredImage] = field(default_factory=list)
    all_counted: list[ScoredImage] = field(default_factory=list)
    table: Confusion = field(default_factory=lambda: np.zeros((len(CLASSES), len(CLASSES) + 1), np.int64))
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
    assert found.class_names == THINGS, f"the detector has {found.class_names}, the worlds have {THINGS}"
    assert classes.class_names == CLASSES, f"the segmenter has {classes.class_names}, the worlds have {CLASSES}"
    least = PIXELS * taken.image.width * taken.image.height / VGA
    ignored = (truth.visible < VISIBLE) | (truth.pixel_counts < least)
    boxes = Candidates(found.boxes, found.scores, found.class_ids)
    score.scored.append(ScoredImage(truth.boxes, truth.class_ids, ignored, boxes))
    score.all_counted.append(ScoredImage(truth.boxes, truth.class_ids, np.zeros_like(ignored), boxes))
    score.table += confusion(taken.masks.classes.astype(np.uint8), classes.classes.astype(np.uint8), len(CLASSES))


def recorded(file: Path) -> Iterator[WorldImage]:
    """The images of the bundled recording, decoded, with the truth in it."""
    decoder = ImageDecoder()
    kinds = (CompressedImage, Detections2D, SegmentationMap)
    open_stamps: dict[int, dict[type[Message], Message]] = {}
    with Recording(file) as recording:
        for record in recording.messages():
            message = record.message
            if not isinstance(message, kinds):
                continue
            parts = open_stamps.setdefault(message.stamp, {})
            parts[type(message)] = message
            if len(parts) == len(kinds):
                image, objects, masks = (open_stamps[message.stamp][kind] for kind in kinds)
                del open_stamps[message.stamp]
                assert isinstance(image, CompressedImage)
                assert isinstance(objects, Detections2D)
                assert isinstance(masks, SegmentationMap)
                yield WorldImage("recorded", 0, decoder.decode(image), objects, masks)


def opened(detector_file: Path, segmenter_file: Path) -> Pair:
    detector = CustomDetector(weights=str(detector_file), score_threshold=0.01)
    segmenter = Segmenter(weights=str(segmenter_file))
    detector.setup()
    segmenter.setup()
    blank = Image(stamp=0, frame="camera", data=np.zeros((480, 640, 3), np.uint8))
    detector.process(blank)
    segmenter.process(blank)
    return detector, segmenter


def time_together(detector: CustomDetector, segmenter: Segmenter, rounds: int) -> tuple[list[float], list[float]]:
    """Milliseconds for a VGA image: both operators one after the other, and both at once on two cores."""
    taken = next(render("office", HELD_OUT, 1, (640, 480), varied=False)).image
    one_by_one, at_once = [], []
    with ThreadPoolExecutor(2) as pool:
        for _ in range(rounds):
            began = time.perf_counter()
            detector.process(taken)
            segmenter.process(taken)
            between = time.perf_counter()
            waiting = [pool.submit(operator.process, taken) for operator in (detector, segmenter)]
            for future in waiting:
                future.result()
            one_by_one.append(1000 * (between - began))
            at_once.append(1000 * (time.perf_counter() - between))
    return one_by_one, at_once


def score_worlds(
    chosen: list[tuple[str, int]], frames: int, size: tuple[int, int], focal: float, pairs: Sequence[Pair]
) -> list[list[WorldScore]]:
    """Scores of each pair of operators, all on the same images: for each pair, a score of each world."""
    scores: list[list[WorldScore]] = [[] for _ in pairs]
    told = f"worlds at {size[0]}x{size[1]}, focal length {focal}"
    for world, seed in track(chosen, description=told, console=Console(stderr=True)):
        mine = [WorldScore(f"{world} {seed}") for _ in pairs]
        for taken in render(world, seed, frames, size, varied=False, focal=focal):
            for score, (detector, segmenter) in zip(mine, pairs, strict=True):
                add(score, taken, detector, segmenter)
        for kept, score in zip(scores, mine, strict=True):
            kept.append(score)
    return scores


def score_recording(file: Path, pairs: Sequence[Pair]) -> list[list[WorldScore]]:
    """The same on the images of a recording, as one world."""
    mine = [WorldScore(RECORDED) for _ in pairs]
    for taken in recorded(file):
        for score, (detector, segmenter) in zip(mine, pairs, strict=True):
            add(score, taken, detector, segmenter)
    return [[score] for score in mine]


def summary(scores: list[WorldScore]) -> dict[str, Any]:
    """All figures as plain values."""
    every = [image for score in scores for image in score.scored]
    table: Confusion = np.sum([score.table for score in scores], axis=0)
    pooled = score_detections(every, THINGS)
    whole = score_detections([image for score in scores for image in score.all_counted], THINGS)
    ap50, miou = {s.name: s.ap50 for s in scores}, {s.name: s.miou for s in scores}
    detector, segmenter = ([t for s in scores for t in times] for times in _times(scores))
    together = np.add(detector, segmenter)
    return {
        "worlds": len(scores),
        "images": len(every),
        "objects": pooled.objects,
        "ap50": float(np.mean(list(ap50.values()))),
        "ap50_worst": min(ap50.items(), key=lambda item: item[1]),
        "ap50_pooled": pooled.ap50,
        "ap_pooled": pooled.ap,
        "nothing_ignored": {"objects": whole.objects, "ap50": whole.ap50, "ap": whole.ap},
        "ap50_of_worlds": ap50,
        "ap50_of_classes": pooled.per_class,
        "miou": float(np.mean(list(miou.values()))),
        "miou_worst": min(miou.items(), key=lambda item: item[1]),
        "miou_pooled": mean_iou(table),
        "miou_of_worlds": miou,
        "iou_of_classes": named(table, CLASSES),
        "ms": {
            name: [float(np.median(times)), float(np.min(times))]
            for name, times in (("detector", detector), ("segmenter", segmenter), ("together", together))
        },
    }


def _times(scores: list[WorldScore]) -> tuple[list[list[float]], list[list[float]]]:
    return [s.detector_ms for s in scores], [s.segmenter_ms for s in scores]


def markdown(
    found: dict[str, list[dict[str, Any]]], together: dict[str, list[float]], files: dict[str, Path], command: str
) -> str:
    """The report."""
    lines = ["# The networks that come with the project", "", "    " + command, ""]
    lines += [
        "Both operators as they run in a graph, with the files in `operators/weights/`, on simulated worlds that were "
        f"used neither for training (seeds from {TRAINING}) nor for choosing the best epoch (seeds from {VALIDATION}): "
        f"their seeds count from {HELD_OUT}. Their training is described in "
        "[operators/weights/README.md](../operators/weights/README.md).",
        "",
        f"Detections count for objects of which at least {VISIBLE:.0%} and {PIXELS} pixels (at 640x480; less in "
        "smaller images by the area) are visible; other objects are neither required nor wrong. Labels are the "
        "simulator's. AP50 is pycocotools', mean over classes. Time is for the whole operator: resizing, network, "
        f"decoding, suppression; each network on one thread, on {_processor()} "
        f"({os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}).",
        "",
        "| file | kB | network | input | trained on | validation |",
        "|---|---|---|---|---|---|",
    ]
    for name, file in files.items():
        facts = read_facts(file)
        score = ", ".join(f"{k} {v:.3f}" for k, v in facts["scores"].items() if k != "score")
        lines.append(
            f"| `{name}` | {file.stat().st_size // 1000} | {facts['architecture']} "
            f"| {facts['width']}x{facts['height']} | {facts['training_images']} images | {score} |"
        )
    lines += ["", "| both networks, a VGA image | ms, median | tenth percentile | least |", "|---|---|---|---|"]
    for name, times in together.items():
        lines.append(f"| {name} | {np.median(times):.1f} | {np.percentile(times, 10):.1f} | {min(times):.1f} |")
    lines += ["", *_overview(found)]
    for title, (figures, *_) in found.items():
        if f"focal length {FOCAL}" in title or RECORDED in title:
            lines += _figures(title, figures)
    return "\n".join(lines)


def _overview(found: dict[str, list[dict[str, Any]]]) -> list[str]:
    """One row for each set of images; where files were given to compare with, theirs below."""
    lines = ["## At a glance", "", "All images of a row pooled.", ""]
    lines += [
        "| images | AP50 | AP | AP50, nothing ignored | AP, nothing ignored | mIoU |",
        "|---|---|---|---|---|---|",
    ]
    for title, several in found.items():
        for k, figures in enumerate(several):
            whole = figures["nothing_ignored"]
            values = (figures["ap50_pooled"], figures["ap_pooled"], whole["ap50"], whole["ap"], figures["miou_pooled"])
            name = title if k == 0 else "– the networks before"
            lines.append(f"| {name} | " + " | ".join(f"{value:.3f}" for value in values) + " |")
    return [*lines, ""]


def _figures(title: str, figures: dict[str, Any]) -> list[str]:
    name, worst = figures["ap50_worst"]
    other, least = figures["miou_worst"]
    ms = {key: f"{median:.1f} | {fastest:.1f}" for key, (median, fastest) in figures["ms"].items()}
    several = figures["worlds"] > 1
    lines = [
        f"## {title}",
        "",
        f"{figures['images']} images with {figures['objects']} objects that count, of "
        f"{figures['nothing_ignored']['objects']} of which any pixel shows.",
        "",
        "| | mean over worlds | worst world | all images pooled | ms an image, median | least |",
        "|---|---|---|---|---|---|",
        f"| detector, AP50 | **{figures['ap50']:.3f}** | {f'{worst:.3f} ({name})' if several else '–'} "
        f"| {figures['ap50_pooled']:.3f} (AP {figures['ap_pooled']:.3f}) | {ms['detector']} |",
        f"| segmenter, mIoU | **{figures['miou']:.3f}** | {f'{least:.3f} ({other})' if several else '–'} "
        f"| {figures['miou_pooled']:.3f} | {ms['segmenter']} |",
        f"| together | | | | {ms['together']} |",
        "",
        "| class | AP50 | IoU |",
        "|---|---|---|",
    ]
    for label in CLASSES:
        row = [figures[key].get(label) for key in ("ap50_of_classes", "iou_of_classes")]
        if any(v is not None for v in row):
            lines.append(f"| {label} | " + " | ".join("–" if v is None else f"{v:.3f}" for v in row) + " |")
    if several:
        lines += ["", "| world | AP50 | mIoU |", "|---|---|---|"]
        for label, value in figures["ap50_of_worlds"].items():
            lines.append(f"| {label} | {value:.3f} | {figures['miou_of_worlds'][label]:.3f} |")
    return [*lines, ""]


def _processor() -> str:
    """Returns the processor's name by /proc/cpuinfo, or else the architecture."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    found = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return found[0] if found else platform.machine()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--frames", type=int, default=16, help="images of each world")
    parser.add_argument("--size", nargs="*", default=["640x480", "320x240"])
    parser.add_argument(
        "--focals", nargs="*", type=float, default=[0.5, 0.7, 1.0, 1.2], help="further focal lengths, at the first size"
    )
    parser.add_argument("--focal-frames", type=int, default=6, help="images of each world at each of them")
    parser.add_argument("--detector", type=Path, default=shipped("detector.onnx"))
    parser.add_argument("--segmenter", type=Path, default=shipped("segmenter.onnx"))
    parser.add_argument("--before", type=Path, help="folder of a detector.onnx and segmenter.onnx to score beside them")
    parser.add_argument("--write", action="store_true", help=f"write {REPORT.name} beside this script")
    options = parser.parse_args()
    pairs = [opened(options.detector, options.segmenter)]
    one_by_one, at_once = time_together(*pairs[0], 60)
    if options.before is not None:
        pairs.append(opened(options.before / "detector.onnx", options.before / "segmenter.onnx"))
    together = {"one after the other, on one core": one_by_one, "at once, on two cores": at_once}
    sizes = [(int(width), int(height)) for width, _, height in (size.partition("x") for size in options.size)]
    sets = [(size, options.frames, FOCAL) for size in sizes]
    sets += [(sizes[0], options.focal_frames, focal) for focal in options.focals]
    chosen, found = worlds(HELD_OUT, options.worlds), {}
    for size, frames, focal in sets:
        title = f"{options.worlds} held-out worlds, {size[0]}x{size[1]}, focal length {focal}"
        found[title] = [summary(scores) for scores in score_worlds(chosen, frames, size, focal, pairs)]
    if RECORDING.is_file():
        title = f"The bundled recording ({RECORDED}: JPEG, 320x240)"
        found[title] = [summary(scores) for scores in score_recording(RECORDING, pairs)]
    least = {name: {"median": float(np.median(times)), "least": min(times)} for name, times in together.items()}
    print(json.dumps({"ms": least, **found}, indent=1))
    if options.write:
        command = (
            f"python benchmarks/networks.py --worlds {options.worlds} --frames {options.frames} "
            f"--size {' '.join(options.size)} --focals {' '.join(map(str, options.focals))} --write"
        )
        files = {"detector.onnx": options.detector, "segmenter.onnx": options.segmenter}
        REPORT.write_text(markdown(found, together, files, command), encoding="utf-8")


if __name__ == "__main__":
    main()
