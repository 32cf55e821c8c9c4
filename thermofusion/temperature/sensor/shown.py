"""What a camera adds to its pictures, for who reads a result: a table over the image, beside the views' offsets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...types import Float
from .field import ImageField
from .pattern import Pattern

NODES_ACROSS = 64  # intervals across the image: between nodes a field of order four is straight to a hundredth
DECIMALS = 5


def table(field: ImageField, sensor: Pattern | None, slope_L: float) -> dict[str, Any]:
    """{"u_px": (W,), "v_px": (H,), "K": (H, W)}: what every picture has in common beside its offset, K at skin level.

    slope_L : dL/dT, W m-2 sr-1 K-1. Between nodes it is read bilinearly. Holds the smooth field and the places of a
    fixed pattern; its single columns and rows, and what drifts between shutters, are left out.
    """
    still = None if sensor is None or not sensor.place_K else sensor
    down = max(1, round(NODES_ACROSS * field.height_px / field.width_px))
    u, v = np.linspace(0, field.width_px - 1, NODES_ACROSS + 1), np.linspace(0, field.height_px - 1, down + 1)
    uu, vv = (a.ravel() for a in np.meshgrid(u, v))
    added = field(uu, vv) + (0.0 if still is None else _places(still, uu, vv))
    K = np.round(added / slope_L, DECIMALS).reshape(len(v), len(u))
    return {"u_px": u, "v_px": v, "K": K}


def _places(sensor: Pattern, u_px: NDArray, v_px: NDArray) -> Float:
    """The places of a fixed pattern at pixels (N,), W m-2 sr-1."""
    drift = len(replace(sensor, place_K=0.0, column_K=0.0, row_K=0.0).precision()) if sensor.drift_K else 0
    alone = replace(sensor, drift_K=0.0, column_K=0.0, row_K=0.0)
    n = len(alone.precision())
    alone = replace(alone, coefficients=sensor.coefficients[drift : drift + n])
    return alone(u_px, v_px, np.zeros(len(u_px), np.intp))
