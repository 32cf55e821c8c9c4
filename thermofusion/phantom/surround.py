"""What stands round a phantom: walls, floor and ceiling of a finite room, warm and cold things in it, the operator.

The room is a round one of radius `span_m` and height `ceiling_m`; its temperature is a plane through the middle: one
wall warmer than the one opposite, the ceiling than the floor. Things (a window, a radiator, a lamp) are rectangles that
face the subject. Both stand at a distance: they move behind the subject as a camera walks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Bool, Float
from .physics import Band
from .scene import RoomConfig, ThingConfig

FACED_M = np.array([0.0, 0.0, 1.0])  # the point that things face: the middle of the subject
THING_GRID = 5  # points an edge of a thing, through which its light is gathered
OPERATOR_GRID = (2, 7)  # points across and up an operator
BEHIND_M = 0.35  # an operator stands this far behind the camera that is held out
OPERATOR_WIDTH_M = 0.45  # across the shoulders and the clothes
FAR_M = 1e6  # to a wall that a ray never meets

Visible = Callable[[NDArray, NDArray], Bool]


@dataclass(frozen=True, eq=False)
class Surround:
    """The room as light: in-band radiance from every place and direction, W m-2 sr-1."""

    room: RoomConfig
    band: Band

    @property
    def even(self) -> bool:
        """The same from every direction."""
        return not (self.room.side_K or self.room.floor_to_ceiling_K or self.room.things)

    def emit(self, degC: float) -> float:
        """Radiance of a black body."""
        return float(self.band.emit(np.array(degC)))

    def walls(self, eye_m: NDArray, direction: NDArray) -> Float:
        """Radiance (N,) of walls, floor and ceiling without the things; eye_m (3,) or (N, 3), direction (N, 3)."""
        r = self.room
        if not (r.side_K or r.floor_to_ceiling_K):
            return np.full(len(direction), self.emit(r.reflected_degC))
        eye = np.broadcast_to(eye_m, direction.shape).astype(np.float64)
        d = direction.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (d[:, :2] ** 2).sum(1), (d[:, :2] * eye[:, :2]).sum(1)
            inside = np.minimum((eye[:, :2] ** 2).sum(1) - r.span_m**2, 0)
            wall = np.where(a > 0, (-b + np.sqrt(np.maximum(b * b - a * inside, 0))) / a, FAR_M)
            level = np.where(d[:, 2] < 0, 0.0, r.ceiling_m)
            flat = np.where(d[:, 2] != 0, (level - eye[:, 2]) / d[:, 2], FAR_M)
        at = eye + np.minimum(wall, np.maximum(flat, 0))[:, None] * d
        azimuth = np.radians(r.side_deg) - np.pi / 2  # 0 = in front of the subject, as a walk's start_deg
        toward = at[:, :2] @ np.array([np.cos(azimuth), np.sin(azimuth)]) / r.span_m
        degC = r.reflected_degC + r.side_K * toward + r.floor_to_ceiling_K * (at[:, 2] / r.ceiling_m - 0.5)
        return self.band.emit(degC)

    def seen(self, eye_m: Float, direction: NDArray) -> Float:
        """Radiance (N,) with the things in it, for a camera at eye_m (3,) along direction (N, 3)."""
        if self.room.background_degC is not None:
            return np.full(len(direction), self.emit(self.room.background_degC))
        out = self.walls(eye_m, direction)
        for thing in self.room.things:
            center, across, up, normal = _frame(thing)
            with np.errstate(divide="ignore", invalid="ignore"):
                t = ((center - eye_m) @ normal) / (direction @ normal)
                at = eye_m + t[:, None] * direction - center
                on = (t > 0) & (np.abs(at @ across) < thing.width_m / 2) & (np.abs(at @ up) < thing.height_m / 2)
            out[on] = self.emit(thing.degC)
        return out

    def things_on(self, points_m: NDArray, normals: NDArray, visible: Visible) -> Float:
        """(V,) what the things add to the mean radiance over each hemisphere; points_m, normals (V, 3).

        visible : mask (N,) of free ways from points (N, 3) to a place (3,).
        """
        out = np.zeros(len(points_m))
        steps = (np.arange(THING_GRID) + 0.5) / THING_GRID - 0.5
        for thing in self.room.things:
            center, across, up, normal = _frame(thing)
            area_m2 = thing.width_m * thing.height_m / THING_GRID**2
            for place in (center + x * thing.width_m * across + y * thing.height_m * up for x in steps for y in steps):
                filled, way = _filled(points_m, normals, place, normal, area_m2)
                lit = np.flatnonzero(filled > 0)
                lit = lit[visible(points_m[lit], place)]
                more = self.emit(thing.degC) - self.walls(points_m[lit], way[lit])
                out[lit] += filled[lit] * more
        return out

    def operator_on(self, points_m: NDArray, normals: NDArray, eye_m: Float) -> Float:
        """(N,) what the operator adds to the mean radiance over the hemisphere of points that the camera sees.

        points_m, normals : (N, 3) in the room. eye_m : (3,) the camera; who stands behind it sees what it sees.
        """
        operator = self.room.operator
        if operator is None:
            return np.zeros(len(points_m))
        back = np.append(eye_m[:2], 0.0)
        back /= max(float(np.linalg.norm(back)), 1e-9)
        across = np.array([-back[1], back[0], 0.0])
        nx, nz = OPERATOR_GRID
        area_m2 = OPERATOR_WIDTH_M * operator.height_m / (nx * nz)
        out = np.zeros(len(points_m))
        foot = np.append(eye_m[:2], 0.0) + BEHIND_M * back
        for x in (np.arange(nx) + 0.5) / nx - 0.5:
            for z in (np.arange(nz) + 0.5) / nz:
                place = foot + x * OPERATOR_WIDTH_M * across + [0, 0, z * operator.height_m]
                filled, way = _filled(points_m, normals, place, -back, area_m2)
                out += filled * (self.emit(operator.degC) - self.walls(points_m, way))
        return out


def _filled(points_m: NDArray, normals: NDArray, place: Float, facing: Float, area_m2: float) -> tuple[Float, Float]:
    """Share (N,) of the cosine-weighted hemisphere that an area at a place fills, and the way there (N, 3)."""
    way = place - points_m.astype(np.float64)
    r = np.linalg.norm(way, axis=1)
    way /= r[:, None]
    cosines = np.maximum((way * normals).sum(1), 0) * np.maximum(-way @ facing, 0)
    return cosines * area_m2 / (np.pi * r**2), way


def _frame(thing: ThingConfig) -> tuple[Float, Float, Float, Float]:
    """Middle, directions of width and height, and normal of a thing, (3,) each."""
    center = np.array(thing.center_m)
    normal = FACED_M - center
    normal /= np.linalg.norm(normal)
    across = np.cross([0.0, 0.0, 1.0], normal)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    return center, across, np.cross(normal, across), normal
