"""Small things by the shipped detector alone, with FocusDetector and with Reclassifier behind it, on unseen worlds.

python benchmarks/focus.py [--worlds 12] [--frames 16] [--size 640x480] [--focal 0.85] [--json]

Worlds and what counts are those of benchmarks/networks.py.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from networks import PIXELS, VGA, VISIBLE
from rich.console import Console
from rich.progress import track
from rich.table import Table

from dataflow.messages import Detections2D
from operators.detection import CustomDetector, FocusDetector, Reclassifier
from operators.detection.custom.evaluation import DetectionScore, ScoredImage, score_detections
from operators.detection.decode import Candidates
from operators.detection.focus.model import FocusModel
from operators.simulator.classes import THINGS
from operators.training.simulated_worlds import FOCAL, HELD_OUT, WorldImage, render, worlds
from operators.weights import shipped


@dataclass
class Kept:
    """What one way of detecting gave: scored images by world, and CPU milliseconds an image."""

    worlds: list[list[ScoredImage]] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)

    def of(self, name: str | None = None) -> DetectionScore:
        """The score of all images pooled; of one class alone where it is named."""
        return score_detections(
            [image if name is None else only(image, name) for w in self.worlds for image in w], THINGS
        )


def only(image: ScoredImage, name: str) -> ScoredImage:
    """An image's truth and answers of one class."""
    of = THINGS.index(name)
    true, found = image.classes == of, image.found
    return ScoredImage(image.boxes[true], image.classes[true], image.ignored[true], found.select(found.classes == of))


def scored(taken: WorldImage, found: Detections2D) -> ScoredImage:
    truth = taken.objects
    assert truth.visible is not None
    assert truth.pixel_counts is not None
    least = PIXELS * taken.image.width * taken.image.height / VGA
    ignored = (truth.visible < VISIBLE) | (truth.pixel_counts < least)
    return ScoredImage(truth.boxes, truth.class_ids, ignored, Candidates(found.boxes, found.scores, found.class_ids))


def measured(count: int, frames: int, size: tuple[int, int], focal: float) -> dict[str, Kept]:
    """Detects in images of held-out worlds, alone and with a second look."""
    detector, focus, names = CustomDetector(score_threshold=0.1), FocusDetector(), Reclassifier()
    for operator in (detector, focus, names):
        operator.setup()
    kept = {"detector": Kept(), "FocusDetector behind it": Kept(), "Reclassifier behind that": Kept()}
    chosen = worlds(HELD_OUT, count)
    for world, seed in track(chosen, description="worlds", console=Console(stderr=True)):
        for each in kept.values():
            each.worlds.append([])
        for taken in render(world, seed, frames, size, varied=False, focal=focal):
            times = [time.process_time()]
            found = [detector.process(taken.image)]
            times.append(time.process_time())
            for operator in (focus, names):
                found.append(operator.process(taken.image, found[-1]))
                times.append(time.process_time())
            for each, made, spent in zip(kept.values(), found, np.diff(times).tolist(), strict=True):
                each.worlds[-1].append(scored(taken, made))
                each.ms.append(1000 * spent)
    return kept


def told(found: dict[str, Kept]) -> dict[str, Any]:
    """All figures as plain values."""
    names = FocusModel.open(shipped("focus.onnx")).classes
    rows: dict[str, Any] = {}
    for way, kept in found.items():
        each = {name: kept.of(name) for name in names}
        rows[way] = {
            "classes": {
                name: {"ap50": score.ap50, "ap": score.ap, "objects": score.objects} for name, score in each.items()
            },
            "all": {"ap50": kept.of().ap50, "ap": kept.of().ap},
            "worlds": [score_detections(images, THINGS).ap50 for images in kept.worlds],
            "ms": [float(np.median(kept.ms)), float(np.max(kept.ms))],
        }
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--focal", type=float, default=FOCAL)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    width, height = map(int, given.size.split("x"))
    rows = told(measured(given.worlds, given.frames, (width, height), given.focal))
    if given.json:
        print(json.dumps(rows))
        return
    table = Table(title="AP50 (AP)")
    for head in ("", "objects", *rows):
        table.add_column(head)
    first = next(iter(rows.values()))
    for name, facts in first["classes"].items():
        scores = [row["classes"][name] for row in rows.values()]
        table.add_row(name, str(facts["objects"]), *(f"{s['ap50']:.3f} ({s['ap']:.3f})" for s in scores))
    table.add_row("all classes", "", *(f"{row['all']['ap50']:.3f} ({row['all']['ap']:.3f})" for row in rows.values()))
    table.add_row("worst world", "", *(f"{min(row['worlds']):.3f}" for row in rows.values()))
    table.add_row(
        "own CPU, ms an image: median, most", "", *(f"{r['ms'][0]:.1f}, {r['ms'][1]:.1f}" for r in rows.values())
    )
    Console().print(table)


if __name__ == "__main__":
    main()
