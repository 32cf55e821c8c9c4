"""How far one observation can be trusted, and how the errors of many add up in one vertex.

The parts of one observation's error follow the error budget of docs/radiometry.md; each is a one-sigma in the radiance
that the camera reports, so that 1/Σσ² is the observation's statistical weight (it replaces the plain cosθ/d²).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .emissivity import AngleTable, EmissivityModel
from .radiometry import Band
from .types import Float, Float32, Observations

MAX_LEVER = 4.0  # bound on a normal error's lever near grazing, where the linear form no longer holds


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """One-sigma errors of what an observation depends on.

    netd_K : noise of a pixel. sigma_normal_deg : of the surface normal. sigma_shape : relative, of 1-E(θ).
    sigma_registration_px : of the thermal image on the surface. sigma_reflected_K : of the room's reflected temperature.
    gradient_K_per_m : temperature gradient along the surface, scalar or (V,).
    """

    netd_K: float = 0.05
    sigma_normal_deg: float = 2.0
    sigma_shape: float = 0.15
    sigma_registration_px: float = 0.5
    sigma_reflected_K: float = 1.0
    gradient_K_per_m: float | Float32 = 0.0


@dataclass(frozen=True, eq=False)
class AngleTables:
    """E(θ) = ε(θ)/ε(0) and |dE/dθ| [rad-1] as fast tables over cosθ."""

    relative: AngleTable
    slope: AngleTable

    @classmethod
    def of(cls, model: EmissivityModel) -> AngleTables:
        mu = AngleTable.knots()
        theta = np.arccos(np.clip(mu, 1e-4, 1 - 1e-9))
        slope = np.minimum(np.abs(model.derivative(theta)) / model.normal, MAX_LEVER)
        return cls(AngleTable.of(model.relative(mu)), AngleTable.of(slope))


def observation_variance(
    observations: Observations,
    excess: float | NDArray,
    tables: AngleTables,
    errors: ErrorModel,
    slope_L: float,
) -> Float32:
    """Variance of each observation about the model L_r + E·x + b, (N,) float32, (W m-2 sr-1)².

    excess : x, normal-equivalent radiance above what is reflected, scalar or (N,). slope_L : dL/dT at skin
    temperature, which turns K into radiance. Parts: noise; normals; shape of ε; registration on a gradient; T_refl.
    """
    cos = observations.cos_angle
    x = np.asarray(excess, np.float32)
    variance = np.full(len(cos), (errors.netd_K * slope_L) ** 2, np.float32)
    loss = 1 - tables.relative(cos)
    variance += (x * tables.slope(cos) * np.float32(np.radians(errors.sigma_normal_deg))) ** 2
    variance += (loss * (np.abs(x) * np.float32(errors.sigma_shape))) ** 2
    variance += (loss * np.float32(errors.sigma_reflected_K * slope_L)) ** 2
    gradient = np.asarray(errors.gradient_K_per_m, np.float32)
    if np.any(gradient):
        g = gradient.take(observations.vertex) if gradient.ndim else gradient
        variance += (g * np.float32(slope_L) * registration_m(observations, errors)) ** 2
    return variance


def registration_m(observations: Observations, errors: ErrorModel) -> Float32:
    """Registration error along the surface, m: pixels x range/(f cosθ), with range/f from the footprint."""
    per_px = np.sqrt(observations.footprint_m2 / np.maximum(observations.cos_angle, np.float32(0.05)))
    return np.asarray(np.float32(errors.sigma_registration_px) * per_px, np.float32)


def skin_slope(band: Band, radiance: NDArray) -> float:
    """dL/dT at the median of observed radiances: the factor between K and W m-2 sr-1 in weights and bounds."""
    typical = float(np.nanmedian(radiance[:: max(1, len(radiance) // 10_000)])) if len(radiance) else float("nan")
    T = float(band.temperature_K(typical))
    return float(band.d_radiance_dT(T if np.isfinite(T) else 306.15))


__all__ = ["AngleTables", "ErrorModel", "Float", "observation_variance", "registration_m", "skin_slope"]
