"""The networks that come with the project, on a simulated world that they have not seen."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from dataflow.messages import Detections2D, Image
from operators.detection import CustomDetector
from operators.detection.nms import intersection_over_union
from operators.segmentation import Segmenter
from operators.simulator.classes import CLASSES, THINGS
from operators.training.simulated_worlds import HELD_OUT, WorldImage, render
from operators.weights import read_facts, shipped

FILES = {"detector": shipped("detector.onnx"), "segmenter": shipped("segmenter.onnx")}

DIGESTS = """
import sys
sys.modules["torch"] = None  # importing it would raise
import numpy as np
from dataflow.messages import Image
from operators.detection import CustomDetector
from operators.segmentation import Segmenter
image = Image(stamp=5, frame="camera", data=np.load(sys.argv[1]))
for made in (CustomDetector(), Segmenter(with_confidence=True)):
    made.setup()
    print(made.process(image).digest().hex())
"""


@pytest.fixture(scope="module")
def views() -> list[WorldImage]:
    """Four images of an office."""
    return list(render("office", HELD_OUT + 3, 4, (640, 480), varied=False))


Made = TypeVar("Made", CustomDetector, Segmenter)


def ready(made: Made) -> Made:
    made.setup()
    return made


def found_share(truth: Detections2D, found: Detections2D) -> tuple[int, int]:
    """How many large objects in plain sight there are, and how many of them have a box of their class around them."""
    assert truth.visible is not None
    assert truth.pixel_counts is not None
    plain = np.flatnonzero((truth.visible > 0.8) & (truth.pixel_counts > 1500))
    hits = 0
    for k in plain:
        same = found.boxes[found.class_ids == truth.class_ids[k]]
        hits += bool(len(same)) and bool(intersection_over_union(truth.boxes[k], same).max() > 0.5)
    return hits, len(plain)


@pytest.mark.long
def test_the_detector_finds_the_objects_in_plain_sight(views: list[WorldImage]) -> None:
    detector = ready(CustomDetector())
    counts = [found_share(view.objects, detector.process(view.image)) for view in views]
    hits, plain = np.sum(counts, axis=0)
    assert plain >= 8
    assert hits >= 0.8 * plain


def test_most_of_its_boxes_are_right(views: list[WorldImage]) -> None:
    detector = ready(CustomDetector(score_threshold=0.5))
    right = wrong = 0
    for view in views:
        found = detector.process(view.image)
        for box, label in zip(found.boxes, found.class_ids, strict=True):
            same = view.objects.boxes[view.objects.class_ids == label]
            hit = len(same) > 0 and float(intersection_over_union(box, same).max()) > 0.5
            right, wrong = right + hit, wrong + (not hit)
    assert right >= 8
    assert right >= 0.7 * (right + wrong)


def test_most_pixels_get_their_class(views: list[WorldImage]) -> None:
    segmenter = ready(Segmenter())
    for view in views:
        found = segmenter.process(view.image)
        assert found.class_names == CLASSES
        assert (found.classes == view.masks.classes).mean() > 0.85


def test_an_empty_image_has_no_objects() -> None:
    grey = Image(stamp=1, frame="camera", data=np.full((480, 640, 3), 128, np.uint8))
    assert ready(CustomDetector(score_threshold=0.5)).process(grey).count == 0


@pytest.mark.long
def test_two_processes_without_torch_answer_with_the_same_bits(views: list[WorldImage], tmp_path: Path) -> None:
    np.save(tmp_path / "image.npy", views[0].image.data)
    arguments = [sys.executable, "-c", DIGESTS, str(tmp_path / "image.npy")]
    runs = [subprocess.run(arguments, capture_output=True, text=True, timeout=120, check=True) for _ in range(2)]
    assert runs[0].stdout == runs[1].stdout
    assert len(runs[0].stdout.split()) == 2


def test_the_files_are_small_and_tell_what_they_are() -> None:
    assert sum(file.stat().st_size for file in FILES.values()) < 15_000_000
    for kind, file in FILES.items():
        facts = read_facts(file)
        assert facts["kind"] == kind
        assert tuple(facts["classes"]) == (THINGS if kind == "detector" else CLASSES)
        assert {"seed", "hours", "scores", "training_images"} <= facts.keys()
