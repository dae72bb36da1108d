"""The trunk of the networks that come with the project: computed once for an image, with the bits of whole files."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_onnx import with_facts
from numpy.typing import NDArray

from dataflow.messages import Image
from operators.detection import CustomDetector
from operators.inference import open_session
from operators.segmentation import Segmenter
from operators.weights import Network, NetworkFileError, open_network, shared_trunk, shipped

FILES = {"detector": shipped("detector.onnx"), "segmenter": shipped("segmenter.onnx")}
Pixels = NDArray[np.uint8]


def images(network: Network, count: int) -> list[Pixels]:
    """Smooth noise in the size of the networks' input."""
    width, height = network.size
    rng = np.random.default_rng(0)
    return [
        np.kron(rng.integers(0, 256, (height // 16, width // 16, 3)), np.ones((16, 16, 1))).astype(np.uint8)
        for _ in range(count)
    ]


def whole(file: Path, pixels: Pixels) -> list[NDArray[Any]]:
    found: list[NDArray[Any]] = open_session(file).run(None, {"image": shared_trunk.tensor_of(pixels)})
    return found


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[Pixels]:
    """The images for which a trunk is computed."""
    seen: list[Pixels] = []
    before: Callable[[Pixels], NDArray[np.float32]] = shared_trunk.tensor_of

    def counting(pixels: Pixels) -> NDArray[np.float32]:
        seen.append(pixels)
        return before(pixels)

    monkeypatch.setattr(shared_trunk, "tensor_of", counting)
    return seen


def test_two_networks_compute_their_trunk_once_and_answer_as_their_files_do(computed: list[Pixels]) -> None:
    detector, segmenter = (open_network(file, kind) for kind, file in FILES.items())
    assert detector.trunk is segmenter.trunk
    shown = images(detector, 3)
    for order in ((detector, segmenter), (segmenter, detector)):
        for pixels in shown:
            for network in order:
                for mine, theirs in zip(network.run(pixels), whole(network.file, pixels), strict=True):
                    assert np.array_equal(mine, theirs)
    assert len(computed) - 2 * 2 * len(shown) == len(shown)  # without those of the whole files


def test_one_network_may_be_some_images_ahead_and_few_images_are_kept(computed: list[Pixels]) -> None:
    detector, segmenter = (open_network(file, kind) for kind, file in FILES.items())
    shown = images(detector, 9)
    for pixels in shown[:3]:
        detector.run(pixels)
    for pixels in shown[:3]:
        segmenter.run(pixels)
    assert len(computed) == 3
    for pixels in shown[3:]:
        detector.run(pixels)
    assert len(computed) == 9
    segmenter.run(shown[0])
    assert len(computed) == 10


@pytest.mark.long
def test_operators_give_the_same_alone_and_beside_each_other(computed: list[Pixels]) -> None:
    rng = np.random.default_rng(1)
    shown = [
        Image(
            stamp=k,
            frame="camera",
            data=np.kron(rng.integers(0, 256, (12, 16, 3)), np.ones((20, 20, 1))).astype(np.uint8),
        )
        for k in range(3)
    ]

    def digests(*made: CustomDetector | Segmenter) -> list[bytes]:
        for each in made:
            each.setup()
        return [each.process(image).digest() for each in made for image in shown]

    alone = [*digests(CustomDetector()), *digests(Segmenter())]
    assert len(computed) == 6
    assert digests(CustomDetector(), Segmenter()) == alone
    assert len(computed) == 9
    assert digests(Segmenter(), CustomDetector()) == [*alone[3:], *alone[:3]]
    assert len(computed) == 12


def test_maps_cannot_be_changed() -> None:
    network = open_network(FILES["segmenter"], "segmenter")
    assert network.trunk is not None
    for each in network.trunk.maps(images(network, 1)[0]):
        with pytest.raises(ValueError, match="read-only"):
            each[:] = 0


def test_network_with_another_weight_does_not_share_the_trunk(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx", reason="models are changed with the extra [train]")
    shipped_one = open_network(FILES["detector"], "detector")
    same = open_network(with_facts(FILES["detector"], tmp_path / "same.onnx", seed=99), "detector")
    assert same.trunk is shipped_one.trunk
    model = onnx.load(FILES["detector"])
    weight = next(each for each in model.graph.initializer if re.fullmatch(r"onnx::Conv_.*_quantized", each.name))
    values = onnx.numpy_helper.to_array(weight).copy()
    values.flat[0] += 1
    weight.CopyFrom(onnx.numpy_helper.from_array(values, weight.name))
    onnx.save(model, tmp_path / "other.onnx")
    assert open_network(tmp_path / "other.onnx", "detector").trunk is not shipped_one.trunk


def test_a_file_that_names_no_trunk_runs_as_a_whole(tmp_path: Path, computed: list[Pixels]) -> None:
    file = with_facts(FILES["detector"], tmp_path / "plain.onnx", trunk=None)
    network = open_network(file, "detector")
    assert network.trunk is None
    pixels = images(network, 1)[0]
    for mine, theirs in zip(network.run(pixels), whole(FILES["detector"], pixels), strict=True):
        assert np.array_equal(mine, theirs)
    CustomDetector(weights=str(file)).setup()


@pytest.mark.parametrize(
    ("ends", "told"),
    [
        ("middle", "'trunk' in its metadata must be a list of names, is 'middle'"),
        ([], "must be a list of names"),
        (["absent"], "cannot be divided into trunk and head: the model has no inner value 'absent'"),
        (["/0/Div_output_0"], r"must end with tensor\(uint8\); '/0/Div_output_0' is tensor\(float\)"),
    ],
)
def test_unfit_trunk_is_refused_with_the_file(tmp_path: Path, ends: object, told: str) -> None:
    file = with_facts(FILES["detector"], tmp_path / "bad.onnx", trunk=ends)
    with pytest.raises(NetworkFileError, match=told) as error:
        open_network(file, "detector")
    assert str(file) in str(error.value)
