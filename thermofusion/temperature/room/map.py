"""The room round the subject as a map over the sphere: what is known before it is looked at, and after."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry.sphere import COUNT, DIPOLE, N_CELLS, ORDERS, cell_directions, cell_of, cell_solid_angles, harmonics
from ...types import Bool, Float

QUADRUPOLE_K = 0.4  # one sigma of a coefficient of order 2
# What no view showed may differ from its continuation: one sigma, and the angle over which that is alike. Floor and
# ceiling are other surfaces than walls.
UNSEEN_K, UNSEEN_DEG = 1.2, 40.0
CHECK_SIGMAS = 3.0  # by which a stated temperature may differ from what is seen


@dataclass(frozen=True, eq=False)
class RoomPrior:
    """What is known of the room before the background is looked at.

    L : in-band radiance at the stated reflected temperature, W m-2 sr-1; slope_L : dL/dT there. sigma_K : of the stated
    temperature; dipole_K : one sigma of half the difference between opposite sides.
    """

    L: float
    slope_L: float
    sigma_K: float
    dipole_K: float

    @property
    def variances(self) -> Float:
        """(9,) of the coefficients, (W m-2 sr-1)²."""
        by_order = (self.sigma_K, self.dipole_K * DIPOLE, QUADRUPOLE_K)
        return np.array([(by_order[order] * self.slope_L) ** 2 for order in ORDERS])


@dataclass(frozen=True, eq=False)
class RoomMap:
    """Radiance that the room sends from each direction, W m-2 sr-1, and how far it is known.

    coefficients, covariance : (9,), (9, 9) of the harmonics. cells : (N_CELLS,) beyond them; 0 = as the harmonics, or
    not seen. seen : (N_CELLS,) that some view showed. slope_L : dL/dT at the room's temperature. difference_K,
    difference_sigma_K : mean over all directions as seen, without what is stated, less as stated, and one sigma of it;
    NaN where nothing was seen.
    """

    coefficients: Float
    covariance: Float
    cells: Float
    seen: Bool
    slope_L: float
    difference_K: float = float("nan")
    difference_sigma_K: float = float("nan")

    @classmethod
    def unseen(cls, prior: RoomPrior) -> RoomMap:
        """Nothing but the prior."""
        a = np.zeros(COUNT)
        a[0] = prior.L
        return cls(a, np.diag(prior.variances), np.zeros(N_CELLS), np.zeros(N_CELLS, bool), prior.slope_L)

    @property
    def measured(self) -> bool:
        return bool(self.seen.any())

    @property
    def contradicts(self) -> bool:
        """What is seen differs from what was stated by more than both can err."""
        return bool(abs(self.difference_K) > CHECK_SIGMAS * self.difference_sigma_K)

    def with_stated(self, prior: RoomPrior) -> RoomMap:
        """Together with what is stated of the mean over all directions."""
        gain = self.covariance[0] / (self.covariance[0, 0] + (prior.sigma_K * self.slope_L) ** 2)
        a = self.coefficients + gain * (prior.L - self.coefficients[0])
        return replace(self, coefficients=a, covariance=self.covariance - np.outer(gain, self.covariance[0]))

    def with_sides(self, missing: Float, covariance: Float) -> RoomMap:
        """Together with what a witness finds missing of the coefficients of order 1, (3,) W m-2 sr-1, and its
        covariance (3, 3)."""
        sides = np.array(ORDERS) == 1
        gain = self.covariance[:, sides] @ np.linalg.inv(self.covariance[np.ix_(sides, sides)] + covariance)
        a = self.coefficients + gain @ (missing - self.coefficients[sides])
        return replace(self, coefficients=a, covariance=self.covariance - gain @ self.covariance[sides])

    @property
    def seen_share(self) -> float:
        """Of the sphere."""
        return float(cell_solid_angles()[self.seen].sum() / (4 * np.pi))

    def told(self) -> dict[str, Any]:
        """For the report, K: the mean and half the difference between opposite sides (world axes), with one sigma."""
        a, sigma = self.coefficients / self.slope_L, np.sqrt(np.diag(self.covariance)) / self.slope_L
        return {
            "seen_share": self.seen_share,
            "mean_differs_from_stated_K": self.difference_K,
            "mean_sigma_K": float(sigma[0]),
            "sides_K": a[1:4] / DIPOLE,
            "sides_sigma_K": sigma[1:4] / DIPOLE,
            "largest_cell_K": float(self.cells[np.argmax(np.abs(self.cells))] / self.slope_L),
        }

    @property
    def modes(self) -> Float:
        """(9, R) independent errors of the coefficients, W m-2 sr-1: outer products add up to their covariance."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray((vectors * np.sqrt(np.maximum(values, 0)))[:, ::-1])

    def toward(self, direction: NDArray) -> Float:
        """Radiance from unit directions (N, 3), W m-2 sr-1."""
        return np.asarray(harmonics(direction) @ self.coefficients + self.cells[cell_of(direction)])

    def facing(self, normal: NDArray) -> float:
        """What a flat diffuse surface of this unit normal (3,) is lit by, W m-2 sr-1."""
        directions = cell_directions()
        weight = np.maximum(directions @ normal, 0) * cell_solid_angles()
        return float(weight @ self.toward(directions) / weight.sum())


def unseen_covariance(seen: Bool, slope_L: float) -> Float:
    """(9, 9) of the harmonics' coefficients, (W m-2 sr-1)²: what cells that no view showed, a mask seen (N_CELLS,), may
    add to them."""
    direction, weight = cell_directions()[~seen], cell_solid_angles()[~seen] / (4 * np.pi)
    apart = np.arccos(np.clip(direction @ direction.T, -1, 1))
    alike = (UNSEEN_K * slope_L) ** 2 * np.exp(-0.5 * (apart / np.radians(UNSEEN_DEG)) ** 2)
    project = harmonics(direction) * weight[:, None]
    return np.asarray(project.T @ alike @ project)
