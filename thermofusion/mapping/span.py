"""How far away the room is, from the parallax of what the views show of it.

A wall moves behind the subject as the camera walks: what a camera sees obliquely stands elsewhere, seen from the
subject, and a window that is seen past the subject looks smaller than it is to the subject. The room is taken as a ball
about the subject, of the radius under which the background agrees best with itself; endless where that gains nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..physics.band import Band
from ..types import Camera, Float, ThermalViews
from .background import Background
from .scatter import disagreement

SPANS_M = (5.0, 3.5, 2.5, 1.8)  # radii that are tried: indoors
EVEN = 0.1  # of the disagreement, below which nothing in the room stands out
LEAST_GAIN = 0.015  # of the disagreement: even rooms gain up to .008 by chance


def from_middle(origins_m: NDArray, directions: NDArray, middle_m: NDArray, span_m: float) -> NDArray:
    """Directions (N, 3), seen from middle_m (3,), of where rays from origins_m (N, 3) along unit directions (N, 3) meet
    the ball of radius span_m about it; as they are for an endless one, and from outside of it."""
    if not np.isfinite(span_m):
        return directions
    away = origins_m - middle_m
    along = (away * directions).sum(axis=1)
    room = along**2 - (away**2).sum(axis=1) + span_m**2
    at = away + (np.sqrt(np.maximum(room, 0)) - along)[:, None] * directions
    out = at / np.maximum(np.linalg.norm(at, axis=1, keepdims=True), 1e-9)
    return np.where((room > 0)[:, None], out, directions).astype(directions.dtype)


def placed(background: Background, views: ThermalViews, middle_m: Float, lens: Camera, band: Band) -> Background:
    """The background with directions as seen from the subject's middle_m (3,), in a room of the span that fits best."""
    best, least = background, disagreement(background, lens, band)
    if not least > EVEN:
        return background
    least -= LEAST_GAIN
    eyes_m = views.T_world_thermal[background.view, :3, 3].astype(np.float32)
    reach_m = float(np.linalg.norm(eyes_m - middle_m, axis=1).max(initial=0.0))
    for span_m in SPANS_M:
        if span_m < reach_m:
            break
        direction = from_middle(eyes_m, background.direction, middle_m.astype(np.float32), span_m)
        tried = replace(background, direction=direction, span_m=span_m, middle_m=middle_m)
        cost = disagreement(tried, lens, band)
        if cost < least:
            best, least = tried, cost
    return best
