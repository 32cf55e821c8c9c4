"""The phantom's own radiation physics, written from the formulas.

Deliberately not the code that processes scans: a mistake shared by renderer and solver would cancel and stay unseen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Float

# CODATA 2018, exact
PLANCK_H = 6.62607015e-34  # J s
LIGHT_C = 299792458.0  # m/s
BOLTZMANN = 1.380649e-23  # J/K

QUADRATURE_NODES = 48  # Gauss-Legendre over the band: Planck is smooth, the error is far below 1e-9
TABLE_STEP_K = 0.02  # linear interpolation between table nodes errs by less than 1 µK
TABLE_RANGE_DEGC = (-60.0, 200.0)  # of the table; outside it the ends' values hold


@dataclass(frozen=True, eq=False)
class Band:
    """In-band radiance of a black body, both ways.

    degC, radiance : (N,) the table, radiance in W m-2 sr-1.
    """

    degC: Float
    radiance: Float

    @classmethod
    def of(cls, band_um: tuple[float, float]) -> Band:
        """Planck's law integrated over wavelengths `band_um` in µm."""
        lo, hi = TABLE_RANGE_DEGC
        t: Float = lo + TABLE_STEP_K * np.arange(round((hi - lo) / TABLE_STEP_K) + 1, dtype=np.float64)
        return cls(t, planck_in_band(t, band_um))

    def emit(self, degC: NDArray) -> Float:
        """Temperature in °C -> radiance, W m-2 sr-1; any shape."""
        return np.interp(degC, self.degC, self.radiance)

    def invert(self, radiance: NDArray) -> Float:
        """Radiance, W m-2 sr-1 -> temperature in °C; any shape."""
        return np.interp(radiance, self.radiance, self.degC)

    def slope(self, degC: float) -> float:
        """dL/dT at a temperature, W m-2 sr-1 K-1: turns a small temperature into radiance."""
        return float(self.emit(np.array(degC + 0.5)) - self.emit(np.array(degC - 0.5)))


def planck_in_band(degC: NDArray, band_um: tuple[float, float]) -> Float:
    """∫ 2hc²/λ⁵ / (exp(hc/λkT) - 1) dλ, W m-2 sr-1, by Gauss-Legendre quadrature; degC of any shape, band_um in µm."""
    x, w = np.polynomial.legendre.leggauss(QUADRATURE_NODES)
    lo, hi = (1e-6 * b for b in band_um)
    lam = (lo + hi) / 2 + (hi - lo) / 2 * x
    kelvin = np.asarray(degC, np.float64)[..., None] + 273.15
    spectral = 2 * PLANCK_H * LIGHT_C**2 / lam**5 / np.expm1(PLANCK_H * LIGHT_C / (lam * BOLTZMANN * kelvin))
    return (spectral * w).sum(-1) * (hi - lo) / 2


def fresnel_emissivity(cos_angle: NDArray, n: float, k: float = 0.0) -> Float:
    """ε(θ) = 1 - (|r_s|² + |r_p|²)/2 of a smooth surface with complex index n + ik in air (Born & Wolf §1.5, §14.2).

    In wave-vector form: q = sqrt(m² - sin²θ) is the normal component inside; r_s = (c - q)/(c + q),
    r_p = (m²c - q)/(m²c + q), with c = cosθ. cos_angle : any shape.
    """
    c = np.clip(np.asarray(cos_angle, np.float64), 0.0, 1.0).astype(np.complex128)
    m2 = complex(n, k) ** 2
    q = np.sqrt(m2 - (1 - c * c))
    r_s, r_p = (c - q) / (c + q), (m2 * c - q) / (m2 * c + q)
    return 1 - (np.abs(r_s) ** 2 + np.abs(r_p) ** 2) / 2


@dataclass(frozen=True, eq=False)
class EmissivityTables:
    """ε over cosθ on an even grid, one row a material.

    values : (M, N) float32 at cosθ = linspace(0, 1, N).
    """

    values: NDArray[np.float32]

    def __call__(self, material: NDArray, cos_angle: NDArray) -> NDArray[np.float32]:
        """ε of materials (P,) at angles (P,), linear between nodes."""
        n = self.values.shape[1]
        x = np.clip(cos_angle, 0, 1) * (n - 1)
        i = np.minimum(x.astype(np.int32), n - 2)
        f = (x - i).astype(np.float32)
        return self.values[material, i] * (1 - f) + self.values[material, i + 1] * f
