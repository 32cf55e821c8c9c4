"""The paper's emissivity models and its corrections, worded once for all figures; and the colours the models bear."""

from __future__ import annotations

import numpy as np

from ..physics.band import ZERO_DEGC_K, Band
from ..physics.emissivity import Cosine, EmissivityModel, Fresnel
from ..physics.equation import normal_equivalent, paper_chain
from ..report.plot import BLUE, DASHED, ORANGE, PURPLE
from ..types import Float

FACING_DEG = 10.0  # below this the surface faces the camera: what Eq. 26 takes S from
SKIN: dict[str, EmissivityModel] = {  # Table 1
    "dielectric": Fresnel(1.33),
    "non-dielectric": Fresnel(1.33, 0.25),
    "cosine": Cosine(),
}
ALUMINIUM = Fresnel(2.84)  # anodised, ε(0) = 0.770
CYLINDER: dict[str, EmissivityModel] = {
    "dielectric": ALUMINIUM,
    "non-dielectric": Fresnel(2.84, 0.0003),
    "cosine": Cosine(ALUMINIUM.normal),  # the paper takes ε(0) = 0.77 here
}
STYLE = {"dielectric": (BLUE, ""), "non-dielectric": (ORANGE, DASHED), "cosine": (PURPLE, "2 3")}  # colour, dash


def eq25_degC(apparent_degC: Float, cos: Float, model: EmissivityModel, room_degC: float) -> Float:
    """Eq. 25 alone, (N,) °C. apparent_degC, cos : (N,), the cosine of the viewing angle; NaN = not seen."""
    return paper_chain(apparent_degC, _epsilon(model, cos), room_degC)[0]


def eqs25_27_degC(apparent_degC: Float, cos: Float, model: EmissivityModel, room_degC: float) -> Float:
    """Eqs. 25-27, (N,) °C; apparent_degC and cos as for `eq25_degC`. One S for all, from what faces the camera."""
    corrected = eq25_degC(apparent_degC, cos, model, room_degC)
    facing = cos >= np.cos(np.radians(FACING_DEG))
    return np.asarray(np.nanmedian(apparent_degC[facing]) / np.nanmedian(corrected[facing]) * corrected)


def by_radiance_degC(L: Float, cos: Float, model: EmissivityModel, L_reflected: Float | float, band: Band) -> Float:
    """The radiance method, normal-equivalent, °C, same shape as L.

    L : (..., N) apparent radiance, W m-2 sr-1. cos : (N,) of the viewing angle. L_reflected : scalar or (N,).
    """
    E = _epsilon(model, cos) / model.normal
    return band.temperature_K(normal_equivalent(L, E, L_reflected)) - ZERO_DEGC_K


def _epsilon(model: EmissivityModel, cos: Float) -> Float:
    """ε (N,), NaN where the cosine is."""
    seen = np.isfinite(cos)
    out = np.full(cos.shape, np.nan)
    out[seen] = model(cos[seen])
    return out
