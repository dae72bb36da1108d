"""Quantiles of chi-square."""

from __future__ import annotations

import numpy as np

from operators.estimation.chi_square import quantile


def test_quantiles_are_those_of_scipy_bit_by_bit() -> None:
    from scipy.stats import chi2  # takes a second

    rng = np.random.default_rng(0)
    share, freedom = rng.uniform(size=5000), rng.integers(1, 5000, 5000)

    assert (quantile(share, freedom) == chi2.ppf(share, freedom)).all()
    assert float(quantile(0.999999, 2)) == float(chi2.ppf(0.999999, 2))
    assert list(quantile([0.025, 0.975], 12)) == list(chi2.ppf([0.025, 0.975], 12))
