"""What one view says of skin it sees obliquely, against the view that faces it: per angle, for every method.

The paper could only look at its Fig. 16; several views of one surface answer it in kelvin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..physics.band import ZERO_DEGC_K, Band
from ..physics.emissivity import EmissivityModel, model_from_recipe
from ..recipe import Recipe
from ..robust import SIGMA_PER_MAD
from ..temperature.room.stated import room_of
from ..types import Float, Observations, Scan
from .models import SKIN, by_radiance_degC, eqs25_27_degC

if TYPE_CHECKING:
    from ..pipeline import Result

# Finer where ε(θ) falls fast
BINS_DEG = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 55.0, 60.0, 65.0, 70.0, 75.0)
FACING_DEG = 25.0  # the view that faces a spot sees it at less than this
EDGE_PX = 4.0  # farther from silhouettes than this, so that only the angle differs
MIN_PAIRS = 50  # in a bin, to say anything: their median is good to a fifth of the spread


@dataclass(frozen=True, eq=False)
class Compared:
    """Every observation by every method.

    rows : the observations compared. angle_deg : (N,) by the ray. values_degC : method -> (N,).
    """

    rows: Observations
    angle_deg: Float
    values_degC: dict[str, Float]

    def against_facing(self) -> tuple[NDArray[np.intp], dict[str, Float]]:
        """(index (M,) of rows that see obliquely what another view faces, method -> difference to it (M,), K)."""
        rows = self.rows
        order = np.lexsort((self.angle_deg, rows.vertex))
        first = order[np.r_[True, np.diff(rows.vertex[order]) > 0]]
        best = np.full(int(rows.vertex.max(initial=0)) + 1, -1, np.intp)
        best[rows.vertex[first]] = first
        partner = best[rows.vertex]
        pairs = np.flatnonzero((self.angle_deg[partner] < FACING_DEG) & (partner != np.arange(len(rows))))
        return pairs, {name: T[pairs] - T[partner[pairs]] for name, T in self.values_degC.items()}


@dataclass(frozen=True, eq=False)
class ByAngle:
    """Differences per angle bin: centre_deg, pairs (bins,), and method -> median and robust spread (bins,), K."""

    centre_deg: Float
    pairs: NDArray[np.int64]
    median_K: dict[str, Float]
    spread_K: dict[str, Float]

    @classmethod
    def of(cls, angle_deg: Float, differences_K: dict[str, Float]) -> ByAngle:
        """From pairs at angle_deg (M,), and method -> differences_K (M,). Bins with fewer than 50 pairs are NaN.

        Spread: 1.4826 x median absolute deviation.
        """
        edges = np.asarray(BINS_DEG)
        index = np.digitize(angle_deg, edges) - 1
        inside = [np.flatnonzero(index == i) for i in range(len(edges) - 1)]

        def medians(x: Float) -> Float:
            return np.array([np.median(x[i]) if len(i) >= MIN_PAIRS else np.nan for i in inside])

        row = np.clip(index, 0, len(inside) - 1)  # what lies outside is in no bin
        median = {name: medians(x) for name, x in differences_K.items()}
        spread = {name: SIGMA_PER_MAD * medians(np.abs(x - median[name][row])) for name, x in differences_K.items()}
        return cls(0.5 * (edges[1:] + edges[:-1]), np.array([len(i) for i in inside]), median, spread)


def compared(result: Result, scan: Scan, recipe: Recipe, models: Mapping[str, EmissivityModel] = SKIN) -> Compared:
    """A result's observations by every method, normal-equivalent throughout (what a facing camera would read).

    models : of Eqs. 25-27 and of the radiance method, named as the paper's; the first one also by the camera's axis.
    Methods whose name begins with "joint" have the camera's offsets and field removed by the cross-calibration, and use
    the fitted ε(θ) and what the body itself adds to the reflection.
    """
    assert result.mapped is not None
    assert result.temperature is not None
    assert scan.thermal is not None
    rows = result.mapped.observations.select(result.mapped.observations.edge_px >= EDGE_PX)
    band = Band(*scan.thermal.camera.band_um)
    room_K = room_of(scan.environment, recipe.temperature).reflected_K
    cos = rows.cos_angle.astype(np.float64)
    L = rows.radiance.astype(np.float64)
    apparent = band.temperature_K(L) - ZERO_DEGC_K
    L_room = float(band.radiance(room_K))
    values = {"uncorrected": apparent}
    for name, model in models.items():
        values[f"Eqs. 25-27, {name}"] = eqs25_27_degC(apparent, cos, model, room_K - ZERO_DEGC_K)
    name, model = next(iter(models.items()))
    axis = _axis_cosine(result, rows)
    values[f"Eqs. 25-28 (axis), {name}"] = eqs25_27_degC(apparent, axis, model, room_K - ZERO_DEGC_K)
    for name, model in models.items():
        if name != "cosine":
            values[f"radiance, {name}"] = by_radiance_degC(L, cos, model, L_room, band)
    calibration = result.temperature.calibration
    if calibration is not None:
        L_camera = calibration.corrected(rows)
        values["offsets removed, uncorrected"] = band.temperature_K(L_camera) - ZERO_DEGC_K
        model = calibration.emissivity(model_from_recipe(recipe.temperature.emissivity, band))
        values["joint"] = by_radiance_degC(L_camera, cos, model, _reflected(result, rows, band, L_room), band)
    return Compared(rows, np.degrees(np.arccos(np.clip(cos, 0, 1))), values)


def _axis_cosine(result: Result, rows: Observations) -> Float:
    """|n·z| of Eq. 28, kept off zero."""
    assert result.mapped is not None
    z = result.mapped.views.T_world_thermal[:, :3, 2]
    n = result.mesh_in_world.surface.normals
    return np.clip(np.abs(np.einsum("ij,ij->i", n[rows.vertex].astype(np.float64), z[rows.view])), 0.05, 1)


def _reflected(result: Result, rows: Observations, band: Band, L_room: float) -> Float | float:
    """L_r of each row: the room, and the body where it fills the hemisphere (radiometry: (1 - F) L_room + F L_skin)."""
    assert result.temperature is not None
    fraction = result.temperature.body_fraction
    if fraction is None:
        return L_room
    skin = float(band.radiance(np.nanmedian(result.temperature.absolute_degC) + ZERO_DEGC_K))
    F = np.nan_to_num(fraction[rows.vertex].astype(np.float64))
    return np.asarray((1 - F) * L_room + F * skin)
