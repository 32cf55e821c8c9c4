"""Planck in a camera's band: in-band radiance from temperature, and back, by tables.

Inside the method everything is linear in in-band radiance L [W m-2 sr-1]; a temperature is computed once, at the end.
Formulas, their sources and the golden values stand in docs/radiometry.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..types import Float

ZERO_DEGC_K = 273.15  # K at 0 °C, by definition
_H, _C, _K = 6.62607015e-34, 299792458.0, 1.380649e-23  # CODATA 2018, exact: J s, m/s, J/K
_C1 = 2 * _H * _C**2  # W m2 sr-1
_C2 = _H * _C / _K  # m K

TABLE_K = (150.0, 1500.0)  # temperatures a band's table covers; NaN outside
_STEP_K = 0.5  # between a table's knots: cubics err by less than 1e-7 of the radiance
_KNOTS = 4096  # of the inverse table: cubics err by less than 1e-6 K
_NODES = 64  # Gauss-Legendre: exact to rounding for any thermal band


def planck_radiance(wavelength_um: ArrayLike, T_K: ArrayLike) -> Float:
    """Spectral radiance of a blackbody, W m-2 sr-1 µm-1 (Planck, CODATA 2018 constants).

    wavelength_um in µm and T_K in K broadcast.
    """
    lam = np.asarray(wavelength_um, np.float64) * 1e-6
    return 1e-6 * _C1 / lam**5 / np.expm1(_C2 / (lam * np.asarray(T_K, np.float64)))


@dataclass(frozen=True)
class Band:
    """A thermal camera's spectral band with a flat response between two wavelengths, in µm.

    Raises ValueError unless 0 < lo_um < hi_um.
    """

    lo_um: float = 7.5
    hi_um: float = 13.5

    def __post_init__(self) -> None:
        if not (0 < self.lo_um < self.hi_um < np.inf):
            raise ValueError(f"a band from {self.lo_um} to {self.hi_um} µm is none")

    def integrate(self, T_K: ArrayLike) -> Float:
        """In-band radiance by Gauss-Legendre quadrature, W m-2 sr-1, to rounding; any shape. `radiance` is fast."""
        lam, w = self._quadrature
        T = np.asarray(T_K, np.float64)
        return np.asarray(planck_radiance(lam, T[..., None]) @ w)

    def radiance(self, T_K: ArrayLike) -> Float:
        """In-band radiance L(T) = ∫ Planck, W m-2 sr-1; any shape. 1e-7 relative; NaN outside 150-1500 K."""
        return _hermite(np.asarray(T_K, np.float64), *self._forward)

    def d_radiance_dT(self, T_K: ArrayLike) -> Float:
        """dL/dT, W m-2 sr-1 K-1; any shape, 1e-7 relative; NaN outside 150-1500 K."""
        return _hermite(np.asarray(T_K, np.float64), *self._slope)

    def temperature_K(self, L: ArrayLike) -> Float:
        """Inverse of `radiance`: blackbody temperature of L of any shape, K, to 1e-6 K; NaN outside 150-1500 K."""
        L = np.asarray(L, np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            x = np.log(np.where(L > 0, L, np.nan))
        return _hermite(x, *self._inverse)

    @cached_property
    def _quadrature(self) -> tuple[Float, Float]:
        x, w = np.polynomial.legendre.leggauss(_NODES)
        half = 0.5 * (self.hi_um - self.lo_um)
        return self.lo_um + half * (x + 1), half * w

    def _derivatives(self, T_K: Float) -> tuple[Float, Float, Float]:
        """L, L', L'' by quadrature. With x = c2/(λT): d/dT Planck = Planck·x/(T(1-e^-x))."""
        lam, w = self._quadrature
        T = T_K[..., None]
        B, x = planck_radiance(lam, T), _C2 / (lam * 1e-6 * T)
        g = x / -np.expm1(-x)
        first = B * g / T
        second = first * (g * (1 + np.exp(-x)) - 2) / T
        return B @ w, first @ w, second @ w

    @cached_property
    def _forward(self) -> tuple[float, float, Float]:
        T = np.arange(TABLE_K[0], TABLE_K[1] + _STEP_K / 2, _STEP_K)
        L, dL, _ = self._derivatives(T)
        return float(T[0]), _STEP_K, _cubics(L, dL, _STEP_K)

    @cached_property
    def _slope(self) -> tuple[float, float, Float]:
        T = np.arange(TABLE_K[0], TABLE_K[1] + _STEP_K / 2, _STEP_K)
        _, dL, d2L = self._derivatives(T)
        return float(T[0]), _STEP_K, _cubics(dL, d2L, _STEP_K)

    @cached_property
    def _inverse(self) -> tuple[float, float, Float]:
        """T over ln L, which is nearly straight in 1/T: knots by Newton's method on the quadrature."""
        ends = np.log(self.integrate(np.array(TABLE_K)))
        x = np.linspace(ends[0], ends[1], _KNOTS)
        coarse = np.linspace(*TABLE_K, _KNOTS)
        T = np.interp(x, np.log(self.integrate(coarse)), coarse)
        for _ in range(4):
            L, dL, _ = self._derivatives(T)
            T = T - (np.log(L) - x) * L / dL
        L, dL, _ = self._derivatives(T)
        step = float(x[1] - x[0])
        return float(x[0]), step, _cubics(T, L / dL, step)


def _cubics(y: Float, dy: Float, step: float) -> Float:
    """(4, n-1) coefficients of the cubic Hermite interpolant in t = 0..1 of each interval."""
    y0, y1, m0, m1 = y[:-1], y[1:], dy[:-1] * step, dy[1:] * step
    return np.stack([y0, m0, 3 * (y1 - y0) - 2 * m0 - m1, 2 * (y0 - y1) + m0 + m1])


def _hermite(x: Float, x0: float, step: float, cubics: Float) -> Float:
    """Evaluate a uniform cubic table; NaN outside it."""
    n = cubics.shape[1]
    s = (x - x0) / step
    inside = (s >= -1e-9) & (s <= n + 1e-9)
    i = np.clip(np.where(inside, s, 0), 0, n - 1).astype(np.intp)
    t = s - i
    c0, c1, c2, c3 = (np.take(c, i) for c in cubics)
    return np.asarray(np.where(inside, c0 + t * (c1 + t * (c2 + t * c3)), np.nan))
