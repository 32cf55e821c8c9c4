"""Point to plane between depth images: projective partners, robust weights, one joint solution for many views.

A point of view i finds its partner in view j by projection, not by search: a few thousand points cost a millisecond.
Residuals are distances along the partner's normal, weighted by depth noise (∝ z²) and a robust kernel. Deterministic:
plain sums in a fixed order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry import invert, se3_exp
from ..types import Float, Float32

NORMAL_STEP_PX = 2  # normals from differences over twice this: wide enough to average noise
NORMAL_JUMP = 0.06  # of the range: a normal across a depth step is none
MAX_NORMAL_DEG = 45.0  # partners must face alike
MIN_PARTNERS = 150
NOISE_FLOOR_M = 3e-4


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A depth image as points and normals, ready to be a partner.

    fx, fy, cx, cy : of the image. shape : (H, W). points, normals : (H*W, 3) float32, NaN = none. sample, and
    sample_normals : (N, 3) float64, an even sample that is sent to other views.
    """

    intrinsics: tuple[float, float, float, float]
    shape: tuple[int, int]
    points: Float32
    normals: Float32
    sample: Float
    sample_normals: Float

    @classmethod
    def of(cls, depth_m: Float32, intrinsics: tuple[float, float, float, float], samples: int) -> DepthMap:
        """From a depth image (H, W), metres, NaN = none."""
        fx, fy, cx, cy = intrinsics
        h, w = depth_m.shape
        x = ((np.arange(w) - cx) / fx).astype(np.float32)
        y = ((np.arange(h) - cy) / fy).astype(np.float32)
        points = np.stack([x[None] * depth_m, y[:, None] * depth_m, depth_m], axis=-1)
        normals = _normals(points).reshape(-1, 3)
        points = points.reshape(-1, 3)
        good = np.flatnonzero(np.isfinite(normals[:, 0]))
        # an even sample in image order: same input, same sample
        pick = good[np.linspace(0, len(good) - 1, min(samples, len(good))).astype(np.intp)] if len(good) else good
        return cls(
            intrinsics, (h, w), points, normals, points[pick].astype(np.float64), normals[pick].astype(np.float64)
        )

    def sample_only(self) -> DepthMap:
        """Without the image: what is left can be sent to other views, and takes little memory."""
        nothing = np.empty((0, 3), np.float32)
        return replace(self, points=nothing, normals=nothing)


def _normals(points: Float32) -> Float32:
    """Unit normals (H, W, 3) towards the camera, NaN at depth steps and holes."""
    s = NORMAL_STEP_PX
    du, dv = np.full_like(points, np.nan), np.full_like(points, np.nan)
    du[:, s:-s] = points[:, 2 * s :] - points[:, : -2 * s]
    dv[s:-s] = points[2 * s :] - points[: -2 * s]
    n = np.cross(dv, du)
    with np.errstate(invalid="ignore", divide="ignore"):
        n /= np.sqrt(np.einsum("ijk,ijk->ij", n, n))[..., None]
        limit = np.float32(NORMAL_JUMP) * points[..., 2]
        n[~((np.abs(du[..., 2]) < limit) & (np.abs(dv[..., 2]) < limit))] = np.nan
    return n


@dataclass(frozen=True, eq=False)
class Partners:
    """Points of one view with their partners in another, in the other's frame.

    points : (N, 3). normals : (N, 3) of the partners. residual_m : (N,) distance along them. share : of the points
    that project into the other image, how many found a partner; sent : points sent.
    """

    points: Float
    normals: Float
    residual_m: Float
    share: float
    sent: int

    @property
    def fitness(self) -> float:
        """Share of all points sent that found a partner."""
        return len(self.residual_m) / max(self.sent, 1)

    @property
    def residual_mm_at_1m(self) -> float:
        """Median distance, mm, with the growth of depth noise (z²) taken out."""
        if not len(self.residual_m):
            return float("nan")
        return float(np.median(np.abs(self.residual_m) / np.maximum(self.points[:, 2], 0.5) ** 2) * 1e3)


def find_partners(
    source: DepthMap, target: DepthMap, T_target_source: Float, reach_m: float, stride: int = 1
) -> Partners:
    """Partners of the source's sample in the target image, within `reach_m` along and thrice that across."""
    R, t = T_target_source[:3, :3], T_target_source[:3, 3]
    p = source.sample[::stride] @ R.T + t
    fx, fy, cx, cy = target.intrinsics
    h, w = target.shape
    z = np.maximum(p[:, 2], 1e-3)
    u, v = np.rint(p[:, 0] / z * fx + cx), np.rint(p[:, 1] / z * fy + cy)
    inside = np.flatnonzero((p[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < w) & (v < h))
    pixel = v[inside].astype(np.intp) * w + u[inside].astype(np.intp)
    p, n = p[inside], target.normals[pixel].astype(np.float64)
    d = p - target.points[pixel]
    r = np.einsum("ij,ij->i", d, n)
    facing = np.einsum("ij,ij->i", source.sample_normals[::stride][inside] @ R.T, n)
    with np.errstate(invalid="ignore"):
        good = (np.abs(r) < reach_m) & (np.einsum("ij,ij->i", d, d) < (3 * reach_m) ** 2)
        good &= facing > np.cos(np.radians(MAX_NORMAL_DEG))
    return Partners(p[good], n[good], r[good], float(good.mean()) if len(good) else 0.0, len(source.sample[::stride]))


def weights(partners: Partners) -> Float:
    """Weight of each residual: 1/z⁴ for depth noise, times a Geman-McClure factor at twice the residuals' spread."""
    r = partners.residual_m / partners.points[:, 2] ** 2
    sigma = max(1.4826 * float(np.median(np.abs(r))), NOISE_FLOOR_M)
    return np.asarray(1 / ((1 + (r / (2 * sigma)) ** 2) ** 2 * (partners.points[:, 2] ** 4 * sigma**2)))


def normal_equations(partners: Partners, T_world_target: Float) -> tuple[Float, Float]:
    """(6, 6) H and (6,) g of Σ w r² for a left twist (rotation, translation) of the source in the world."""
    w = weights(partners)
    R = T_world_target[:3, :3]
    x, n = partners.points @ R.T + T_world_target[:3, 3], partners.normals @ R.T
    J = np.concatenate([np.cross(x, n), n], axis=1)
    Jw = J * w[:, None]
    return Jw.T @ J, Jw.T @ partners.residual_m


def register(
    source: DepthMap,
    targets: Sequence[tuple[DepthMap, Float]],
    T_world_source: Float,
    reaches_m: Sequence[float],
    *,
    stride: int = 1,
) -> tuple[Float, Partners | None]:
    """Gauss-Newton of one view against fixed others: (T_world_source, partners in the best target at the end).

    reaches_m : one iteration each, from far to near. None for the partners if no target has enough.
    """
    T = T_world_source
    last: Partners | None = None
    for reach in reaches_m:
        H, g, last = np.zeros((6, 6)), np.zeros(6), None
        for target, T_world_target in targets:
            partners = find_partners(source, target, invert(T_world_target) @ T, reach, stride)
            if len(partners.residual_m) < MIN_PARTNERS // stride:
                continue
            h, b = normal_equations(partners, T_world_target)
            H, g = H + h, g + b
            if last is None or partners.fitness > last.fitness:
                last = partners
        if last is None:
            return T, None
        step = np.linalg.lstsq(H + 1e-9 * np.trace(H) * np.eye(6), -g, rcond=None)[0]
        T = se3_exp(step) @ T
        if np.abs(step).max() < 1e-6:
            break
    return T, last


def solve_jointly(
    maps: Sequence[DepthMap],
    poses: Float,
    edges: Sequence[tuple[int, int]],
    reach_m: float,
    *,
    fixed: int = 0,
    max_iterations: int = 8,
    tolerance: float = 1e-4,
) -> tuple[Float, float, bool]:
    """All poses (F, 4, 4) T_world_map at once, from point-to-plane residuals over all edges (source, target).

    The pose graph with its residuals kept instead of summarised: partners are found anew in every step. Pose `fixed`
    stays. Returns (poses, weighted rms in m, converged: last step below `tolerance` rad and m).
    """
    T, n, rms = poses.copy(), len(poses), float("nan")
    for _ in range(max_iterations):
        A, b, total, weight = np.zeros((6 * n, 6 * n)), np.zeros(6 * n), 0.0, 0.0
        for i, j in edges:
            partners = find_partners(maps[i], maps[j], invert(T[j]) @ T[i], reach_m)
            if len(partners.residual_m) < MIN_PARTNERS:
                continue
            h, g = normal_equations(partners, T[j])
            si, sj = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
            A[si, si] += h
            A[sj, sj] += h
            A[si, sj] -= h
            A[sj, si] -= h
            b[si] -= g
            b[sj] += g
            w = weights(partners)
            total, weight = total + float(w @ partners.residual_m**2), weight + float(w.sum())
        free = np.delete(np.arange(6 * n), np.arange(6 * fixed, 6 * fixed + 6))
        H = A[np.ix_(free, free)]
        H[np.diag_indices_from(H)] += 1e-9 * max(float(H.trace()) / len(H), 1e-12) + 1e-6
        x = np.zeros(6 * n)
        x[free] = np.linalg.solve(H, b[free])
        T = se3_exp(x.reshape(n, 6)) @ T
        rms = float(np.sqrt(total / weight)) if weight else float("nan")
        if np.abs(x).max() < tolerance:
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

    Each map keeps its `per_map` largest overlaps of at least `min_share` of its points.
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
        chosen = {j for _, j in _spread(found, per_map)} | {j for _, j in found if abs(i - j) == 1}
        pairs |= {(i, j) for j in chosen if (j, i) not in pairs}
    return sorted(pairs)


def _spread(found: list[tuple[float, int]], count: int) -> list[tuple[float, int]]:
    """Half the best, half evenly from the rest: small overlaps are what ties a loop together."""
    if len(found) <= count:
        return found
    head, tail = found[: count // 2], found[count // 2 :]
    pick: NDArray[np.intp] = np.linspace(0, len(tail) - 1, count - len(head)).astype(np.intp)
    return head + [tail[k] for k in pick]
