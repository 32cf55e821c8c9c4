"""What references at unlike temperatures say of the camera's gain, whether or not it is solved for."""

from __future__ import annotations

import numpy as np

from .system import OverlapSystem, Solution

GAIN_SPAN_K = 3.0  # references must differ by this much to carry a gain


def gain_of_readings(system: OverlapSystem, solution: Solution) -> tuple[float, float] | None:
    """(γ, its sigma), γ the gain less 1: the slope of what readings of references miss over what they should be.

    The sigma holds the noise of readings, their scatter about the line, the sources' own errors, which all readings of
    one share, and the field where it is not known. None where references do not differ by `GAIN_SPAN_K`.
    """
    if system.use_gain:
        at = system.layout.gain
        return float(solution.p[at]), float(np.sqrt(solution.covariance[at, at]))
    rows = system.reading_rows()
    expected = np.array([r.expected for r, *_ in rows])
    if len(rows) < 2 or np.ptp(expected) < GAIN_SPAN_K * system.slope_L:
        return None
    off = np.array([r.measured - r.expected - row @ solution.p for r, row, _ in rows])
    w, source = np.array([weight for *_, weight in rows]), np.array([r.reference for r, *_ in rows])
    e = expected - w @ expected / w.sum()
    square = float(w @ e**2)
    slope = float(w @ (e * off)) / square
    left = off - w @ off / w.sum() - slope * e
    birge = max(float(w @ left**2) / max(len(rows) - 2, 1), 1.0)
    variance = birge / square
    for k in np.unique(source):
        mine = source == k
        own = max(r.sigma_expected for (r, *_), m in zip(rows, mine, strict=True) if m)
        field = system.slope_L * max(p.sigma_K for p, m in zip(system.places(), mine, strict=True) if m)
        variance += (np.hypot(own, field) * float(w[mine] @ e[mine]) / square) ** 2
    return slope, float(np.sqrt(variance))
