"""Did the rig stay rigid? Views that disagree are named, and runs of views that agree among themselves are found.

Cameras on a tripod head get knocked between two stands of the board. Every view then still fits by itself, but no one
extrinsic fits all. For each view the misfit as a function of the extrinsic (six numbers; the board's pose eliminated)
is nearly a parabola; runs of consecutive views are chosen so that every view is best predicted by the *other* views of
its run (leave one out: splitting too finely predicts worse by itself and needs no penalty of taste).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...types import Float
from .bundle import EXTRINSIC_COLUMNS, POSE_COLUMNS, Problem

MIN_RUN = 3  # a state of the rig needs this many views to be told from an error in one
SPLIT_GAIN = 0.6  # one more run must lower the mean square prediction error to this share
OUTLIER_FACTOR = 2.5  # a view predicted this much worse than the median view of its run is named
OUTLIER_FLOOR_PX = 1.0  # ... but never for less than this, beyond the picking noise
MAX_RUNS = 6  # a rig that moved more often was not fixed at all


@dataclass(frozen=True, eq=False)
class Misfits:
    """Per view v: mean square pixel misfit c + 2 gᵀx + xᵀ H x of a change x (6,) of the extrinsic."""

    names: tuple[str, ...]
    c: Float  # (V,)
    g: Float  # (V, 6)
    H: Float  # (V, 6, 6)

    def at(self, v: int, x: Float) -> float:
        """px² of view v at a change x (6,) of the extrinsic, rad and m."""
        return float(self.c[v] + 2 * self.g[v] @ x + x @ self.H[v] @ x)


@dataclass(frozen=True)
class Grouping:
    """group : run of each view, by name; views left out as outliers keep the run they lie in.

    outliers : view -> px, rms at which the others of its run predict it.
    """

    group: dict[str, int]
    outliers: dict[str, float]

    @property
    def count(self) -> int:
        """Number of runs."""
        return len(set(self.group.values()))

    def names(self, number: int) -> list[str]:
        """The good views of a run."""
        return [n for n, g in self.group.items() if g == number and n not in self.outliers]


def misfits(problem: Problem, x: Float, camera: str = "thermal") -> Misfits:
    """Parabolas of every view that both the hub and `camera` see, at parameters x (P,); lenses held.

    The misfit is the sum of squared px over both cameras' points, divided by the points of `camera`.
    """
    hub_block = next(b for b in problem.points if b.camera == problem.hub)
    block = next(b for b in problem.points if b.camera == camera)
    e_h, J_h, _ = problem.point_residuals(hub_block, x)
    e_c, J_c, _ = problem.point_residuals(block, x)
    names, out = [], []
    for i, view in enumerate(problem.views):
        a, b = hub_block.view == i, block.view == i
        if a.sum() < 4 or b.sum() < 4:
            continue
        Jp = np.concatenate([J[rows][:, :, POSE_COLUMNS].reshape(-1, 6) for J, rows in ((J_h, a), (J_c, b))])
        Je = np.concatenate([np.zeros((2 * a.sum(), 6)), J_c[b][:, :, EXTRINSIC_COLUMNS].reshape(-1, 6)])
        e = np.concatenate([e_h[a].ravel(), e_c[b].ravel()])
        Q = np.linalg.qr(Jp)[0]  # project the board's pose out
        Je, e = Je - Q @ (Q.T @ Je), e - Q @ (Q.T @ e)
        n = b.sum()
        names.append(view.name)
        out.append((e @ e / n, Je.T @ e / n, Je.T @ Je / n))
    return Misfits(tuple(names), np.array([o[0] for o in out]), *(np.stack([o[k] for o in out]) for k in (1, 2)))


def find_groups(m: Misfits) -> Grouping:
    """Runs of views, and outliers. Views must be in the order of recording."""
    n = len(m.names)
    own = np.array([m.at(v, -np.linalg.solve(m.H[v] + 1e-9 * np.eye(6) * np.trace(m.H[v]), m.g[v])) for v in range(n)])
    best, cut = _segment(m, n, float(np.median(own)))
    runs = 1
    while runs < min(MAX_RUNS, n // MIN_RUN) and best[runs + 1] < SPLIT_GAIN * best[runs]:
        runs += 1
    bounds, end = [], n
    for k in range(runs, 0, -1):
        bounds.append((int(cut[k, end]), end))
        end = int(cut[k, end])
    group, outliers = {}, {}
    for number, (i, j) in enumerate(reversed(bounds)):
        loo = np.sqrt(np.maximum(_leave_one_out(m, i, j), 0))
        limit = max(OUTLIER_FACTOR * float(np.median(loo)), OUTLIER_FLOOR_PX + float(np.sqrt(np.median(own))))
        for v, px in zip(range(i, j), loo, strict=True):
            group[m.names[v]] = number
            if px > limit:
                outliers[m.names[v]] = float(px)
    return Grouping(group, outliers)


def _segment(m: Misfits, n: int, floor: float) -> tuple[Float, Float]:
    """Dynamic programme: best[k] mean square prediction error with k runs, cut[k, j] start of the last run before j."""
    cost = np.full((n + 1, n + 1), np.inf)
    for i in range(n):
        for j in range(i + min(MIN_RUN, n), n + 1):
            loo = _leave_one_out(m, i, j)
            cap = floor + (2 * OUTLIER_FLOOR_PX) ** 2 + OUTLIER_FACTOR**2 * float(np.median(loo))
            cost[i, j] = np.minimum(loo, cap).sum()
    K = min(MAX_RUNS, max(1, n // MIN_RUN))
    total, cut = np.full((K + 2, n + 1), np.inf), np.zeros((K + 2, n + 1))
    total[0, 0] = 0
    for k in range(1, K + 1):
        for j in range(1, n + 1):
            options = total[k - 1, :j] + cost[:j, j]
            cut[k, j], total[k, j] = np.argmin(options), options.min()
    return total[:, n] / n, cut


def _leave_one_out(m: Misfits, i: int, j: int) -> Float:
    """(j - i,) mean square px at which the other views of the run predict each view; robust to a few bad ones."""
    index = np.arange(i, j)
    if len(index) == 1:
        return m.c[index]
    w = np.ones(len(index))
    for _ in range(8):  # views that the run does not explain lose their say (Geman-McClure on the px scale)
        x = _minimum(m, index, w)
        r = np.array([m.at(int(v), x) for v in index])
        s = np.median(r) + 0.25
        w = (1 / (1 + r / (9 * s))) ** 2
    H, g = np.einsum("v,vij->ij", w, m.H[index]), w @ m.g[index]
    ridge = 1e-6 * np.trace(H) * np.eye(6)
    rest = [(H - w[k] * m.H[v] + ridge, g - w[k] * m.g[v]) for k, v in enumerate(index)]
    x_rest = np.linalg.solve(np.stack([a for a, _ in rest]), -np.stack([b for _, b in rest])[..., None])[..., 0]
    return np.array([m.at(int(v), x) for v, x in zip(index, x_rest, strict=True)])


def _minimum(m: Misfits, index: np.ndarray, w: Float) -> Float:
    H = np.einsum("v,vij->ij", w, m.H[index])
    return -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), w @ m.g[index])
