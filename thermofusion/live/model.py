"""The provisional model: means over small cubes of space, of place and apparent temperature; and what it lacks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project
from ..geometry.rigid import transform_points
from ..physics.band import ZERO_DEGC_K
from ..physics.signal import counts_to_kelvin
from ..tracking.frames import TrackingFrame
from ..types import Float, Float32, SignalCurve, ThermalCamera

CUBE_M = 0.008  # edge of a cube
SPAN = 2**20  # cubes along an axis: 8 km
MIN_COSINE = 0.4  # of the viewing angle for a temperature to count: 66 degrees
SECTORS = ("front", "front left", "left flank", "back left", "back", "back right", "right flank", "front right")
MISSING_SHARE = 0.15  # of the median sector's measured surface, below which a side is missing
SLOPE = 0.75  # of a normal along `up`, beyond which a surface faces up or down
MIN_OVERLAP = 500  # cubes seen before, from which the camera's drift can be told


def apparent_degC(signal: SignalCurve) -> NDArray[np.float32] | None:
    """(65536,) °C of all counts; None for signals that are no counts."""
    if signal.kind != "counts":
        return None
    with np.errstate(all="ignore"):
        return (counts_to_kelvin(signal, np.arange(65536.0)) - ZERO_DEGC_K).astype(np.float32)


def seen_by_thermal(frame: TrackingFrame, zoom: float, camera: ThermalCamera, image_degC: Float32) -> Float32:
    """Apparent temperature (H*W,) °C of a depth frame's pixels in a thermal image (h, w) °C of its time; NaN none."""
    surface = frame.map.surface
    out = np.full(len(surface), np.nan, np.float32)
    rows = np.flatnonzero(np.isfinite(surface[:, 3]))
    points = surface[rows, :3] / np.float32(zoom)
    cosine = -np.einsum("ij,ij->i", points, surface[rows, 3:]) / np.linalg.norm(points, axis=1)
    rows, points = rows[cosine > MIN_COSINE], points[cosine > MIN_COSINE]
    uv, _ = project(camera.lens, transform_points(camera.T_thermal_depth, points))
    u, v = np.rint(np.nan_to_num(uv.T, nan=-1)).astype(np.intp)
    h, w = image_degC.shape
    inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
    out[rows[inside]] = image_degC[v[inside], u[inside]]
    return out


def _sums(at: NDArray[np.intp], values: NDArray, n: int) -> Float:
    """(n, K) sums of values (N, K) by their row `at` (N,)."""
    columns = [np.bincount(at, column, n) for column in values.T]
    return np.stack(columns, axis=1).astype(np.float64)


class Model:
    """Grows by frames. up : which way is up in the first camera."""

    def __init__(self, up: tuple[float, float, float] = (0.0, -1.0, 0.0)) -> None:
        self._up = np.array(up) / np.linalg.norm(up)
        self._keys = np.empty(0, np.int64)
        self._sum = np.empty((0, 3))  # of places, m
        self._normal = np.empty((0, 3))
        self._count = np.empty(0)
        self._degC = np.empty((0, 2))  # sum and count of temperatures

    def __len__(self) -> int:
        return len(self._keys)

    def add(self, frame: TrackingFrame, zoom: float, T_world_depth: Float, degC: Float32 | None) -> float:
        """Add a frame whose pixels have temperatures degC (H*W,), NaN or None = none; the frame's drift in K.

        zoom : of the frame's depth. T_world_depth : (4, 4), m.
        """
        surface = frame.map.surface
        rows = np.flatnonzero(np.isfinite(surface[:, 3]))
        points = transform_points(T_world_depth, surface[rows, :3] / np.float32(zoom))
        normals = surface[rows, 3:] @ T_world_depth[:3, :3].T
        warm = np.full(len(rows), np.nan) if degC is None else degC[rows].astype(np.float64)
        cube = np.floor(points / CUBE_M).astype(np.int64) + SPAN // 2
        keys, at = np.unique((cube[:, 0] * SPAN + cube[:, 1]) * SPAN + cube[:, 2], return_inverse=True)
        n, known = len(keys), np.isfinite(warm)
        place, facing = _sums(at, points, n), _sums(at, normals, n)
        heat = _sums(at, np.stack([np.where(known, warm, 0), known], axis=1), n)
        drift = self._drift(keys, heat)
        self._merge(keys, place, facing, np.bincount(at, minlength=n).astype(float), heat)
        return drift

    def _drift(self, keys: NDArray[np.int64], heat: Float) -> float:
        """Median difference of a frame's temperatures to the model's, K; NaN where they share too little."""
        if not len(self._keys):
            return float("nan")
        row = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        both = (self._keys[row] == keys) & (heat[:, 1] > 0) & (self._degC[row, 1] > 0)
        if both.sum() < MIN_OVERLAP:
            return float("nan")
        old = self._degC[row[both]]
        return float(np.median(heat[both, 0] / heat[both, 1] - old[:, 0] / old[:, 1]))

    def _merge(self, keys: NDArray[np.int64], place: Float, facing: Float, count: Float, heat: Float) -> None:
        everything = np.union1d(self._keys, keys)
        old, new = np.searchsorted(everything, self._keys), np.searchsorted(everything, keys)

        def merged(before: Float, more: Float) -> Float:
            out = np.zeros((len(everything), *more.shape[1:]))
            out[old] = before
            out[new] += more
            return out

        self._sum, self._normal = merged(self._sum, place), merged(self._normal, facing)
        self._count, self._degC = merged(self._count, count), merged(self._degC, heat)
        self._keys = everything

    def points(self, most: int) -> Float32:
        """(N, 4) float32, at most `most`: place m in the world, apparent °C (NaN unmeasured)."""
        step = max(1, -(-len(self) // most))
        rows = slice(None, None, step)
        with np.errstate(invalid="ignore", divide="ignore"):
            degC = self._degC[rows, 0] / self._degC[rows, 1]
        return np.column_stack([self._sum[rows] / self._count[rows, None], degC]).astype(np.float32)

    def missing(self) -> tuple[str, ...]:
        """Sides of which little or nothing is measured, as the person in the first view would name them."""
        warm = self._degC[:, 1] > 0
        normal = self._normal[warm]
        if len(normal) < MIN_OVERLAP:
            return ("everything",)
        normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        along = normal @ self._up
        front = np.array([0.0, 0.0, -1.0]) + self._up * self._up[2]  # toward the first camera, level
        front /= np.linalg.norm(front)
        left = np.cross(self._up, front)  # of a person who looks at the camera
        flat = np.abs(along) < SLOPE
        angle = np.arctan2(normal[flat] @ left, normal[flat] @ front)
        sector = np.rint(angle / (2 * np.pi / len(SECTORS))).astype(int) % len(SECTORS)
        counts = np.bincount(sector, minlength=len(SECTORS))
        low = MISSING_SHARE * max(float(np.median(counts[counts > 0])), 1.0)
        return tuple(name for name, count in zip(SECTORS, counts, strict=True) if count < low)
