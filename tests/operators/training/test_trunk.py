"""One trunk for two networks that were trained together."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from dataflow.cli.main import app
from operators.detection.custom.folder import read_detection_data
from operators.segmentation.dataset import read_segmentation_data
from operators.weights import Network, open_network, read_facts

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.learning.files import TrainingFileError
    from operators.learning.loop import Settings, train
    from operators.training.pair import PairTask
    from operators.training.quantization import quantize_network
    from operators.training.trunk import share_trunk

SIZE = (160, 128)


@pytest.fixture(scope="module")
def apart(trained: Path, worlds: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with detector.onnx and segmenter.onnx, whose ranges were measured on different images."""
    folder = tmp_path_factory.mktemp("networks")
    views = [image.read() for image in read_detection_data(worlds).training]
    for name, seen in (("detector", views[:2]), ("segmenter", views[2:])):
        quantize_network(trained / f"{name}.onnx", seen, folder / f"{name}.onnx")
    return folder


@pytest.fixture
def noise() -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)


def opened(folder: Path) -> tuple[Network, Network]:
    return open_network(folder / "detector.onnx", "detector"), open_network(folder / "segmenter.onnx", "segmenter")


@pytest.mark.long
def test_both_have_the_trunk_of_the_first_which_answers_as_before(
    apart: Path, tmp_path: Path, noise: NDArray[np.uint8]
) -> None:
    share_trunk(*(folder / name for folder in (apart, tmp_path) for name in ("detector.onnx", "segmenter.onnx")))
    detector, segmenter = opened(tmp_path)
    assert detector.trunk is not None
    assert detector.trunk is segmenter.trunk
    before = opened(apart)
    for mine, theirs in zip(detector.run(noise), before[0].run(noise), strict=True):
        assert np.array_equal(mine, theirs)
    (mine,), (theirs,) = segmenter.run(noise), before[1].run(noise)
    assert not np.array_equal(mine, theirs)  # ranges measured on other images
    assert (mine[0].argmax(axis=0) == theirs[0].argmax(axis=0)).mean() > 0.95
    for name in ("detector.onnx", "segmenter.onnx"):
        facts = read_facts(tmp_path / name)
        assert len(facts.pop("trunk")) == 5
        assert facts == read_facts(apart / name)


@pytest.mark.long
def test_a_head_behind_another_range_computes_what_it_did(apart: Path, tmp_path: Path) -> None:
    """The biases of all layers, in float, are those of before but for rounding, also where their steps are others."""
    onnx = pytest.importorskip("onnx")
    share_trunk(*(folder / name for folder in (apart, tmp_path) for name in ("detector.onnx", "segmenter.onnx")))
    found = []
    for folder in (apart, tmp_path):
        graph = onnx.load(folder / "segmenter.onnx").graph
        stored = {each.name: onnx.numpy_helper.to_array(each) for each in graph.initializer}
        made = {name: node for node in graph.node for name in node.output}
        biases = [made[n.input[2]].input for n in graph.node if n.op_type == "Conv" and n.input[2] in made]
        found.append([(stored[value] * stored[step].astype(np.float64), stored[step]) for value, step, *_ in biases])
    assert any(not np.array_equal(step, other) for (_, step), (_, other) in zip(*found, strict=True))
    for (before, step), (after, other) in zip(*found, strict=True):
        assert np.abs(before - after).max() <= 1.5 * max(step.max(), other.max())


@pytest.mark.long
def test_networks_that_cannot_share_are_refused_and_leave_no_file(
    trained: Path, apart: Path, worlds: Path, tmp_path: Path
) -> None:
    out = [tmp_path / "a.onnx", tmp_path / "b.onnx"]
    with pytest.raises(TrainingFileError, match=r"detector\.onnx is not in 8 bits: `dataflow train quantize`"):
        share_trunk(trained / "detector.onnx", apart / "segmenter.onnx", *out)
    task = PairTask(read_detection_data(worlds), read_segmentation_data(worlds), SIZE, width=0.25, seed=5)
    train(task, Settings(epochs=1, batch=4, threads=1, seed=5), tmp_path / "other" / "pair.onnx")
    views = [image.read() for image in read_detection_data(worlds).training]
    quantize_network(tmp_path / "other" / "segmenter.onnx", views, tmp_path / "other" / "small.onnx")
    with pytest.raises(TrainingFileError, match="they were not trained together"):
        share_trunk(apart / "detector.onnx", tmp_path / "other" / "small.onnx", *out)
    assert not any(each.exists() for each in out)


def test_the_command_writes_both_files_and_replaces_none(apart: Path, tmp_path: Path) -> None:
    words = f"train trunk {apart / 'detector.onnx'} {apart / 'segmenter.onnx'} --out {tmp_path / 'new'}".split()
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    detector, segmenter = opened(tmp_path / "new")
    assert detector.trunk is segmenter.trunk
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 2
    assert "exists already: give --overwrite" in " ".join(again.output.split())
    assert CliRunner().invoke(app, [*words, "--overwrite"]).exit_code == 0
