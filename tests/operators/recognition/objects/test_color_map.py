"""Colours among the maps that describe boxes."""

from __future__ import annotations

import numpy as np
import pytest

from operators.recognition.objects.proposals import COLOR, Trunk, color_map, inner_maps
from operators.weights import shipped

pytest.importorskip("onnx", reason="naming inner maps needs the extra [train]")


@pytest.mark.parametrize(
    ("color", "cell"),
    [((255, 0, 0), 0), ((0, 255, 255), 4), ((0, 0, 0), 8), ((255, 255, 255), 11)],
    ids=["red", "cyan", "black", "white"],
)
def test_one_colour_has_one_cell(color: tuple[int, int, int], cell: int) -> None:
    shares = color_map(np.full((8, 12, 3), color, np.uint8))
    assert shares.shape == (12, 2, 3)
    assert (shares.argmax(axis=0) == cell).all()
    assert (shares[cell] > 0.95).all()


def test_shares_of_any_image_sum_to_one() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (16, 20, 3), dtype=np.uint8)
    np.testing.assert_allclose(color_map(pixels).sum(axis=0), 1, atol=1e-5)


def test_colours_stand_where_they_are_named_and_leave_the_other_maps_as_they_are() -> None:
    network = shipped("detector.onnx")
    names = inner_maps(network)
    pixels = np.random.default_rng(1).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    plain, colored = (Trunk(network, inner).look(pixels) for inner in (names, (COLOR, *names)))
    assert colored.trunk[0].shape[0] == 12
    for one, other in zip(plain.trunk, colored.trunk[1:], strict=True):
        np.testing.assert_array_equal(one, other)
