"""What references say of the level: what blackbodies should have read, and contact thermometers on their vertices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import ScanError
from ..mapping.references import BlackbodyReading
from ..physics.band import ZERO_DEGC_K, Band
from ..physics.equation import apparent_radiance
from ..types import BlackbodyReference, ContactReference, Float, Int, Reference, SurfaceMesh

CONTACT_RADIUS_M = 0.006  # vertices this near to a contact thermometer's spot are under its tip
CONTACT_FAR_M = 0.03  # a spot farther off the surface is a mistake


@dataclass(frozen=True)
class ExpectedReading(BlackbodyReading):
    """A blackbody's reading, and what it should have been: in-band radiance, W m-2 sr-1.

    sigma_expected : one sigma of the source's temperature, common to all its readings. reflectivity : 1 - ε of it.
    """

    expected: float
    sigma_expected: float
    reflectivity: float = 0.0


@dataclass(frozen=True, eq=False)
class ContactReading:
    """A thermometer on the skin: radiance of a black body at its reading, at one or more vertices around the spot."""

    vertices: Int
    expected: float
    sigma_expected: float


def expected_readings(
    readings: Sequence[BlackbodyReading], references: Sequence[Reference], band: Band, L_room: float
) -> tuple[ExpectedReading, ...]:
    """What each blackbody should have read: ε L(T) + (1-ε) L_room, W m-2 sr-1."""
    out = []
    for reading in readings:
        source = references[reading.reference]
        assert isinstance(source, BlackbodyReference)
        T_K = source.degC + ZERO_DEGC_K
        expected = float(apparent_radiance(band.radiance(T_K), source.emissivity, L_room))
        sigma = source.emissivity * float(band.d_radiance_dT(T_K)) * source.uncertainty_K
        lost = 1 - source.emissivity
        out.append(ExpectedReading(**vars(reading), expected=expected, sigma_expected=sigma, reflectivity=lost))
    return tuple(out)


def under_sensor(surface: SurfaceMesh, p_m: Float) -> tuple[Int, float]:
    """Indices (K,) of the vertices under the tip of a contact sensor at p_m (3,), m, and its distance from them, m."""
    d = np.linalg.norm(surface.vertices_m - p_m.astype(np.float32), axis=1)
    return np.flatnonzero(d <= max(CONTACT_RADIUS_M, d.min())).astype(np.int32), float(d.min())


def contact_readings(
    references: Sequence[Reference], surface: SurfaceMesh, band: Band, place: object = None
) -> tuple[ContactReading, ...]:
    """Contact thermometers at the vertices around their spots. Raises ScanError for one that is off the surface."""
    readings = []
    for reference in references:
        if not isinstance(reference, ContactReference):
            continue
        vertices, off_m = under_sensor(surface, reference.p_world_m)
        if off_m > CONTACT_FAR_M:
            raise ScanError(
                f"a contact thermometer at {reference.p_world_m.tolist()} m is {off_m * 100:.0f} cm off the surface",
                place=place,
                hint="p_world_m is a point in the trajectory's world frame",
            )
        T_K = reference.degC + ZERO_DEGC_K
        sigma = float(band.d_radiance_dT(T_K)) * reference.uncertainty_K
        readings.append(ContactReading(vertices, float(band.radiance(T_K)), sigma))
    return tuple(readings)
