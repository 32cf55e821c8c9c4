"""How certain a bundle is, where residuals of a view have something in common.

What a model leaves over (a bent board, a lens that five numbers do not describe, depth that errs by place) is alike in
a whole picture: its thousand residuals are one witness. Views are what is independent. The covariance is
that of leaving each view out in turn (Bell & McCaffrey 2002, their third correction), where it exceeds the one of
independent residuals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_triangular

from ...types import Float

LEAST_LEFT = 0.1  # of what is known along a direction must stay when a view is left out: else it is not left out there
WHISPER = 1e-12  # of the diagonal


def by_views(J: sp.csr_matrix, e: Float, view: np.ndarray, boards: Sequence[np.ndarray]) -> Float:
    """(F, F) covariance of F free unknowns: those that all views share, and those of each view's own board.

    J (M, F), e (M,) : whitened Jacobian and residuals at the solution; view (D,) : of the first D rows, the rest are
    priors; boards : columns of each view's board. Along each direction of the shared unknowns, in units of what
    independent residuals would leave, it is the larger of one and what leaving out views gives, drawn toward its
    mean as far as so few views scatter (Ledoit & Wolf 2004).
    """
    shared = np.setdiff1d(np.arange(J.shape[1]), np.concatenate(boards))
    rest = J[len(view) :, shared]
    information = (rest.T @ rest).toarray()
    followed, parts = [], []
    for number, own in enumerate(boards):
        rows = np.flatnonzero(view == number)
        A, Q = J[rows][:, shared].toarray(), J[rows][:, own].toarray()
        N = whispered(Q.T @ Q)
        G = np.linalg.solve(N, Q.T @ A)  # the board follows the shared unknowns
        A = A - Q @ G
        followed.append((own, G, np.linalg.inv(N)))
        parts.append((A.T @ A, A.T @ e[rows]))
        information += parts[-1][0]
    out = np.zeros((J.shape[1], J.shape[1]))
    follows = np.zeros((J.shape[1], len(shared)))
    follows[shared] = np.eye(len(shared))
    for own, G, of_its_own in followed:
        follows[own] = -G
        out[np.ix_(own, own)] = of_its_own
    if not len(shared):
        return out
    L = np.asarray(np.linalg.cholesky(whispered(information)), np.float64)
    shifts = np.array([_left_out(L, *part) for part in parts])
    values, vectors = _larger(shifts)
    root = follows @ solve_triangular(L, vectors * np.sqrt(values), trans="T", lower=True)
    return out + root @ root.T


def whispered(N: Float) -> Float:
    """A normal matrix (F, F), changed in place: a whisper more on its diagonal, for unknowns nothing was seen of."""
    N[np.diag_indices_from(N)] *= 1 + WHISPER
    return N


def _left_out(L: Float, information: Float, score: Float) -> Float:
    """(S,) what leaving a view out moves the shared unknowns by, in units of L⁻ᵀ."""
    part = solve_triangular(L, solve_triangular(L, information, lower=True).T, lower=True)
    share, directions = np.linalg.eigh(0.5 * (part + part.T))
    along = directions.T @ solve_triangular(L, score, lower=True)
    return np.asarray(directions @ (along / np.maximum(1 - share, LEAST_LEFT)))


def _larger(shifts: Float) -> tuple[Float, Float]:
    """Eigenvalues (S,), vectors (S, S) of the covariance that shifts (V, S) of views left out tell, none below one."""
    V, S = shifts.shape
    factor = (V - 1) / V
    found = factor * shifts.T @ shifts
    mean = float(np.trace(found)) / S
    off = np.sum((found - mean * np.eye(S)) ** 2)
    noise = np.sum((V * factor * np.einsum("vi,vj->vij", shifts, shifts) - found) ** 2) / V**2
    toward = min(1.0, float(noise / off)) if off > 0 else 1.0
    values, vectors = np.linalg.eigh((1 - toward) * found + toward * mean * np.eye(S))
    return np.maximum(values, 1.0), vectors
