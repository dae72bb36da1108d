"""Weights are those that the derivative of each kernel's loss gives: rho'(r) / r, up to its scale."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.estimation.kernels import cauchy, geman_mcclure, huber

Array = NDArray[np.float64]
WIDTH = 2.0
LOSSES: dict[Callable[..., Array], Callable[[Array], Array]] = {
    cauchy: lambda r: WIDTH**2 / 2 * np.log1p((r / WIDTH) ** 2),
    geman_mcclure: lambda r: r**2 / 2 / (1 + (r / WIDTH) ** 2),
    huber: lambda r: np.where(np.abs(r) < WIDTH, r**2 / 2, WIDTH * (np.abs(r) - WIDTH / 2)),
}


@pytest.mark.parametrize("kernel", LOSSES)
def test_weight_is_the_slope_of_the_loss_over_the_residual(kernel: Callable[..., Array]) -> None:
    r = np.array([-30.0, -2.5, -0.4, 0.01, 1.0, 1.9, 2.1, 50.0])

    slope = (LOSSES[kernel](r + 1e-6) - LOSSES[kernel](r - 1e-6)) / 2e-6

    weights = huber(r, WIDTH) if kernel is huber else kernel((r / WIDTH) ** 2)
    np.testing.assert_allclose(weights, slope / r, rtol=1e-4)


@pytest.mark.parametrize("kernel", [cauchy, geman_mcclure])
def test_infinite_residuals_have_no_weight(kernel: Callable[[Array], Array]) -> None:
    assert kernel(np.array([np.inf])) == 0.0
