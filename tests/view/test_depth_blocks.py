"""Depth in squares: as large as before, each square with the value of its first pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    from dataflow.view import ViewOptions
    from dataflow.view.visualizers.cameras import _in_blocks


@pytest.mark.parametrize("shape", [(4, 6), (5, 7), (1, 1)])
def test_a_square_has_the_value_of_its_first_pixel(shape: tuple[int, int]) -> None:
    steps = np.arange(shape[0] * shape[1], dtype=np.uint16).reshape(shape)
    drawn = _in_blocks(steps, 2)
    rows, columns = np.indices(shape) // 2 * 2
    assert drawn.dtype == np.uint16
    assert np.array_equal(drawn, steps[rows, columns])
    assert _in_blocks(steps, 1) is steps


def test_a_block_of_no_pixel_is_refused() -> None:
    with pytest.raises(ValueError, match="depth_block"):
        ViewOptions(depth_block=0)
