"""The weighted, robust mean of each vertex's observations: millions of rows, grouped by vertex."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_matrix

from ..robust import MAD_PER_SIGMA, TUKEY, huber_weight, tukey_weight
from ..types import Float, Float32, Int
from .loops.mean import Steps, robust_weights

L1_STEPS, TUKEY_STEPS = 4, 3
SCALE_ROWS = 200_000  # enough for a robust scale
L1_FLOOR = 0.3  # of one sigma: below it the L1 start is quadratic
KEPT = 0.25  # of its weight: what a row must keep to count among those that agree
FEW = 3  # rows: of more than these, a median tells what most of them say
FAR_BETTER = 0.75  # share of a vertex's weight: a row with as much is believed against the others
LEAST_WEIGHT = 0.02  # share of a vertex's weight that must survive Tukey's


@dataclass(frozen=True, eq=False)
class Groups:
    """Rows that belong together, one after the other: group g has the rows start[g]..start[g] + count[g] - 1.

    Every group has a row. vertex : (G,) the vertex each group stands for, rising.
    """

    vertex: Int
    start: NDArray[np.intp]
    count: NDArray[np.intp]

    @classmethod
    def by_vertex(cls, vertex: Int, n_vertices: int) -> tuple[Groups, NDArray]:
        """Groups of rows with the same number in vertex (N,), and the order (N,) that brings rows into groups and keeps
        it within them."""
        n = len(vertex)
        # a transposed sparse matrix is a counting sort
        sorted_ = csc_matrix((np.arange(n, dtype=np.int32), vertex, np.arange(n + 1)), shape=(n_vertices, n)).tocsr()
        count = np.diff(sorted_.indptr)
        present = np.flatnonzero(count)
        return cls(present.astype(np.int32), sorted_.indptr[present].astype(np.intp), count[present]), sorted_.data

    def __len__(self) -> int:
        return len(self.vertex)

    def part(self, first: int, last: int) -> tuple[Groups, slice]:
        """Groups `first` to `last`, the last excluded, and where their rows stand."""
        start = self.start[first:last]
        begin = int(start[0]) if len(start) else 0
        count = self.count[first:last]
        return Groups(self.vertex[first:last], start - begin, count), slice(begin, begin + int(count.sum()))

    def sums(self, values: NDArray) -> Float:
        """Sum of row values (N,), of any unit, per group, (G,) in their unit; positions are those of `vertex`."""
        if not len(self):
            return np.zeros(0)
        return np.asarray(np.add.reduceat(values, self.start, dtype=np.float64))

    def weighted_sums(self, weights: NDArray, columns: NDArray) -> Float:
        """Σ weights (N,) times rows of columns (N, K) per group, (G, K)."""
        n = len(weights)
        edges = np.append(self.start, n)
        return np.asarray(csr_matrix((weights, np.arange(n), edges), shape=(len(self), n)) @ columns, np.float64)

    def rows(self, values: NDArray) -> NDArray:
        """Values of groups (G,) at their rows, (N,)."""
        return np.repeat(values, self.count)

    def least(self, cost: NDArray) -> NDArray[np.intp]:
        """The row of least cost of each group, the first among equals, (G,)."""
        if not len(self):
            return np.zeros(0, np.intp)
        candidates = np.flatnonzero(cost == self.rows(np.minimum.reduceat(cost, self.start)))
        return candidates[np.searchsorted(candidates, self.start)]


@dataclass(frozen=True, eq=False)
class Solved:
    """Of a robust mean: x (G,), and the weight (N,) that each row had in the end."""

    x: Float
    weight: Float32


@dataclass(frozen=True, eq=False)
class RobustMean:
    """Rows of y = E·x with weights: x is a vertex's normal-equivalent excess over what it reflects.

    weight : (N,) statistical (1/σ² in radiance) or geometric.
    """

    groups: Groups
    y: Float
    E: Float
    weight: Float32
    statistical: bool

    def solve(self, *, robust: bool, scale: float | None = None) -> Solved:
        """x of all groups. Robust: weights of an L1 fit, then Tukey's; of few rows that disagree, see `_balanced`.

        scale : of residuals over the rows' own σ; None = taken from the residuals.
        """
        x, weight = self._estimate(self.weight), self.weight
        if not robust or not len(x):
            return Solved(x, weight)
        root = np.sqrt(self.weight if self.statistical else self.weight / np.float32(np.median(self.weight)))
        if scale is not None:
            weight = self._balanced(self._reweighted(root, scale))
            return Solved(self._estimate(weight), weight)
        sample = self._scale_rows()
        for _ in range(L1_STEPS):
            weight = self._weights(x, root, L1_FLOOR * self._scale(x, root, sample), huber_weight)
            x = self._estimate(weight)
        l1 = weight
        for _ in range(TUKEY_STEPS):
            weight = self._weights(x, root, TUKEY * self._scale(x, root, sample), tukey_weight)
            weight = self._measured_kept(weight, l1)
            x = self._estimate(weight)
        weight = self._balanced(weight)
        return Solved(self._estimate(weight), weight)

    def _reweighted(self, root: Float32, scale: float) -> Float32:
        """The weights of `solve` at a known scale: then no group depends on another."""
        steps = Steps(L1_STEPS, L1_FLOOR * scale, TUKEY_STEPS, TUKEY * scale, LEAST_WEIGHT)
        groups = self.groups
        return np.asarray(robust_weights(groups.start, groups.count, self.y, self.E, self.weight, root, steps))

    def residual(self, x: Float) -> Float32:
        """y - E·x of all rows (N,), W m-2 sr-1, of the groups' x (G,)."""
        return np.asarray(self.y - self.E * self.groups.rows(x), np.float32)

    def denominator(self, weight: Float32) -> Float:
        """Σ w E² per group (G,), of rows' weights (N,)."""
        return self.groups.sums(weight * self.E * self.E)

    def scatter(self, solved: Solved) -> tuple[Float, Float]:
        """Per group (G,): rms of residuals in sigmas of the rows' own, and in radiance; NaN with one row."""
        squares, n = self.residual(solved.x) ** 2, self.groups.count
        freedom = np.where(n > 1, n - 1, np.nan)
        sigmas = np.sqrt(self.groups.sums(self.weight * squares) / freedom)
        spread = self.groups.sums(self.weight * squares) / self.groups.sums(self.weight)
        return sigmas, np.sqrt(spread * n / freedom)

    def own_variance(self, solved: Solved, block: Int) -> Float:
        """Variance of x per group (G,) as its own rows say: (Σ h r)² over blocks of rows that may share an error.

        r : residuals; block : (N,) number of each row's, not falling within a group. A sandwich estimate; its n/(n-1)
        blocks make up for what a block takes of its own mean. NaN where a group has one block.
        """
        if not len(self.groups):
            return np.zeros(0)
        h = solved.weight * self.E / self.groups.rows(self.denominator(solved.weight))
        r = self.residual(solved.x)
        new = np.ones(len(block), bool)
        new[1:] = block[1:] != block[:-1]
        new[self.groups.start] = True
        starts = np.flatnonzero(new)
        sums = np.add.reduceat(h * r, starts, dtype=np.float64) ** 2
        first = np.searchsorted(starts, self.groups.start)
        n = np.diff(np.append(first, len(starts)))
        total = np.add.reduceat(sums, first)
        return np.where(n > 1, total * n / np.maximum(n - 1, 1), np.nan)

    def _estimate(self, weight: Float32) -> Float:
        wE = weight * self.E
        return self.groups.sums(wE * self.y) / self.groups.sums(wE * self.E)

    def _weights(self, x: Float, root: Float32, reach: float, factor: Callable[[NDArray], NDArray]) -> Float32:
        """Weights times a factor of the standardised residual in units of `reach`."""
        return np.asarray(self.weight * factor(np.abs(self.residual(x)) * root / np.float32(reach)), np.float32)

    def _measured_kept(self, weight: Float32, l1: Float32) -> Float32:
        """The weights; vertices on which all rows contradict each other keep those of the L1 fit."""
        lost = self.groups.sums(weight) < LEAST_WEIGHT * self.groups.sums(self.weight)
        return np.where(self.groups.rows(lost), l1, weight) if lost.any() else weight

    def _balanced(self, weight: Float32) -> Float32:
        """The weights; of groups of few rows no two of which agree, those of a random-effects mean.

        Views that contradict each other do not say which is right: all err by what they differ, τ², so that they count
        nearly alike, 1/(σ² + τ²); τ² is DerSimonian and Laird's (1986). A view known to be far better is followed.
        """
        if not self.statistical:
            return weight
        kept = self.groups.sums(weight > KEPT * self.weight)
        best = np.maximum.reduceat(self.weight, self.groups.start) if len(self.groups) else np.zeros(0)
        lost = (
            (kept <= 1)
            & (self.groups.count > 1)
            & (self.groups.count <= FEW)
            & (best < FAR_BETTER * self.groups.sums(self.weight))
        )
        if not lost.any():
            return weight
        residual, w, at = self.residual(self._estimate(self.weight)), self.weight.astype(np.float64), self.groups.rows
        total, squares = self.groups.sums(w * self.E**2), self.groups.sums((w * self.E**2) ** 2)
        Q, freedom = self.groups.sums(w * residual.astype(np.float64) ** 2), self.groups.count - 1
        tau2 = np.maximum(Q - freedom, 0) / np.maximum(total - squares / total, 1e-300)
        return np.where(at(lost), 1 / (1 / w + at(np.where(lost, tau2, 0.0))), weight).astype(np.float32)

    def _scale_rows(self) -> tuple[NDArray, Float]:
        """Rows that the robust scale is taken from, and what makes up for their vertex's own freedom.

        An even sample of the vertices with two rows or more, by number: whatever the views' order.
        """
        stride = max(1, len(self.y) // SCALE_ROWS)
        chosen = (self.groups.vertex % stride == 0) & (self.groups.count > 1)
        pick = np.flatnonzero(self.groups.rows(chosen))
        n = self.groups.rows(self.groups.count)[pick]
        return pick, np.sqrt(n / (n - 1))

    def _scale(self, x: Float, root: Float32, sample: tuple[NDArray, Float]) -> float:
        """Robust scale of standardised residuals."""
        if not len(sample[0]):
            return 1.0
        pick, freedom = sample
        return max(float(np.median(np.abs(self.residual(x)[pick]) * root[pick] * freedom)) / MAD_PER_SIGMA, 1e-3)
