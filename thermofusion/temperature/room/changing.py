"""What changed from view to view, as the recording states it of its frames: room, air, the sensor's own temperature.

All views are brought to one room, the mean of what is stated: what the room of a view adds to its readings beyond that,
(1 - ε(θ)) t (L_room,i - L_room), is taken off before anything is solved. Air of its own temperature and water
stands in each view's path. Between frames that state a value it runs straight in time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...mapping.background import Background
from ...physics.air import AirModel
from ...physics.band import ZERO_DEGC_K, Band
from ...physics.emissivity import AngleTable, EmissivityModel
from ...physics.equation import leaving_radiance
from ...recipe import TemperatureSection
from ...types import Environment, Float, Observations, Scan, ThermalStream, ThermalViews
from ..references import ExpectedReading

SENSOR = ("fpa_degC", "lens_degC")  # what a camera's pattern may follow
LEAST_CHANGE_K = 0.05  # of a sensor's temperature over the views: less tells nothing


@dataclass(frozen=True, eq=False)
class Changing:
    """Of M views. None = the same for all of them, as the environment says.

    environment : of the scan, or the means of what its frames state. room : (M,) radiance of each view's room less that
    of the common one, W m-2 sr-1. air_degC : (M,). path : (M,) extinction of each view's air over that of the mean.
    sensor_degC : (M,) by name, what the camera's pattern may follow.
    """

    environment: Environment
    room: Float | None = None
    air_degC: Float | None = None
    path: Float | None = None
    sensor_degC: Mapping[str, Float] = field(default_factory=dict)

    @classmethod
    def of(cls, scan: Scan, views: ThermalViews, settings: TemperatureSection, band: Band) -> Changing:
        """Of the views of a scan; what the recipe states, it states for all of them."""
        assert scan.thermal is not None
        stated, environment = _of_views(scan.thermal, views), scan.environment
        if settings.reflected_degC is not None:
            stated.pop("reflected_degC", None)
        if settings.air_degC is not None:
            stated.pop("air_degC", None)
            environment = replace(environment, air_degC=settings.air_degC)
        means = {k: float(v.mean()) for k, v in stated.items() if k in vars(environment)}
        environment = replace(environment, **means)
        room = None
        if "reflected_degC" in stated:
            L = band.radiance(stated["reflected_degC"] + ZERO_DEGC_K)
            room = L - float(band.radiance(means["reflected_degC"] + ZERO_DEGC_K))
        sensor = {k: v for k, v in stated.items() if k in SENSOR and np.ptp(v) > LEAST_CHANGE_K}
        return cls(environment, room, stated.get("air_degC"), _path(stated, environment), sensor)

    def without_air(self, rows: Observations, transmission_per_m: float, air_K: float, band: Band) -> Observations:
        """Observations (N,) with each view's air path removed; transmission_per_m : of the mean air, of air_K, K."""
        air = air_K if self.air_degC is None else self.air_degC + ZERO_DEGC_K
        tau = transmission_per_m if self.path is None else transmission_per_m**self.path
        return remove_air_path(rows, tau, float(band.radiance(air)) if np.ndim(air) == 0 else band.radiance(air))

    def in_one_room(self, rows: Observations, open_share: NDArray, emissivity: EmissivityModel) -> Observations:
        """Observations (N,) as the common room would light them; open_share : (V,) of the hemisphere that is room."""
        if self.room is None:
            return rows
        lost = 1 - AngleTable.of(emissivity)(rows.cos_angle)
        more = lost * open_share[rows.vertex] * self.room.astype(np.float32)[rows.view]
        return replace(rows, radiance=np.asarray(rows.radiance - more, np.float32))

    def lit(self, readings: Sequence[ExpectedReading]) -> tuple[ExpectedReading, ...]:
        """Blackbodies' readings with what they should have been in the room of their own view."""
        if self.room is None:
            return tuple(readings)
        more = [r.reflectivity * float(self.room[r.view]) for r in readings]
        return tuple(replace(r, expected=r.expected + m) for r, m in zip(readings, more, strict=True))

    def of_common_room(self, background: Background) -> Background:
        """The background as the common room would show it."""
        if self.room is None:
            return background
        L = background.radiance - self.room[background.view]
        return replace(background, radiance=L.astype(np.float32))


def remove_air_path(
    observations: Observations, transmission_per_m: float | NDArray, L_air: float | NDArray
) -> Observations:
    """Observations (N,) with the air between surface and camera removed: L = (L' - (1-τ) L_air)/τ, τ = τ₁^range.

    transmission_per_m, L_air : of all views, or (M,) of each; L_air in W m-2 sr-1.
    """
    if np.all(np.asarray(transmission_per_m) == 1.0):
        return observations

    def of_rows(value: float | NDArray) -> float | NDArray:
        return np.asarray(value, np.float32)[observations.view] if np.ndim(value) else value

    tau = np.float32(of_rows(transmission_per_m)) ** observations.range_m
    L = leaving_radiance(observations.radiance, transmission=tau, L_air=of_rows(L_air))
    return replace(observations, radiance=L.astype(np.float32))


def _of_views(stream: ThermalStream, views: ThermalViews) -> dict[str, Float]:
    """What is stated of a stream's frames, at its views (M,): between frames that state it, straight in time."""
    out = {}
    for name, column in ({} if stream.conditions is None else stream.conditions.stated).items():
        known = np.isfinite(column)
        out[name] = np.interp(stream.times_s[views.frame], stream.times_s[known], column[known])
    return out


def _path(stated: Mapping[str, Float], mean: Environment) -> Float | None:
    """(M,) extinction of each view's air over that of the mean air; None = always the same."""
    air, water = (stated.get(k, getattr(mean, k)) for k in ("air_degC", "relative_humidity_pct"))
    if air is None or water is None or np.ndim(air) + np.ndim(water) == 0:
        return None
    usual = (getattr(mean, k) for k in ("air_degC", "relative_humidity_pct"))
    return np.asarray(_extinction(air, water) / _extinction(*usual))


def _extinction(air_degC: float | NDArray, relative_humidity_pct: float | NDArray) -> Float:
    """-ln τ of a metre of air."""
    return np.asarray(-np.log(AirModel().transmission(1.0, air_degC, np.asarray(relative_humidity_pct) / 100)))
