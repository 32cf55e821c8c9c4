"""Counts to degrees: the camera's own curve from blackbody readings, and its per-pixel field.

A curve is valid over the temperatures it was measured at, and says so: inside it must rise without a turn, outside it
is an error, not an extrapolation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ...errors import ScanError
from ...physics.band import ZERO_DEGC_K
from ...types import Float, SignalCurve

MONOTONE_STEPS = 2001  # places of a range at which a curve is looked at: a turn as short as 1/2000 of it shows


@dataclass(frozen=True, eq=False)
class RadiometricCurve:
    """counts -> degC over `counts_range`.

    kind : `polynomial` (paper Eq. 1: T = Σ c_i gⁱ, parameters c_0 first) or `planck` (T_K = B / ln(R/(S - O) + F),
        parameters R, B, F, O). residual_K : rms of the fit. sigma_K : one sigma of the curve at its worst place.
    """

    kind: str
    parameters: tuple[float, ...]
    counts_range: tuple[float, float]
    residual_K: float
    sigma_K: float

    def to_degC(self, counts: NDArray) -> Float:
        """degC of counts, any shape. Raises ScanError if a finite count lies outside the range of the fit."""
        g = np.asarray(counts, np.float64)
        lo, hi = self.counts_range
        outside = np.isfinite(g) & ((g < lo) | (g > hi))
        if outside.any():
            raise ScanError(
                f"{int(outside.sum())} counts lie outside {lo:.0f} to {hi:.0f}, where the curve was measured",
                hint="measure blackbody readings that enclose the scene's temperatures",
            )
        return evaluate(self.kind, self.parameters, g)

    def widened(self, share: float) -> RadiometricCurve:
        """For pixels about a source at the range's end: the range wider by that share of it at both ends, or as it is
        where the curve would turn."""
        lo, hi = self.counts_range
        wide = replace(self, counts_range=(lo - share * (hi - lo), hi + share * (hi - lo)))
        try:
            check_monotone(wide.kind, wide.parameters, wide.counts_range)
        except ScanError:
            return self
        return wide

    def signal_curve(self) -> SignalCurve:
        """As scan.json carries it."""
        if self.kind == "polynomial":
            return SignalCurve("counts", "polynomial", {"coefficients_degC": self.parameters})
        return SignalCurve("counts", "planck", {k: (v,) for k, v in zip("RBFO", self.parameters, strict=True)})


def evaluate(kind: str, parameters: tuple[float, ...], counts: Float) -> Float:
    """The bare formula, wherever it is asked: degC of counts, any shape."""
    if kind == "polynomial":
        out = np.zeros_like(counts)
        for c in reversed(parameters):
            out = out * counts + c
        return out
    R, B, F, O = parameters  # noqa: E741 - the curve's own letters
    with np.errstate(invalid="ignore", divide="ignore"):
        return B / np.log(R / (counts - O) + F) - ZERO_DEGC_K


def fit_polynomial(
    counts: NDArray, degC: NDArray, *, degree: int = 4, counts_range: tuple[float, float] | None = None
) -> RadiometricCurve:
    """Eq. 1 from blackbody readings, counts (N,) and degC (N,), in a centred variable, expanded exactly (in fractions).

    counts_range : what the curve is for; by default, and at most, what was read.
    Raises ScanError: too few readings, a range beyond them, or a curve that turns inside its range (naming where).
    """
    g, T = _readings(counts, degC, degree + 2)
    center, half = (g.max() + g.min()) / 2, (g.max() - g.min()) / 2
    A = np.vander((g - center) / half, degree + 1, increasing=True)
    c, *_ = np.linalg.lstsq(A, T, rcond=None)
    r = T - A @ c
    scale = np.sqrt(r @ r / max(len(g) - degree - 1, 1))
    sigma = scale * np.sqrt(np.max(np.einsum("ij,jk,ik->i", A, np.linalg.pinv(A.T @ A), A)))
    curve = RadiometricCurve(
        "polynomial", _expand(c, center, half), (float(g.min()), float(g.max())), _rms(r), float(sigma)
    )
    return _monotone(curve, counts_range)


def fit_planck(
    counts: NDArray, degC: NDArray, *, fix_F: bool = True, counts_range: tuple[float, float] | None = None
) -> RadiometricCurve:
    """R, B, F, O from blackbody readings, counts (N,) and degC (N,): S = R/(exp(B/T) - F) + O.

    F = 1 unless `fix_F` is False (it takes a wide range of temperatures to tell F from B). counts_range and errors as
    in `fit_polynomial`.
    """
    g, T = _readings(counts, degC, 5)
    K = T + ZERO_DEGC_K
    slope = (g[-1] - g[0]) / (K[-1] - K[0])

    def linear(B: float, F: float) -> tuple[Float, Float]:
        A = np.column_stack([1 / (np.exp(B / K) - F), np.ones(len(K))])
        x, *_ = np.linalg.lstsq(A / [A[:, 0].max(), 1], g, rcond=None)
        x = x / [A[:, 0].max(), 1]
        return x, (A @ x - g) / slope  # residual in kelvin

    def cost(p: Float) -> Float:
        return linear(1000 * p[0], 1.0 if fix_F else p[1])[1]

    start = [1.4] if fix_F else [1.4, 1.0]
    bounds = ([0.3], [6.0]) if fix_F else ([0.3, 0.0], [6.0, 20.0])
    fit = least_squares(cost, start, bounds=bounds, x_scale=0.1, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    B, F = 1000 * fit.x[0], 1.0 if fix_F else float(fit.x[1])
    (R, O), _ = linear(B, F)  # noqa: E741
    parameters = (float(R), float(B), float(F), float(O))
    r = evaluate("planck", parameters, g) - T
    sigma = _rms(r) * np.sqrt(4 / max(len(g) - 3, 1))
    curve = RadiometricCurve("planck", parameters, (float(g.min()), float(g.max())), _rms(r), float(sigma))
    return _monotone(curve, counts_range)


def check_monotone(kind: str, parameters: tuple[float, ...], counts_range: tuple[float, float]) -> None:
    """Raises ScanError naming the counts at which a curve turns inside its range."""
    g = np.linspace(*counts_range, MONOTONE_STEPS)
    T = evaluate(kind, parameters, g)
    step = np.diff(T)
    if not np.isfinite(T).all():
        raise ScanError(f"the radiometric curve has no value at {g[~np.isfinite(T)][0]:.0f} counts")
    if not ((step > 0).all() or (step < 0).all()):
        turn = g[:-1][np.sign(step) != (np.sign(np.median(step)) or 1)]
        raise ScanError(
            f"the radiometric curve turns between {turn[0]:.0f} and {turn[-1]:.0f} counts, inside its range",
            hint="take fewer powers, or more blackbody readings there",
        )


def _monotone(curve: RadiometricCurve, stated: tuple[float, float] | None) -> RadiometricCurve:
    lo, hi = curve.counts_range
    if stated is not None:
        if not lo <= stated[0] < stated[1] <= hi:
            raise ScanError(
                f"the range {stated[0]:.0f} to {stated[1]:.0f} counts goes beyond the readings, {lo:.0f} to {hi:.0f}",
                hint="take readings that enclose the range",
            )
        curve = replace(curve, counts_range=stated)
    check_monotone(curve.kind, curve.parameters, curve.counts_range)
    return curve


def _readings(counts: NDArray, degC: NDArray, least: int) -> tuple[Float, Float]:
    g, T = np.asarray(counts, np.float64).ravel(), np.asarray(degC, np.float64).ravel()
    if len(g) != len(T):
        raise ScanError(f"{len(g)} counts with {len(T)} temperatures")
    keep = np.isfinite(g) & np.isfinite(T)
    if len(np.unique(g[keep])) < least:
        raise ScanError(
            f"{len(np.unique(g[keep]))} different blackbody readings do not carry this curve, {least} are the least"
        )
    order = np.argsort(T[keep], kind="stable")
    return g[keep][order], T[keep][order]


def _expand(c: NDArray, center: float, half: float) -> tuple[float, ...]:
    """Coefficients of Σ c_k ((g - center)/half)^k in powers of g, each the float nearest to the exact value."""
    C, h = Fraction(float(center)), Fraction(float(half))
    out = [Fraction(0)] * len(c)
    for k, value in enumerate(c):
        for i in range(k + 1):
            out[i] += Fraction(float(value)) / h**k * comb(k, i) * (-C) ** (k - i)
    return tuple(float(f) for f in out)


def _rms(r: Float) -> float:
    return float(np.sqrt(np.mean(r**2)))


# ---------------------------------------------------------------- the per-pixel field


@dataclass(frozen=True, eq=False)
class PixelField:
    """Vignetting and offset: a pixel reads Σ z_k Tᵏ too high when the scene is at T. z : (P, H, W), degC."""

    z: NDArray[np.float32]

    def correct(self, degC: NDArray) -> Float:
        """Temperatures (H, W) with the field taken off. Raises ScanError if the picture has another size."""
        T = np.asarray(degC, np.float64)
        if T.shape != self.z.shape[1:]:
            (h, w), (fh, fw) = T.shape, self.z.shape[1:]
            raise ScanError(f"the pixel field is of {fw} x {fh} px, the picture of {w} x {h}")
        deviation = np.zeros_like(T)
        for z in self.z[::-1]:
            deviation = deviation * T + z
        return T - deviation


def fit_field(frames_degC: NDArray, degC: NDArray, *, degree: int = 1) -> PixelField:
    """Per-pixel polynomial of what a uniform source at `degC` (N,) reads too high in frames_degC (N, H, W).

    Raises ScanError with fewer levels than coefficients.
    """
    T = np.asarray(degC, np.float64)
    if len(np.unique(T)) < degree + 1:
        raise ScanError(
            f"{len(np.unique(T))} source temperatures do not carry a field of degree {degree}",
            hint="show the camera a uniform source at more temperatures",
        )
    x = T - T.mean()
    A = np.vander(x / max(np.abs(x).max(), 1e-9), degree + 1, increasing=True)
    excess = (np.asarray(frames_degC, np.float64) - T[:, None, None]).reshape(len(T), -1)
    excess[:, ~np.isfinite(excess).all(axis=0)] = 0.0  # dead pixels: nothing is known, nothing is taken off
    c, *_ = np.linalg.lstsq(A, excess, rcond=None)
    scale, center = max(np.abs(x).max(), 1e-9), T.mean()
    z = np.zeros_like(c)
    for k in range(degree + 1):  # from the centred variable to powers of T
        for i in range(k + 1):
            z[i] += c[k] / scale**k * comb(k, i) * (-center) ** (k - i)
    return PixelField(z.reshape(degree + 1, *np.shape(frames_degC)[1:]).astype(np.float32))
