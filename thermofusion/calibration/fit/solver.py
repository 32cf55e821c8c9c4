"""Solving a bundle: SciPy's trust region on the sparse Jacobian, robust by reweighting, with covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_triangular
from scipy.optimize import OptimizeResult, least_squares
from scipy.sparse.linalg import LinearOperator

from ...types import Float
from .bundle import Options, Problem
from .cameras import from_rt
from .covariance import by_views, whispered

ROBUST_SIGMAS = 2.5  # residuals beyond this many sigmas count linearly (Huber)
ROBUST_START = 6.0  # the first round is milder, so that a poor start does not throw good points away
MAX_EVALUATIONS = 15  # of the residuals in a round; the next round goes on from there
MAX_ROUNDS = 20  # of reweighting; a fit that has not settled by then is reported as not converged
WEIGHTS_SETTLED = 0.05  # largest change of a weight between rounds that no longer matters to any number


@dataclass(frozen=True, eq=False)
class Fit:
    """A solved problem. covariance (P, P) has zeros for what was held; `sigma` are the noise levels found."""

    problem: Problem
    options: Options
    x: Float
    covariance: Float
    free: np.ndarray
    converged: bool
    message: str

    def block(self, key: str) -> Float:
        """The values (B,) of a block: px and none of a lens, rad and m of a pose."""
        return self.x[self.problem.slices[key]]

    def board_poses(self) -> dict[str, Float]:
        """T_hub_board (4, 4) by view, metres."""
        scale = float(np.exp(self.block("spacing")[0]))
        out = {}
        for view in self.problem.views:
            T = from_rt(self.block(f"view:{view.name}"))
            T[:3, 3] *= scale
            out[view.name] = T
        return out

    def block_covariance(self, key: str) -> Float:
        """(B, B) covariance of a block, its units (px, rad, m) squared; 0 where it was held."""
        s = self.problem.slices[key]
        return self.covariance[s, s]

    def resampled(self) -> Fit:
        """The fit with a covariance that knows what residuals of a view have in common (`covariance.by_views`)."""
        p, free = self.problem, self.free
        weight = p.weights(self.x, self.options, ROBUST_SIGMAS) if self.options.robust else None
        e, J = p.linearise(self.x, self.options, weight)
        number = np.cumsum(free) - 1
        boards = [number[s][free[s]] for s in (p.slices[f"view:{v.name}"] for v in p.views)]
        covariance = np.zeros_like(self.covariance)
        covariance[np.ix_(free, free)] = by_views(J[:, free].tocsr(), e, p.row_views(), boards)
        return replace(self, covariance=covariance)

    def residuals(self) -> dict[str, tuple[Float, np.ndarray]]:
        """By camera: (N, 2) px, and the view number of each; `depth_plane`: (N,) in sigmas of the samples."""
        p = self.problem
        out = {b.camera: (p.point_residuals(b, self.x)[0], b.view) for b in p.points}
        if p.depth is not None:
            out["depth_plane"] = (p.depth_residuals(p.depth, self.x)[0], p.depth.view)
        return out

    def rms_px(self, camera: str, views: set[str] | None = None) -> float:
        """Root mean square distance of projected and seen points, px, of the named views."""
        e, view = self.residuals()[camera]
        keep = np.array([views is None or v.name in views for v in self.problem.views])[view]
        return float(np.sqrt(np.mean(np.sum(e[keep] ** 2, axis=1)))) if keep.any() else float("nan")


def solve(problem: Problem, x0: Float, options: Options) -> Fit:
    """Least squares from x0 (P,), robust by reweighting; covariance from the final weighted normal equations.

    Each round weighs every point by its distance (Huber) and solves with SciPy's trust region on the sparse Jacobian,
    preconditioned by the Cholesky factor L of the normal equations, y = Lᵀ(x - x0), in which the problem is nearly
    round: board poses and focal length trade against each other over 1:1000. Rounds end when the weights are stable.
    """
    free = problem.free(options)
    x, converged, message = x0.copy(), False, ""
    weight = problem.weights(x, options, ROBUST_START) if options.robust else None
    for number in range(MAX_ROUNDS):
        x, result = _round(problem, x, options, free, weight)
        message = str(result.message)
        sigmas = ROBUST_START if number == 0 else ROBUST_SIGMAS
        new = problem.weights(x, options, sigmas) if options.robust else None
        settled = number > 0 and (new is None or weight is None or np.abs(new - weight).max() < WEIGHTS_SETTLED)
        weight, converged = new, bool(result.status > 0)
        if settled and result.status > 0:
            break
    J = problem.linearise(x, options, weight)[1]
    covariance = np.zeros((len(x), len(x)))
    covariance[np.ix_(free, free)] = np.linalg.inv(_normal_matrix(J[:, free]))
    return Fit(problem, options, x, covariance, free, converged, message)


def _round(
    problem: Problem, start: Float, options: Options, free: np.ndarray, weight: Float | None
) -> tuple[Float, OptimizeResult]:
    L = np.linalg.cholesky(_normal_matrix(problem.linearise(start, options, weight)[1][:, free]))

    def full(y: Float) -> Float:
        z = start.copy()
        z[free] += solve_triangular(L, y, trans="T", lower=True)
        return z

    last: dict[bytes, tuple[Float, sp.csr_matrix]] = {}

    def at(y: Float) -> tuple[Float, sp.csr_matrix]:
        key = y.tobytes()
        if key not in last:  # SciPy asks for residuals and Jacobian of the same place one after the other
            last.clear()
            e, J = problem.linearise(full(y), options, weight)
            last[key] = e, J[:, free].tocsr()
        return last[key]

    def jacobian(y: Float) -> LinearOperator:
        J = at(y)[1]
        return LinearOperator(
            J.shape,
            matvec=lambda v: J @ solve_triangular(L, np.ravel(v), trans="T", lower=True),
            rmatvec=lambda r: solve_triangular(L, J.T @ np.ravel(r), lower=True),
        )

    result = least_squares(
        lambda y: at(y)[0],
        np.zeros(free.sum()),
        jac=jacobian,
        tr_solver="lsmr",
        max_nfev=MAX_EVALUATIONS,
    )
    return full(result.x), result


def _normal_matrix(J: sp.csr_matrix) -> Float:
    """(F, F) JᵀJ, invertible where nothing was seen of a block."""
    return whispered((J.T @ J).toarray())
