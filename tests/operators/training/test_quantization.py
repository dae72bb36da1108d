"""Networks in 8 bits: they answer as the float ones do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.messages import Image
from operators.detection.custom.folder import read_detection_data
from operators.segmentation import Segmenter
from operators.weights import NetworkFileError, open_network, read_facts

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.training.quantization import quantize_network

SIZE = (160, 128)


def views(worlds: Path) -> list[NDArray[np.uint8]]:
    return [image.read() for image in read_detection_data(worlds).training]


@pytest.mark.long
def test_a_segmenter_in_8_bits_ends_with_its_scores_and_answers_as_before(
    trained: Path, worlds: Path, tmp_path: Path
) -> None:
    file, out = trained / "segmenter.onnx", tmp_path / "small.onnx"
    quantize_network(file, views(worlds), out)
    facts, plain = read_facts(out), read_facts(file)
    assert facts.pop("score_step") > 0
    assert plain.pop("score_step") > 0
    assert facts == plain | {"arithmetic": "int8", "calibration_images": 4}
    assert [each.name for each in open_network(out, "segmenter").session.get_outputs()] == ["scores"]
    data = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    before, after = (Segmenter(weights=str(each), with_confidence=True) for each in (file, out))
    found = []
    for segmenter in (before, after):
        segmenter.setup()
        found.append(segmenter.process(Image(stamp=0, frame="camera", data=data)))
    assert (found[0].classes == found[1].classes).mean() > 0.9
    assert found[0].confidence is not None
    assert found[1].confidence is not None
    assert np.abs(found[0].confidence - found[1].confidence).mean() < 0.05


@pytest.mark.long
def test_the_answers_differ_little_and_keep_their_precision(trained: Path, worlds: Path, tmp_path: Path) -> None:
    kind = "detector"
    file, out = trained / f"{kind}.onnx", tmp_path / "small.onnx"
    quantize_network(file, views(worlds), out)
    assert out.stat().st_size < file.stat().st_size
    assert read_facts(out) == read_facts(file) | {"arithmetic": "int8", "calibration_images": 4}
    image = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    for before, after in zip(open_network(file, kind).run(image), open_network(out, kind).run(image), strict=True):
        assert before.dtype == after.dtype
        if before.dtype == np.float32:
            assert np.abs(before - after).mean() < 0.1 * before.std() + 0.01
            assert len(np.unique(after)) > 256
        else:
            assert (before == after).mean() > 0.9


@pytest.mark.long
def test_the_same_images_give_the_same_bytes(trained: Path, worlds: Path, tmp_path: Path) -> None:
    for name in ("a.onnx", "b.onnx"):
        quantize_network(trained / "detector.onnx", views(worlds), tmp_path / name)
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()


def test_refused_quantization_leaves_no_file(trained: Path, worlds: Path, tmp_path: Path) -> None:
    small = tmp_path / "small.onnx"
    with pytest.raises(ValueError, match="measured on images, and there is none"):
        quantize_network(trained / "detector.onnx", [], small)
    with pytest.raises(FileNotFoundError, match=r"absent\.onnx"):
        quantize_network(tmp_path / "absent.onnx", views(worlds), small)
    assert not list(tmp_path.iterdir())
    quantize_network(trained / "detector.onnx", views(worlds), small)
    with pytest.raises(NetworkFileError, match="in 8 bits already; give the file that training wrote"):
        quantize_network(small, views(worlds), tmp_path / "smaller.onnx")
    assert list(tmp_path.iterdir()) == [small]


@pytest.mark.parametrize(
    ("kind", "score"), [("detector", "ap50"), pytest.param("segmenter", "miou", marks=pytest.mark.long)]
)
def test_the_command_scores_both_files(trained: Path, worlds: Path, tmp_path: Path, kind: str, score: str) -> None:
    arguments = ["train", "quantize", str(trained / f"{kind}.onnx"), str(worlds), "--out", str(tmp_path / "small.onnx")]
    result = CliRunner().invoke(app, [*arguments, "--images", "2", "--json"])
    assert result.exit_code == 0, result.output
    compared = json.loads(result.stdout)["files"]
    assert list(compared) == [str(trained / f"{kind}.onnx"), str(tmp_path / "small.onnx")]
    assert all(0 <= scores[score] <= 1 and scores["images"] == 4 for scores in compared.values())
    assert read_facts(tmp_path / "small.onnx")["calibration_images"] == 2
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 2
    assert "exists already" in again.output
