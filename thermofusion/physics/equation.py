"""The measurement equation, forwards and backwards, in in-band radiance; and the paper's own, in degrees Celsius.

Formulas, their sources and the golden values stand in docs/radiometry.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..types import Float


def apparent_radiance(
    L_surface: ArrayLike,
    epsilon: ArrayLike,
    L_reflected: ArrayLike,
    *,
    transmission: ArrayLike = 1.0,
    L_air: ArrayLike = 0.0,
    offset: ArrayLike = 0.0,
) -> Float:
    """What the camera reports: τ[ε L_s + (1-ε) L_r] + (1-τ) L_air + b.

    L_surface, L_reflected, L_air, offset b : W m-2 sr-1; epsilon ε, transmission τ : shares. All broadcast.
    """
    eps, tau = np.asarray(epsilon), np.asarray(transmission)
    leaving = eps * np.asarray(L_surface) + (1 - eps) * np.asarray(L_reflected)
    return np.asarray(tau * leaving + (1 - tau) * np.asarray(L_air) + np.asarray(offset))


def leaving_radiance(
    L_apparent: ArrayLike, *, transmission: ArrayLike = 1.0, L_air: ArrayLike = 0.0, offset: ArrayLike = 0.0
) -> Float:
    """Radiance that left the surface towards the camera: offset and air path removed.

    L_apparent, L_air, offset and the result : W m-2 sr-1; transmission : a share. All broadcast.
    """
    tau = np.asarray(transmission)
    return np.asarray((np.asarray(L_apparent) - np.asarray(offset) - (1 - tau) * np.asarray(L_air)) / tau)


def normal_equivalent(L_leaving: ArrayLike, relative_epsilon: ArrayLike, L_reflected: ArrayLike) -> Float:
    """What the camera would report looking straight on: L0 = L_r + (L - L_r)/E with E = ε(θ)/ε(0).

    Independent of ε(0); the radiance form of the paper's S step (Eqs. 26-27). L_leaving, L_reflected and the result : W
    m-2 sr-1; relative_epsilon E : dimensionless. All broadcast.
    """
    L_r = np.asarray(L_reflected)
    return np.asarray(L_r + (np.asarray(L_leaving) - L_r) / np.asarray(relative_epsilon))


def absolute(L_normal: ArrayLike, epsilon0: ArrayLike, L_reflected: ArrayLike) -> Float:
    """Radiance of a blackbody at the surface's temperature: L_s = L_r + (L0 - L_r)/ε(0).

    L_normal, L_reflected and the result : W m-2 sr-1; epsilon0 : a share. All broadcast.
    """
    L_r = np.asarray(L_reflected)
    return np.asarray(L_r + (np.asarray(L_normal) - L_r) / np.asarray(epsilon0))


def paper_chain(
    T_apparent_degC: ArrayLike, epsilon: ArrayLike, T_ambient_degC: ArrayLike, *, S: ArrayLike = 1.0
) -> tuple[Float, Float]:
    """The paper's own linear correction as printed, in degrees Celsius: (T_c, S·T_c).

    Eq. 25: T_c = (T - (1-ε) T_a)/ε. Eqs. 26-27 scale the Celsius value by S = T(0)/T_c(0), the ratio of measured to
    corrected temperature where the surface faces the camera. Linear in temperature and dependent on the unit
    (docs/radiometry.md, errata): kept for comparison. T_apparent_degC, T_ambient_degC, epsilon and S broadcast.
    """
    eps = np.asarray(epsilon)
    T_c = (np.asarray(T_apparent_degC) - (1 - eps) * np.asarray(T_ambient_degC)) / eps
    return np.asarray(T_c), np.asarray(np.asarray(S) * T_c)
