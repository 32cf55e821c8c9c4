"""The weighted, robust mean of each vertex's observations: millions of rows, in chunks, without sorting."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .overlap import TUKEY
from .types import Float, Float32, Int

CHUNK = 1_000_000  # rows worked on at once
L1_STEPS, TUKEY_STEPS = 4, 3
SCALE_ROWS = 200_000  # enough for a robust scale
L1_FLOOR = 0.3  # of one sigma: below it the L1 start is quadratic


@dataclass(frozen=True, eq=False)
class RobustMean:
    """Rows of y = E·x[vertex] with weights: x is the vertex's normal-equivalent excess over what it reflects."""

    vertex: Int
    y: Float
    E: Float
    weight: Float32  # statistical or geometric, before the robust factor
    robust: Float32  # weight in the end; written by `solve`
    n_vertices: int
    angle_corrected: bool
    statistical: bool  # weight is 1/σ² in radiance
    epsilon0: float  # 1 where nothing is corrected
    slope_L: float

    def solve(self, *, robust: bool, scale: float | None = None) -> Float:
        """x (V,); NaN without rows. Robust: weights of an L1 fit, then Tukey's.

        scale : of residuals over the rows' own σ; None = taken from the residuals.
        """
        x = self._estimate(self.weight)
        if not robust or not len(self.vertex):
            return x
        root = self._inverse_sigma()
        sample = self._scale_rows() if scale is None else None
        for _ in range(L1_STEPS):
            self._reweight(x, root, L1_FLOOR * (scale or self._scale(x, root, sample)), _l1)
            x = self._estimate(self.robust)
        l1 = self.robust.copy()
        for _ in range(TUKEY_STEPS):
            self._reweight(x, root, TUKEY * (scale or self._scale(x, root, sample)), _tukey)
            self._keep_measured(l1)
            x = self._estimate(self.robust)
        return x

    def _reweight(self, x: Float, root: Float32, reach: float, factor: Callable[[Float32], Float32]) -> None:
        """Weights times a factor of the standardised residual in units of `reach`."""
        for c in chunks(len(self.vertex)):
            self.robust[c] = self.weight[c] * factor(np.abs(self._residual(x, c)) * root[c] / np.float32(reach))

    def _inverse_sigma(self) -> Float32:
        """1/σ of rows; for geometric weights relative, the scale makes up for it."""
        if self.statistical:
            return np.sqrt(self.weight)
        return np.sqrt(self.weight / np.float32(np.median(self.weight)))

    def _keep_measured(self, l1: Float32) -> None:
        """Vertices on which all rows contradict each other keep the weights of the L1 fit."""
        left = vertex_sums(self.vertex, self.robust, self.n_vertices)
        lost = left < 0.02 * vertex_sums(self.vertex, self.weight, self.n_vertices)
        if lost.any():
            rows = lost[self.vertex]
            self.robust[rows] = l1[rows]

    def _scale_rows(self) -> tuple[NDArray, Float]:
        """Rows that the robust scale is taken from, and what makes up for their vertex's own freedom.

        An even sample of the vertices with two rows or more, by number: whatever the views' order.
        """
        stride = max(1, len(self.vertex) // SCALE_ROWS)
        pick = np.flatnonzero(self.vertex % stride == 0)
        count = np.bincount(self.vertex[pick], minlength=self.n_vertices)[self.vertex[pick]]
        pick, count = pick[count > 1], count[count > 1]
        return pick, np.sqrt(count / (count - 1))

    def _scale(self, x: Float, root: Float32, sample: tuple[NDArray, Float] | None) -> float:
        """Robust scale of standardised residuals."""
        if sample is None or not len(sample[0]):
            return 1.0
        pick, freedom = sample
        return max(float(np.median(np.abs(self._residual(x, pick)) * root[pick] * freedom)) / 0.6745, 1e-3)

    def _residual(self, x: Float, rows: slice | NDArray) -> Float32:
        return np.asarray(self.y[rows] - self.E[rows] * x[self.vertex[rows]], np.float32)

    def _estimate(self, weight: Float32) -> Float:
        wE = weight * self.E
        a = self.denominator(weight)
        with np.errstate(invalid="ignore", divide="ignore"):
            return vertex_sums(self.vertex, wE * self.y, self.n_vertices) / np.where(a > 0, a, np.nan)

    def denominator(self, weight: Float32) -> Float:
        """Σ w E² per vertex."""
        return vertex_sums(self.vertex, weight * self.E * self.E, self.n_vertices)

    def scatter(self, x: Float) -> tuple[Float32, Float32]:
        """Per vertex: rms of residuals in sigmas of the rows' own errors, and in K; NaN with one row only."""
        ones = np.ones(len(self.vertex), np.float32)
        n = vertex_sums(self.vertex, ones, self.n_vertices)
        squares = np.concatenate([self._residual(x, c) ** 2 for c in chunks(len(self.vertex))] or [ones])
        with np.errstate(invalid="ignore", divide="ignore"):
            freedom = np.where(n > 1, n - 1, np.nan)
            sigmas = np.sqrt(vertex_sums(self.vertex, self.weight * squares, self.n_vertices) / freedom)
            weighted = vertex_sums(self.vertex, self.robust * squares, self.n_vertices)
            spread = np.sqrt(weighted / vertex_sums(self.vertex, self.robust, self.n_vertices) * n / freedom)
        return sigmas.astype(np.float32), (spread / self.slope_L).astype(np.float32)


def _l1(t: Float32) -> Float32:
    return np.asarray(1 / np.maximum(t, np.float32(1)), np.float32)


def _tukey(t: Float32) -> Float32:
    return np.asarray(np.clip(1 - t * t, 0, None) ** 2, np.float32)


def chunks(n: int) -> Iterator[slice]:
    """Slices of at most `CHUNK` rows."""
    for start in range(0, n, CHUNK):
        yield slice(start, min(start + CHUNK, n))


def vertex_sums(vertex: Int, values: NDArray, n_vertices: int) -> Float:
    """Sum of row values per vertex, (V,) float64."""
    out = np.zeros(n_vertices)
    for c in chunks(len(vertex)):
        out += np.bincount(vertex[c], weights=values[c], minlength=n_vertices)
    return out
