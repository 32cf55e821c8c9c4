"""What room air lets through in the long-wave infrared, by the water in it.

The model that thermal cameras use (FLIR's; W. Minkina, D. Klecha, J. Sens. Sens. Syst. 5, 17, 2016):

    τ = X exp(-√d (α₁ + β₁ √w)) + (1 - X) exp(-√d (α₂ + β₂ √w)),      w = φ exp(h(T)), grams of water in a cubic metre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..types import Float


@dataclass(frozen=True)
class AirModel:
    """Its constants; those of most cameras by default. alpha, beta : of the two terms, m^-½; X : share of the first."""

    alpha: tuple[float, float] = (0.006569, 0.01262)
    beta: tuple[float, float] = (-0.002276, -0.00667)
    X: float = 1.9

    def transmission(self, range_m: ArrayLike, air_degC: ArrayLike, relative_humidity: ArrayLike) -> Float:
        """Of a path, 0 to 1. range_m : m. air_degC : °C. relative_humidity : 0 to 1. Arguments broadcast."""
        water, root = np.sqrt(water_g_m3(air_degC, relative_humidity)), np.sqrt(np.asarray(range_m, np.float64))
        a, b = (np.exp(-root * (alpha + beta * water)) for alpha, beta in zip(self.alpha, self.beta, strict=True))
        return np.asarray(self.X * a + (1 - self.X) * b)


def water_g_m3(air_degC: ArrayLike, relative_humidity: ArrayLike) -> Float:
    """Water in a cubic metre of air, g; air_degC : °C, relative_humidity : 0 to 1; arguments broadcast."""
    t = np.asarray(air_degC, np.float64)
    return np.asarray(relative_humidity * np.exp(1.5587 + 0.06939 * t - 2.7816e-4 * t**2 + 6.8455e-7 * t**3))
