"""Numbers that describe errors: the statistics of `validate` and `compare`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NORMAL_95 = 1.96  # half width of a normal distribution's 95 % interval, in sigmas


@dataclass(frozen=True)
class Statistics:
    """Errors of n values, K. within_95 : share inside ±1.96 of their stated sigma (NaN without a sigma)."""

    n: int
    bias_K: float
    mae_K: float
    rmse_K: float
    p95_K: float
    within_95: float

    @classmethod
    def of(cls, error_K: NDArray, sigma_K: NDArray | None = None, weight: NDArray | None = None) -> Statistics:
        """Of errors (N,), counted with weights (N,)."""
        if not len(error_K):
            return cls(0, *[float("nan")] * 5)
        e, w = np.asarray(error_K, np.float64), np.ones(len(error_K)) if weight is None else weight
        w = w / w.sum()
        inside = float("nan") if sigma_K is None else min(float(w @ (np.abs(e) <= NORMAL_95 * sigma_K)), 1.0)
        p95 = weighted_quantile(np.abs(e), w, 0.95)
        return cls(len(e), float(w @ e), float(w @ np.abs(e)), float(np.sqrt(w @ e**2)), p95, inside)


def weighted_quantile(values: NDArray, weights: NDArray, q: float) -> float:
    """The value below which the share q of the weight lies."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(np.asarray(weights, np.float64)[order])
    return float(values[order[np.searchsorted(total, q * total[-1])]])


def robust_rms(residual: NDArray) -> float:
    """1.4826 times the median absolute value: the RMS of a normal distribution, deaf to outliers."""
    return 1.4826 * float(np.median(np.abs(residual))) if len(residual) else float("nan")
