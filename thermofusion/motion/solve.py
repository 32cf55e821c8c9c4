"""The nodes' motion over time, solved against the surface: block tridiagonal, exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csr_matrix

from ..types import Float, Float32
from .graph import NodeGraph
from .rows import Normal, Sums

STRETCH_M, BEND_RAD = 6e-3, np.radians(5.0)  # between neighbours, one sigma: a joint between them must be able to bend
STRETCH_STEP_M, BEND_STEP_RAD = 1.5e-3, np.radians(0.3)  # of what a joint changes in `STEP_S`: it bends slowly
STEP_M, STEP_RAD = 8e-3, np.radians(1.6)  # in `STEP_S`, one sigma
STEP_S = 0.67
JUMP_SIGMAS = 2.5  # of a step, turn and shift together
SHAPE_M = 20e-3  # of the surface's error along its normal
CG_STEPS, CG_TOLERANCE = 30, 0.02
REST_M, REST_RAD = 40e-3, np.radians(9)  # towards rest


def edge_matrix(graph: NodeGraph, stretch_m: float = STRETCH_M, bend_rad: float = BEND_RAD) -> Float:
    """Rows (E, 9, 12) that hold two neighbours k, l together, over (ω_k, t_k, ω_l, t_l), in sigmas.

    Where l would be if it hung rigidly on k, against where it is (3); the same with k on l (3); ω_k - ω_l (3). To first
    order in ω, which stays below ten degrees.
    """
    a, b = graph.edge[:, 0], graph.edge[:, 1]
    d = graph.at_m[b] - graph.at_m[a]
    rows = np.zeros((len(d), 9, 12))
    eye = np.eye(3)
    rows[:, :3, :3] = -_cross(d) / stretch_m  # ω x d = -[d]x ω
    rows[:, :3, 3:6], rows[:, :3, 9:] = eye / stretch_m, -eye / stretch_m
    rows[:, 3:6, 6:9] = _cross(d) / stretch_m  # seen from b: ω_b x (-d) + t_b - t_a
    rows[:, 3:6, 9:], rows[:, 3:6, 3:6] = eye / stretch_m, -eye / stretch_m
    rows[:, 6:, :3], rows[:, 6:, 6:9] = eye / bend_rad, -eye / bend_rad
    return rows


def _cross(d: Float) -> Float:
    W = np.zeros((len(d), 3, 3))
    W[:, 0, 1], W[:, 0, 2], W[:, 1, 2] = -d[:, 2], d[:, 1], -d[:, 0]
    return W - np.swapaxes(W, 1, 2)


def held_matrix(graph: NodeGraph, rows: Float) -> Float:
    """(6K, 6K) normal matrix, per rad and m, of the edges' rows (E, 9, 12), and of the pull to rest."""
    k = len(graph)
    H = np.zeros((k, k, 6, 6))
    blocks = np.einsum("era,erb->eab", rows, rows)
    a, b = graph.edge[:, 0], graph.edge[:, 1]
    np.add.at(H, (a, a), blocks[:, :6, :6])
    np.add.at(H, (a, b), blocks[:, :6, 6:])
    np.add.at(H, (b, a), blocks[:, 6:, :6])
    np.add.at(H, (b, b), blocks[:, 6:, 6:])
    H[np.arange(k), np.arange(k)] += np.diag([REST_RAD**-2.0] * 3 + [REST_M**-2.0] * 3)
    return H.transpose(0, 2, 1, 3).reshape(6 * k, 6 * k)


@dataclass(frozen=True, eq=False)
class Steps:
    """How slowly the nodes move from knot to knot, and how slowly what joins neighbours changes: what is out of view
    goes on hanging on what is seen.

    node : (F-1, 6K) weights of the nodes' steps, a random walk's. joint : (F-1,) weights of `normal` (6K, 6K), the
    joints' own.
    """

    node: Float
    joint: Float
    normal: Float

    @classmethod
    def of(cls, graph: NodeGraph, knot_s: Float, twist: Float) -> Steps:
        """Between knots knot_s (F,), robust about twist (F, K, 6)."""
        E, K = len(graph.edge), len(graph)
        step = np.diff(twist, axis=0)
        share = STEP_S / np.diff(knot_s)
        node = share[:, None, None] * np.array([STEP_RAD**-2.0] * 3 + [STEP_M**-2.0] * 3)
        rows = edge_matrix(graph, STRETCH_STEP_M, BEND_STEP_RAD)
        place = (6 * graph.edge[:, :, None] + np.arange(6)).reshape(E, 1, 12).repeat(9, axis=1)
        R = csr_matrix((rows.ravel(), place.ravel(), np.arange(0, 108 * E + 1, 12)), shape=(9 * E, 6 * K))
        bent = (R @ step.reshape(-1, 6 * K).T).T.reshape(-1, E, 9)
        jump = unless_jump((node * step**2).sum(2))
        node = (node * jump[:, None, None]).repeat(K, axis=1).reshape(-1, 6 * K)
        joint = share * unless_jump(share[:, None] * (bent**2).sum(2))
        return cls(node, joint, (R.T @ R).toarray())

    def pull(self, step: Float) -> Float:
        """(F-1, 6K) of steps (F-1, 6K): their weights' matrices times them."""
        return np.asarray(self.node * step + self.joint[:, None] * (step @ self.normal))

    def at(self, knot: int) -> Float:
        """(6K, 6K) matrix of the step from a knot to the next; 0 before the first and after the last."""
        if not 0 <= knot < len(self.node):
            return np.zeros_like(self.normal)
        return np.asarray(np.diag(self.node[knot]) + self.joint[knot] * self.normal)


def unless_jump(size2: Float) -> Float:
    """(F-1,) weights of steps between knots from their squared sizes (F-1, N), in sigmas, of nodes or joints.

    A foot that is set aside pays once, and what hangs on it, seen or not, goes with it: where one of them jumps beyond
    `JUMP_SIGMAS`, none is held (Geman-McClure).
    """
    return np.asarray((1 + size2.max(axis=1) / JUMP_SIGMAS**2) ** -2.0)


@dataclass(frozen=True, eq=False)
class Solved:
    """twist : (F, K, 6) new. shape_m : (P,) by which the points move along their normals. steps : of conjugate
    gradients."""

    twist: Float
    shape_m: Float
    steps: int


def solve_motion(
    sums: Sums, normal: Normal, J: csr_matrix, twist: Float, held: Float, steps: Steps, share: float
) -> Solved:
    """One Gauss-Newton step of motion and shape together: data (weights times `share`), held, steps.

    J : (P, 6K) of the points' motion along their normals. twist : (F, K, 6) before, rad and m. held : (6K, 6K) of
    neighbours and rest. steps : what holds knots together.

    Shape, one number a point, is eliminated: what all frames say of a point in common is no motion. That couples all
    knots, so the system is solved by conjugate gradients, with the motion alone (block tridiagonal) as preconditioner.
    """
    F, m = len(twist), twist.shape[1] * 6
    old = twist.reshape(F, m)
    seen = sums.own.copy()  # (F, P) a point's weight at each knot
    seen[:-1] += sums.next
    seen[1:] += sums.next
    seen, total = share * seen, share * sums.weight + SHAPE_M**-2.0

    def data(x: Float) -> Float:
        y = (J @ x.T).T
        z = share * sums.own * y
        z[:-1] += share * sums.next * y[1:]
        z[1:] += share * sums.next * y[:-1]
        return z - seen * ((seen * y).sum(0) / total)

    def regular(x: Float) -> Float:
        z = x @ held
        step = steps.pull(np.diff(x, axis=0))
        z[1:] += step
        z[:-1] -= step
        return z

    def own(f: int) -> Float:
        return normal.matrix(share * sums.own[f]) + held + steps.at(f - 1) + steps.at(f)

    def after(f: int) -> Float:
        return normal.matrix(share * sums.next[f]) - steps.at(f)

    factored = Tridiagonal.of(F, own, after)
    pull = share * (sums.pull - seen / share * (sums.weight * sums.residual * share / total))
    b = (J.T @ pull.T).T - regular(old)
    x, taken = _conjugate_gradients(lambda v: (J.T @ data(v).T).T + regular(v), b, factored)
    y = (J @ x.T).T
    shape = (share * sums.weight * sums.residual - (seen * y).sum(0)) / total
    return Solved((old + x).reshape(twist.shape), shape, taken)


def _conjugate_gradients(times: Callable[[Float], Float], b: Float, factored: Tridiagonal) -> tuple[Float, int]:
    x = np.zeros_like(b)
    r, z = b, factored.solve(b)
    p, rz = z, float((b * z).sum())
    first = rz
    for n in range(CG_STEPS):
        q = times(p)
        alpha = rz / float((p * q).sum())
        x, r = x + alpha * p, r - alpha * q
        z = factored.solve(r)
        rz, before = float((r * z).sum()), rz
        if rz < CG_TOLERANCE**2 * first:
            return x, n + 1
        p = z + rz / before * p
    return x, CG_STEPS


@dataclass(frozen=True, eq=False)
class Tridiagonal:
    """A symmetric block tridiagonal matrix, factored: lower factors (F of (m, m)) and what lies below them."""

    lower: list[Float32]
    below: list[Float32]

    @classmethod
    def of(cls, count: int, own: Callable[[int], Float], after: Callable[[int], Float]) -> Tridiagonal:
        """own(f) : (m, m) on the diagonal, f < count. after(f) : right of it, f < count - 1. Asked for one by one, for
        only the factors are kept."""
        lower, below = [], []
        block = own(0)
        for f in range(count):
            L = cholesky(block.astype(np.float32), lower=True, check_finite=False)
            lower.append(L)
            if f + 1 < count:
                B = solve_triangular(L, after(f).astype(np.float32), lower=True, check_finite=False)
                below.append(B)
                block = own(f + 1) - B.T @ B
        return cls(lower, below)

    def solve(self, b: Float) -> Float:
        """x (F, m) for b (F, m)."""
        F, x = len(self.lower), np.empty_like(b)
        z: list[Float32] = []
        right = np.zeros(0, np.float32)
        for f in range(F):
            y = b[f].astype(np.float32) if f == 0 else b[f].astype(np.float32) - self.below[f - 1].T @ z[-1]
            z.append(solve_triangular(self.lower[f], y, lower=True, check_finite=False))
        for f in range(F - 1, -1, -1):
            y = z[f] if f + 1 == F else z[f] - self.below[f] @ right
            right = solve_triangular(self.lower[f], y, lower=True, trans=1, check_finite=False)
            x[f] = right
        return x
