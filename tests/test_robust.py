"""Robust numbers against NumPy's own."""

import warnings

import numpy as np
import pytest

from thermofusion.robust import mad_sigma, median


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_median_is_numpys_bit_for_bit(dtype):
    rng = np.random.default_rng(3)
    for n in [*range(1, 40), 999, 1000, 20_000]:
        for values in (rng.normal(size=n), np.round(rng.normal(size=n)), np.full(n, 2.5), np.sort(rng.normal(size=n))):
            values = values.astype(dtype)
            assert median(values) == float(np.median(values))
    square = rng.normal(size=(7, 8)).astype(dtype)  # an image, say
    assert median(square) == float(np.median(square))


def test_a_gap_or_nothing_has_no_median():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan([median(np.zeros(0)), mad_sigma(np.zeros(0))]).all()
        for n in (1, 2, 7, 5000):
            values = np.arange(n, dtype=float)
            values[n // 3] = np.nan
            assert np.isnan(median(values))
