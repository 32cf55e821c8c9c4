"""All fragments in one solution: which of them see the same surface, and where they all belong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..geometry.rigid import invert, se3_exp
from ..types import Float
from .maps import DepthMap
from .registration import MIN_PARTNERS, find_partners, image_shift, normal_equations, shape_weights, trust

GOOD_SHARE = 0.4  # of a map's points: smaller overlaps, seen obliquely, serve where there are few better ones
CONVERGED = 1e-4  # rad and m: far below a voxel
LOOP_APART = 3  # maps this far apart in time that overlap close a loop


def solve_jointly(
    maps: Sequence[DepthMap],
    poses: Float,
    edges: Sequence[tuple[int, int]],
    reach_m: float,
    *,
    fixed: int = 0,
    stride: int = 1,
    max_iterations: int = 30,
) -> tuple[Float, float, bool]:
    """All poses (F, 4, 4) T_world_map at once, from point-to-plane residuals over all edges (source, target).

    The pose graph with its residuals kept instead of summarised: partners are found anew in every step. Pose `fixed`
    stays; `stride` thins the samples out. Returns (poses, weighted rms in m, converged: the last step was below 1e-4
    rad and m).
    """
    T, n, rms = poses.copy(), len(poses), float("nan")
    for _ in range(max_iterations):
        A, b, total, weight = np.zeros((6 * n, 6 * n)), np.zeros(6 * n), 0.0, 0.0
        for i, j in edges:
            T_j_i = invert(T[j]) @ T[i]
            partners = find_partners(maps[i], maps[j], T_j_i, reach_m, stride)
            if len(partners) < MIN_PARTNERS // stride:
                continue
            share = trust(image_shift(partners.shape.points, T_j_i))
            h, g = (share * of for of in normal_equations(partners, T[j]))
            si, sj = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
            A[si, si] += h
            A[sj, sj] += h
            A[si, sj] -= h
            A[sj, si] -= h
            b[si] -= g
            b[sj] += g
            w = shape_weights(partners.shape)
            total, weight = total + float(w @ partners.shape.residual**2), weight + float(w.sum())
        free = np.delete(np.arange(6 * n), np.arange(6 * fixed, 6 * fixed + 6))
        H = A[np.ix_(free, free)]
        H[np.diag_indices_from(H)] += 1e-9 * max(float(H.trace()) / len(H), 1e-12) + 1e-6
        x = np.zeros(6 * n)
        x[free] = np.linalg.solve(H, b[free])
        T = se3_exp(x.reshape(n, 6)) @ T
        rms = float(np.sqrt(total / weight)) if weight else float("nan")
        if np.abs(x).max() < CONVERGED:
            return T, rms, True
    return T, rms, False


def overlapping(
    maps: Sequence[DepthMap],
    poses: Float,
    reach_m: float,
    *,
    per_map: int,
    min_share: float,
    max_turn_deg: float = 75.0,
) -> list[tuple[int, int]]:
    """Pairs (source, target) of maps that see the same surface: neighbours in the list, and the best others.

    poses : (F, 4, 4) T_world_map. Each map keeps about `per_map` overlaps of at least `min_share` of its points.
    """
    axis = poses[:, :3, 2]
    near = axis @ axis.T > np.cos(np.radians(max_turn_deg))
    pairs: set[tuple[int, int]] = set()
    for i in range(len(maps)):
        found: list[tuple[float, int]] = []
        for j in np.flatnonzero(near[i]):
            if j == i:
                continue
            partners = find_partners(maps[i], maps[int(j)], invert(poses[j]) @ poses[i], reach_m, 8)
            if partners.fitness >= min_share:
                found.append((-partners.fitness, int(j)))
        found.sort()
        good = [f for f in found if -f[0] >= GOOD_SHARE]
        chosen = _spread(good if len(good) >= per_map // 2 else found, per_map)
        # in time the nearest, whatever they share; and of those far in time the best, for a loop hangs on it
        chosen += [f for f in found if abs(i - f[1]) == 1] + [f for f in found if abs(i - f[1]) >= LOOP_APART][:1]
        pairs |= {(i, j) for _, j in chosen if (j, i) not in pairs}
    return sorted(pairs)


def _spread(found: list[tuple[float, int]], count: int) -> list[tuple[float, int]]:
    """Half the best, half evenly from the rest: small overlaps are what ties a loop together."""
    if len(found) <= count:
        return found
    head, tail = found[: count // 2], found[count // 2 :]
    pick: NDArray[np.intp] = np.linspace(0, len(tail) - 1, count - len(head)).astype(np.intp)
    return head + [tail[k] for k in pick]
