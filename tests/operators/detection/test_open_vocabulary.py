"""A detector that finds what is named to it, on a small network of OWL-ViT's signature."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_towers import write_merges, write_open_detector
from served_models import model_of, write_row

from dataflow.messages import Image
from dataflow.operator import ParameterError
from operators.detection import OnnxDetector
from operators.inference import ModelError

pytest.importorskip("onnx")

WIDTH, HEIGHT = 120, 90
IMAGE = Image(stamp=1, frame="camera", data=np.full((HEIGHT, WIDTH, 3), 40, np.uint8))
BOXES = [(0.25, 0.5, 0.2, 0.4), (0.7, 0.3, 0.4, 0.2), (0.5, 0.5, 0.1, 0.1)]
COLORS = [(3.0, 0.0, -3.0), (-3.0, -3.0, 2.0), (-4.0, 1.0, -4.0)]  # red, blue, a little green


@pytest.fixture
def named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A row `open` of a registry, whose tokenizer and file are in the cache."""
    cache = tmp_path / "cache"
    cache.mkdir()
    merges = write_merges(cache / "open.tokenizer.txt")
    write_open_detector(cache / "open.onnx", merges, BOXES, COLORS)
    fields: dict[str, Any] = {
        "sha256": None,
        "bytes": None,
        "params": {"decoder": "owlvit", "score_threshold": 0.5},
        "parts": {
            "tokenizer": {"source": {"url": f"file://{merges}"}, "sha256": sha256(merges.read_bytes()).hexdigest()}
        },
    }
    write_row(tmp_path / "rows.yaml", model_of(b"any", "open", export="here"), **fields)
    monkeypatch.setenv("DATAFLOW_MODELS", str(tmp_path / "rows.yaml"))
    monkeypatch.setenv("DATAFLOW_MODEL_CACHE", str(cache))
    return "open"


def detector(**params: Any) -> OnnxDetector:
    made = OnnxDetector(**params)
    made.setup()
    return made


def test_named_classes_are_decoded_as_by_the_reference(named: str) -> None:
    message = detector(model=named, classes="red, blue").process(IMAGE)
    logits = np.array(COLORS)[:, [0, 2]]  # post_process_object_detection: the sigmoid of the best logit of each box
    scores = 1 / (1 + np.exp(-logits.max(axis=1)))
    assert message.labels() == ("red", "blue")
    np.testing.assert_allclose(message.scores, scores[:2], atol=1e-6)
    assert message.class_ids.tolist() == logits.argmax(axis=1)[:2].tolist()
    centre, size = np.array(BOXES)[:2, :2], np.array(BOXES)[:2, 2:]
    corners = np.concatenate([centre - size / 2, centre + size / 2], axis=1) * [WIDTH, HEIGHT, WIDTH, HEIGHT]
    np.testing.assert_allclose(message.boxes, corners, atol=1e-3)


def test_the_mask_of_the_names_may_be_its_first_input(named: str, tmp_path: Path) -> None:
    expected = detector(model=named, classes="red, blue").process(IMAGE).digest()
    write_open_detector(
        tmp_path / "cache" / "open.onnx", tmp_path / "cache" / "open.tokenizer.txt", BOXES, COLORS, mask_first=True
    )
    assert detector(model=named, classes="red, blue").process(IMAGE).digest() == expected


def test_names_may_be_added_while_it_runs_and_keep_their_numbers(named: str) -> None:
    made = detector(model=named, classes="red, blue")
    before = made.process(IMAGE)
    made.set_parameter("classes", "red, blue, green")
    after = made.process(IMAGE)
    assert after.labels() == ("red", "blue", "green")
    assert after.class_names[:2] == before.class_names
    assert made.process(IMAGE).digest() == detector(model=named, classes="red, blue, green").process(IMAGE).digest()
    with pytest.raises(ParameterError, match="names may be added, after those before: red, blue, green"):
        made.set_parameter("classes", "green")
    assert (made.classes, made.params.classes) == ("red, blue, green", "red, blue, green")
    assert made.process(IMAGE).digest() == after.digest()


@pytest.mark.parametrize("classes", ["red, blue,", "red,,blue", ",", "red, red", ""])
def test_an_empty_name_or_one_given_twice_is_refused(named: str, classes: str) -> None:
    with pytest.raises(ModelError, match="names a class twice or has an empty name"):
        detector(model=named, classes=classes)
    made = detector(model=named, classes="red")
    with pytest.raises(ParameterError, match="names a class twice or has an empty name"):
        made.set_parameter("classes", classes)
    assert made.process(IMAGE).class_names == ("red",)


def test_without_names_or_a_tokenizer_it_is_refused(named: str, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"give names in OnnxDetector\.classes \(`mug, fire extinguisher`\)"):
        detector(model=named)
    with pytest.raises(ModelError, match="take it by its name in `dataflow models list`, which has its tokenizer"):
        detector(model=str(tmp_path / "cache" / "open.onnx"), decoder="owlvit", classes="red, blue")
    (tmp_path / "cache" / "open.tokenizer.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"dataflow models get open\.tokenizer"):
        detector(model=named, classes="red, blue")


def test_a_network_of_given_classes_takes_no_others_while_it_runs() -> None:
    made = detector(model="simulated")
    with pytest.raises(ParameterError, match="simulated finds the 15 classes that it was trained for"):
        made.set_parameter("classes", "mug, fire extinguisher")
    assert made.classes is None
    made.set_parameter("max_detections", 3)
