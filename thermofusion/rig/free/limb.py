"""By how much a body's edge seems to lie inside it, because emissivity falls towards the limb.

On a round body the last pixels are seen at grazing angles, where skin emits little and mirrors the room: blurred, the
steepest step lies inside the true outline, the more the flatter the body bends away: 0.1 px on a finger of 5 px radius,
0.5 px on a trunk of 150 px. That looks like a smaller, farther body if it is not taken off.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ...physics.emissivity import PRESETS, Fresnel
from ...types import Float

RADII_PX = np.geomspace(2, 400, 24)  # of the table
STEP_PX = 0.01
SPAN_PX = 12.0  # to both sides of the outline
BLUR_PX = 1.22  # of lens and pixel, 0.7 px, and of the search for the steepest step, 1 px


@cache
def _table() -> Float:
    """(24,) where the steepest step lies for each radius of `RADII_PX`, px, negative inside."""
    x, model = np.arange(-SPAN_PX, SPAN_PX, STEP_PX), Fresnel(*PRESETS["dielectric"])
    out = []
    for r in RADII_PX:
        cos = np.sqrt(np.clip(1 - np.clip(1 + x / r, -1, 1) ** 2, 1e-12, 1))
        profile = np.where((x < 0) & (x > -2 * r), model.relative(cos), 0.0)
        fall = -np.gradient(gaussian_filter1d(profile, BLUR_PX / STEP_PX))
        near = np.abs(x) < SPAN_PX / 3
        out.append(float(x[near][np.argmax(fall[near])]))
    return np.array(out)


def limb_shift_px(cosine: Float, inside_px: float) -> Float:
    """Where the image's edge lies against the true outline, (N,) px, negative inside; the median where it is not known.

    cosine : (N,) of the viewing angle at a point inside_px within the outline, which tells the radius r of the bend:
    sinθ = 1 - inside/r. NaN = not known.
    """
    sine = np.sqrt(np.clip(1 - cosine**2, 0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.clip(inside_px / (1 - sine), RADII_PX[0], RADII_PX[-1])
    shift = np.interp(np.log(radius), np.log(RADII_PX), _table(), left=np.nan, right=np.nan)
    known = np.isfinite(radius) & np.isfinite(cosine)
    return np.where(known, shift, np.median(shift[known]) if known.any() else 0.0)
