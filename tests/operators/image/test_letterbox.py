"""Fitting images into a network's input and boxes back."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from operators.image.letterbox import ImageFit

EXTENT = st.integers(8, 400)


@settings(max_examples=60, deadline=None)
@given(st.tuples(EXTENT, EXTENT), st.tuples(EXTENT, EXTENT), st.sampled_from(["stretch", "letterbox"]))
def test_letterbox_restores_the_box_of_the_whole_image(image, target, mode) -> None:
    fit = ImageFit.plan(mode, image, target)
    (x, y), (width, height) = fit.offset, fit.inner
    assert min(x, y) >= 0
    assert x + width <= target[0]
    assert y + height <= target[1]
    whole = np.array([[x, y, x + width, y + height]], np.float32)
    np.testing.assert_allclose(fit.restore(whole), [[0, 0, *image]], atol=1e-3)


def test_a_letterbox_keeps_proportions_and_pads_grey() -> None:
    fit = ImageFit.plan("letterbox", (200, 100), (64, 64))
    pixels = fit.apply(np.full((100, 200, 3), 255, np.uint8))
    assert pixels.shape == (64, 64, 3)
    assert (pixels[16:48] == 255).all()
    assert (pixels[:16] == 114).all()
    assert (pixels[48:] == 114).all()


def test_boxes_are_cut_at_the_border_of_the_image() -> None:
    fit = ImageFit.plan("stretch", (200, 100), (50, 50))
    assert fit.restore(np.array([[-5, 10, 60, 20]], np.float32)).tolist() == [[0, 20, 200, 40]]
