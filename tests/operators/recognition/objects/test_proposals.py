"""Inner maps of a detector's network, and boxes described by them."""

from __future__ import annotations

import numpy as np
import pytest

from operators.inference import ModelError, open_session
from operators.recognition.objects.proposals import Trunk, inner_maps
from operators.weights import open_network, shipped

pytest.importorskip("onnx", reason="finding the maps needs the extra [train]")

DETECTOR = shipped("detector.onnx")
PIXELS = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def trunk() -> Trunk:
    return Trunk(DETECTOR, inner_maps(DETECTOR))


def test_trunk_maps_accompany_unchanged_outputs(trunk: Trunk) -> None:
    glance = trunk.look(PIXELS)
    assert [m.shape[1:] for m in glance.trunk] == [(72, 96), (36, 48), (18, 24)]
    network = open_network(DETECTOR, "detector")
    for mine, known in zip(glance.maps, network.run(glance.fit.apply(PIXELS)), strict=True):
        np.testing.assert_array_equal(mine, known)


def test_a_value_that_the_network_does_not_have_is_refused() -> None:
    with pytest.raises(ModelError, match="cannot be loaded"):
        open_session(DETECTOR, reveal=["no such value"])


def test_proposals_overlap_little_and_fall_in_score(trunk: Trunk) -> None:
    proposed = trunk.propose(trunk.look(PIXELS), 0.001, 20)
    assert 0 < len(proposed) <= 20
    assert proposed.shape[1] == 4


def test_box_descriptor_pools_the_features_inside_it(trunk: Trunk) -> None:
    """A glance whose maps are 1 on the left half and 2 on the right, in one channel."""
    glance = trunk.look(PIXELS)
    for each in glance.trunk:
        each[:] = 0
        each[0] = 1
        each[0, :, each.shape[2] // 2 :] = 2
    width, height = trunk.size
    boxes = np.array([[0, 0, width, height], [0, 0, width / 4, height / 4]], np.float32)
    described = trunk.describe(glance, boxes).reshape(2, -1)
    first = described[:, : described.shape[1] * 32 // 224].reshape(2, 4, 32)[:, :, 0]
    np.testing.assert_allclose(first[0], np.array([1, 2, 1, 2]) / np.sqrt(10), atol=1e-5)
    np.testing.assert_allclose(first[1], 0.5, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(described, axis=1), np.sqrt(3), rtol=1e-5)
