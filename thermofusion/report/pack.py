"""A result's columns as the page takes them: small, and exact where the page computes with them.

Whole numbers in byte planes, differences first where neighbours are alike; then gzip. Temperatures keep their float32
bits, places stand on a grid of 1 µm; errors are squares of bytes (1 % of themselves). `page/data.js` undoes it.
"""

from __future__ import annotations

import base64
import gzip
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..regions.errors import VertexErrors
from ..regions.measure import Measurer
from ..temperature.solve import Temperature

GRID_M = 1e-6  # of places: far below what a temperature gradient of the skin can show
LEVEL = 4  # of gzip: level 5 takes a third longer and saves one percent, level 9 ten times
FINE_K = 1e-3  # of temperatures that are only looked at
MISSING = 65535


class Columns:
    """Packed columns and their description, in order."""

    def __init__(self) -> None:
        self.described: list[dict[str, Any]] = []
        self._planes: list[bytes] = []

    def whole(self, name: str, values: NDArray, size: int, *, delta: bool = False, **meaning: Any) -> None:
        """Whole numbers (N,) in `size` bytes each; delta : zigzag of first differences. meaning : for the page."""
        q = np.asarray(values, np.int64).ravel()
        if delta:
            d = np.diff(q, prepend=0)
            q = (d << 1) ^ (d >> 63)
        code = q.astype("<u8").view(np.uint8).reshape(-1, 8)[:, :size]
        self._planes.append(np.ascontiguousarray(code.T).tobytes())
        known = {"code": "whole"} | meaning
        self.described.append({"name": name, "count": len(q), "bytes": size, "delta": delta, **known})

    def exact(self, name: str, values: NDArray) -> None:
        """float32 (N,), every bit; any unit."""
        self.whole(name, np.ascontiguousarray(values, np.float32).view(np.uint32), 4, code="float32")

    def steps(self, name: str, values: NDArray, step: float, size: int = 2) -> None:
        """Values (N,) of any unit in even steps above their lowest; NaN kept."""
        known = np.isfinite(values)
        low = float(values[known].min()) if known.any() else 0.0
        last = 256**size - 1
        if known.any():
            step = max(step, float(values[known].max() - low) / (last - 1))
        q = np.where(known, np.round((np.nan_to_num(values) - low) / step), last)
        self.whole(name, q, size, delta=size > 1, code="step", step=step, offset=low, missing=last)

    def squares(self, name: str, values: NDArray) -> None:
        """Errors (N,) ≥ 0 of any unit as squares of a byte."""
        step = float(np.nan_to_num(values).max(initial=0)) / 254**2 or 1.0
        q = np.where(np.isfinite(values), np.round(np.sqrt(np.nan_to_num(values) / step)), 255)
        self.whole(name, q, 1, code="square", step=step, missing=255)

    def text(self) -> str:
        """All of it, gzip and base64."""
        return base64.b64encode(gzip.compress(b"".join(self._planes), LEVEL, mtime=0)).decode("ascii")


def pack(temperature: Temperature, measurer: Measurer) -> tuple[Columns, dict[str, Any]]:
    """Columns of a result, and what the page must know of its errors."""
    mesh, body, out = temperature.mesh, measurer.body, Columns()
    low = np.floor(body.vertices_m.min(axis=0) / GRID_M) * GRID_M
    grid = np.round((body.vertices_m - low) / GRID_M)
    for k, axis in enumerate("xyz"):
        out.whole(axis, grid[:, k], 4, delta=True, code="step", step=GRID_M, offset=float(low[k]), missing=None)
    a, b, c = body.triangles.T.astype(np.int64)
    out.whole("a", a, 4, delta=True)
    for name, corner in (("b", b - a), ("c", c - a)):
        out.whole(name, (corner << 1) ^ (corner >> 63), 4)
    out.exact("temperature", mesh.temperature_degC)
    out.steps("apparent", mesh.apparent_degC, FINE_K)
    out.steps("normal_equivalent", temperature.normal_equivalent_degC, FINE_K)
    out.squares("sigma", mesh.uncertainty_K)
    out.steps("angle", mesh.view_angle_deg, 0.5, 1)
    out.whole("count", np.minimum(mesh.observations, 65535), 2)
    out.whole("flags", mesh.flags, 1)
    if mesh.moved_mm is not None:
        out.squares("moved", mesh.moved_mm)
    if mesh.surface.color_rgb is not None:
        out.whole("color", mesh.surface.color_rgb.T >> 2, 1)
    return out, _errors(out, measurer.errors)


def _errors(out: Columns, errors: VertexErrors) -> dict[str, Any]:
    out.squares("noise", errors.noise_K)
    width = errors.noise_K_m / np.maximum(errors.noise_K, 1e-12)
    out.squares("noise_width", np.where(errors.noise_K > 0, width, 0))
    out.squares("normals", errors.normals_K)
    out.squares("rest", errors.rest_K)
    askew_step = np.maximum(np.abs(errors.askew_K).max(axis=0, initial=0) / 127, 1e-9)
    steps = np.maximum(np.abs(errors.common_K).max(axis=0, initial=0) / 127, 1e-9)
    out.whole("askew", _signed(errors.askew_K / askew_step), 1)
    out.whole("common", _signed(errors.common_K / steps), 1)
    return {
        "names": errors.names,
        "steps": steps,
        "levels": errors.level_K,
        "window_m": min(errors.normal_window_m, 1e6),
        "askew_step": askew_step,
    }


def _signed(values: NDArray) -> NDArray:
    """(N, C) of -127..127 as bytes 0..254 in columns, C x N: each one more than twice as far from its neighbour."""
    return (np.round(values) + 127).astype(np.int64).T
