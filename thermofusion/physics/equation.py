"""The measurement equation, forwards and backwards, and the paper's own correction.

Inside the method everything is linear in in-band radiance L [W m-2 sr-1]; a temperature is computed once, at the end.
Skin of radiance L_s in surroundings of radiance L_r, seen at the angle θ, leaves

    L = L_r + E(θ)·x,      x = ε(0)·(L_s - L_r),      E = ε(θ)/ε(0),

and the camera reports L' = τL + (1-τ)L_air + γ(L - L_pivot) + b + φ(u, v). x is the excess that the camera would report
looking straight on: ε(0) plays no part until the end. Sources and golden values stand in docs/radiometry.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..types import Float

# ---------------------------------------------------------------- forwards


def excess_reading(x: ArrayLike, E: ArrayLike, offset: ArrayLike) -> NDArray:
    """E·x + offset: what a view reports above the reflected radiance, W m-2 sr-1; scalars or arrays that broadcast."""
    return np.asarray(np.asarray(E) * np.asarray(x) + np.asarray(offset))


def apparent_radiance(
    L_surface: ArrayLike,
    epsilon: ArrayLike,
    L_reflected: ArrayLike,
    *,
    transmission: ArrayLike = 1.0,
    L_air: ArrayLike = 0.0,
    offset: ArrayLike = 0.0,
) -> Float:
    """What the camera reports: τ[ε L_surface + (1-ε) L_reflected] + (1-τ) L_air + offset, all W m-2 sr-1, τ the
    transmission; scalars or arrays that broadcast.

    With the normal-equivalent radiance in place of L_surface, epsilon is E(θ).
    """
    eps, tau = np.asarray(epsilon), np.asarray(transmission)
    leaving = eps * np.asarray(L_surface) + (1 - eps) * np.asarray(L_reflected)
    return np.asarray(tau * leaving + (1 - tau) * np.asarray(L_air) + np.asarray(offset))


def with_gain(L: ArrayLike, gain: float, L_pivot: float) -> NDArray:
    """Radiance as a camera of another gain about L_pivot reports it: L + γ(L - L_pivot), gain = 1 + γ; any shape."""
    return np.asarray(gain * np.asarray(L) - (gain - 1) * L_pivot)


# ---------------------------------------------------------------- backwards


def leaving_radiance(
    L_apparent: ArrayLike, *, transmission: ArrayLike = 1.0, L_air: ArrayLike = 0.0, offset: ArrayLike = 0.0
) -> Float:
    """Radiance that left the surface towards the camera: (L_apparent - offset - (1 - transmission) L_air)/transmission,
    W m-2 sr-1; scalars or arrays that broadcast."""
    tau = np.asarray(transmission)
    return np.asarray((np.asarray(L_apparent) - np.asarray(offset) - (1 - tau) * np.asarray(L_air)) / tau)


def without_gain(L_reported: ArrayLike, offset: ArrayLike, gain: float, L_pivot: float) -> NDArray:
    """Inverse of `with_gain` after offset is taken off L_reported, W m-2 sr-1; scalars or arrays that broadcast."""
    return np.asarray((np.asarray(L_reported) - offset + (gain - 1) * L_pivot) / gain)


def normal_equivalent(L_leaving: ArrayLike, relative_epsilon: ArrayLike, L_reflected: ArrayLike) -> Float:
    """What the camera would report looking straight on: L0 = L_r + (L - L_r)/E with E = ε(θ)/ε(0), W m-2 sr-1.

    Independent of ε(0); the radiance form of the paper's S step (Eqs. 26-27). L_leaving L, relative_epsilon E and
    L_reflected L_r are scalars or arrays that broadcast.
    """
    return absolute(L_leaving, relative_epsilon, L_reflected)


def absolute(L_normal: ArrayLike, epsilon0: ArrayLike, L_reflected: ArrayLike) -> Float:
    """Radiance of a blackbody at the surface's temperature: L_reflected + (L_normal - L_reflected)/epsilon0,
    W m-2 sr-1; scalars or arrays that broadcast."""
    L_r = np.asarray(L_reflected)
    return surface_radiance(np.asarray(L_normal) - L_r, epsilon0, L_r)


def surface_radiance(x: ArrayLike, epsilon: ArrayLike, L_reflected: ArrayLike) -> Float:
    """L_reflected + x/epsilon of an excess x, W m-2 sr-1: a blackbody's at the surface's temperature, or (ε = 1)
    straight on; scalars or arrays that broadcast."""
    return np.asarray(np.asarray(L_reflected) + np.asarray(x) / np.asarray(epsilon))


# ---------------------------------------------------------------- the paper's


def paper_chain(
    T_apparent_degC: ArrayLike, epsilon: ArrayLike, T_ambient_degC: ArrayLike, *, S: ArrayLike = 1.0
) -> tuple[Float, Float]:
    """The paper's own linear correction as printed, (T_c, S·T_c), °C, of T_apparent_degC in surroundings of
    T_ambient_degC; scalars or arrays that broadcast.

    Eq. 25: T_c = (T - (1-ε) T_a)/ε. Eqs. 26-27 scale the Celsius value by S = T(0)/T_c(0), the ratio of measured to
    corrected temperature where the surface faces the camera. Linear in temperature and dependent on the unit
    (docs/radiometry.md, errata): kept for comparison.
    """
    eps = np.asarray(epsilon)
    T_c = (np.asarray(T_apparent_degC) - (1 - eps) * np.asarray(T_ambient_degC)) / eps
    return np.asarray(T_c), np.asarray(np.asarray(S) * T_c)
