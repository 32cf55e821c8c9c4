"""What depth frames say of a moving surface: distances between its posed points and the frames, along the normals.

A point of the surface is looked up in a frame by projection, and compared with the depth that stands there. The points
and the nodes that carry them are the same in all frames, so what many frames say of one point is added up before
equations are formed: three numbers a point and knot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..robust import mad_sigma
from ..types import Float, Float32, Int
from .field import BoundPoints, MotionField, affine

MIN_COS = 0.35  # a point is looked up where it faces the camera within 70 degrees
MODEL_SIGMA_M = 1e-3  # of the surface itself, where many frames are averaged
CORRELATED = 5.0  # neighbouring points share the errors of surface and sensor: so many count as one
CUT_SIGMAS, CUT_REACH_M = 5.0, 0.06  # of residuals that judge
MIN_POINTS = 100  # of a frame
FAR_SIGMAS = 3.0  # a residual beyond it is no noise


@dataclass(frozen=True, eq=False)
class CoarseFrames:
    """Depth frames brought down to a size at which all of them are held.

    depth_m : N images (h, w) float32, NaN = none. intrinsics : fx, fy, cx, cy of them. times_s : (N,).
    T_world_depth : (N, 4, 4).
    """

    depth_m: Sequence[Float32]
    intrinsics: tuple[float, float, float, float]
    times_s: Float
    T_world_depth: Float

    def __len__(self) -> int:
        return len(self.depth_m)


@dataclass(frozen=True, eq=False)
class Sight:
    """What one frame says. point : (n,) which of the surface's. residual_m : (n,) from the posed point to what was
    measured, along its normal. sigma_m : (n,) noise. at_m, normal : (n, 3) posed, world."""

    point: Int
    residual_m: Float32
    sigma_m: Float32
    at_m: Float32
    normal: Float32


def look(
    frames: CoarseFrames, i: int, points: BoundPoints, pose: Float32, reach_m: float, noise_m_at_1m: float
) -> Sight:
    """Points posed by (P, 3, 4) affine motions, looked up in frame i within `reach_m`."""
    at = np.einsum("pij,pj->pi", pose[:, :, :3], points.at_m) + pose[:, :, 3]
    normal = np.einsum("pij,pj->pi", pose[:, :, :3], points.normal)
    T = frames.T_world_depth[i]
    R, eye = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    seen = at - eye
    facing = -np.einsum("pi,pi->p", seen, normal)
    range_m = np.sqrt(np.einsum("pi,pi->p", seen, seen))
    front = np.flatnonzero(facing > np.float32(MIN_COS) * range_m)
    local = seen[front] @ R
    fx, fy, cx, cy = (np.float32(k) for k in frames.intrinsics)
    image = frames.depth_m[i]
    h, w = image.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.rint(local[:, 0] / local[:, 2] * fx + cx)
        v = np.rint(local[:, 1] / local[:, 2] * fy + cy)
    inside = np.flatnonzero((local[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < w) & (v < h))
    u, v, front = u[inside], v[inside], front[inside]
    z = image[v.astype(np.intp), u.astype(np.intp)]
    n = normal[front] @ R
    measured = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1)
    r = np.einsum("pi,pi->p", n, measured - local[inside])
    with np.errstate(invalid="ignore"):
        good = np.flatnonzero((np.abs(r) < reach_m) & (np.abs(z - local[inside, 2]) < 2 * reach_m))
    front, z = front[good], z[good]
    sigma = np.sqrt((np.float32(noise_m_at_1m) * z * z) ** 2 + np.float32(MODEL_SIGMA_M**2))
    return Sight(front.astype(np.int32), r[good], sigma, at[front], normal[front])


@dataclass(frozen=True, eq=False)
class Sums:
    """Weighted sums over frames, for every knot and point: of s_f², of s_f s_f+1 and of s_f r, with the shares s of the
    frame's time between the knots. (F, P), (F - 1, P), (F, P); weight 1/m², residual m.

    weight, residual : (P,) of all frames together: the mean distance of the measurements from the point.
    """

    own: Float
    next: Float
    pull: Float
    weight: Float
    residual: Float
    scale: float
    rms_m: float


def gather(
    frames: CoarseFrames,
    rows: Sequence[int],
    points: BoundPoints,
    field: MotionField,
    reach_m: float,
    noise_m_at_1m: float,
    kernel_m: float,
) -> tuple[Sums, Float]:
    """All frames' `rows` compared with the moving points, and each frame's own correction (N, 6) as a left twist."""
    F, P = len(field.knot_s), len(points)
    own, after, pull = np.zeros((F, P)), np.zeros((max(F - 1, 0), P)), np.zeros((F, P))
    weight, total = np.zeros(P), np.zeros(P)
    at_knot = [affine(field.node_m, field.twist[f], points.binding) for f in range(F)]
    steps, spread, squares, count = np.zeros((len(frames), 6)), [], 0.0, 0.0
    for i in rows:
        a, b, s = field.slot(float(frames.times_s[i]))
        pose = at_knot[a] if s == 0 else np.float32(1 - s) * at_knot[a] + np.float32(s) * at_knot[b]
        sight = look(frames, i, points, pose, reach_m, noise_m_at_1m)
        spread.append((sight.residual_m / sight.sigma_m)[::7])
        w = (1 / ((1 + (sight.residual_m / kernel_m) ** 2) * sight.sigma_m**2)).astype(np.float64)
        p, r = sight.point, sight.residual_m.astype(np.float64)
        own[a, p] += (1 - s) ** 2 * w
        own[b, p] += s**2 * w
        if b > a:
            after[a, p] += s * (1 - s) * w
        pull[a, p] += (1 - s) * w * r
        pull[b, p] += s * w * r
        weight[p] += w
        total[p] += w * r
        steps[i] = _step(sight, w, r)
        squares, count = squares + float(w @ r**2), count + float(w.sum())
    sums = Sums(
        own,
        after,
        pull,
        weight,
        total / np.maximum(weight, 1e-12),
        mad_sigma(np.concatenate(spread)),
        float(np.sqrt(squares / max(count, 1e-12))),
    )
    return sums, steps


@dataclass(frozen=True, eq=False)
class LeftOver:
    """What frames that were not fitted to leave of the moving points, in sigmas, outliers cut at `CUT_SIGMAS`.

    rms : of all; NaN where nothing is seen. of_point : (P,) rms of each point, 0 where it was not seen. times_s,
    far_share : (n,) of the frames: when, and which share of the points seen is farther off than noise explains.
    """

    rms: float
    of_point: Float
    times_s: Float
    far_share: Float


def left_over(
    frames: CoarseFrames, rows: Sequence[int], points: BoundPoints, field: MotionField, noise_m_at_1m: float
) -> LeftOver:
    """What frames `rows` leave of the moving points; each frame's own best rigid correction is taken out."""
    squares, count = np.zeros(len(points)), np.zeros(len(points))
    times, far = [], []
    for i in rows:
        pose = affine(field.node_m, field.at(float(frames.times_s[i])), points.binding)
        sight = look(frames, i, points, pose, CUT_REACH_M, noise_m_at_1m)
        if len(sight.point) < MIN_POINTS:
            continue
        sigma = sight.sigma_m.astype(np.float64)
        t = sight.residual_m / sigma
        w = 1 / ((1 + (t / CUT_SIGMAS) ** 2) * sigma**2)
        twist = _step(sight, w, sight.residual_m.astype(np.float64))
        moved = cross(twist[None, :3], sight.at_m) + twist[3:]  # the measurements move with the camera
        t = np.abs(sight.residual_m + np.einsum("pi,pi->p", sight.normal, moved)) / sigma
        squares[sight.point] += np.minimum(t, CUT_SIGMAS) ** 2
        count[sight.point] += 1
        times.append(float(frames.times_s[i]))
        far.append(float((t > FAR_SIGMAS).mean()))
    rms = float(np.sqrt(squares.sum() / count.sum())) if count.any() else float("nan")
    return LeftOver(rms, np.sqrt(squares / np.maximum(count, 1)), np.array(times), np.array(far))


def _step(sight: Sight, w: Float, r: Float) -> Float:
    """(6,) left twist of the camera's pose that brings a frame's measurements onto the points."""
    if len(r) < MIN_POINTS:
        return np.zeros(6)
    middle = sight.at_m.mean(0)
    x = (sight.at_m - middle).astype(np.float64)
    n = sight.normal.astype(np.float64)
    J = np.concatenate([cross(x, n), n], axis=1)
    H = J.T @ (w[:, None] * J)
    H[np.diag_indices(6)] += 1e-6 * np.trace(H)
    y = -np.linalg.solve(H, J.T @ (w * r))  # measured points are moved by the pose: n·(y) = -r
    y[3:] -= cross(y[:3], middle)
    return y


def cross(a: NDArray, b: NDArray) -> NDArray:
    """a x b along the last axis, to the bit as NumPy's, which spends most of its time on the names of axes."""
    one, two = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., one] * b[..., two] - a[..., two] * b[..., one])


def jacobian(points: BoundPoints, node_m: Float) -> csr_matrix:
    """(P, 6K) how far each point moves along its normal by the nodes' twists, at rest."""
    node = points.binding.node[points.binding.group]
    weight = points.binding.weight[points.binding.group].astype(np.float64)
    x = points.at_m.astype(np.float64)[:, None, :] - node_m[node]
    n = np.broadcast_to(points.normal.astype(np.float64)[:, None, :], x.shape)
    rows = np.concatenate([cross(x, n), n], axis=2) * weight[:, :, None]
    columns = 6 * node[:, :, None] + np.arange(6)
    P = len(points)
    return csr_matrix((rows.ravel(), columns.ravel(), np.arange(0, 24 * P + 1, 24)), shape=(P, 6 * len(node_m)))


@dataclass(frozen=True, eq=False)
class Normal:
    """Takes weights of points to normal matrices. products : (N, P) to the N distinct places that are not always 0;
    place : (N,) these, flat, in an (m, m) matrix; mirror : (N,) their transposes'. size : m. order : of the products of
    all rows' entries in `products`.
    """

    products: csr_matrix
    place: Int
    mirror: Int
    size: int
    order: Int

    @classmethod
    def of(cls, J: csr_matrix) -> Normal:
        """Of rows J (P, m) with equally many entries each, none twice in a row."""
        P, m = J.shape
        column = J.indices.reshape(P, -1).astype(np.int64)
        upper = np.triu_indices(column.shape[1])
        a, b = column[:, upper[0]], column[:, upper[1]]
        place, row = np.unique((np.minimum(a, b) * m + np.maximum(a, b)).ravel(), return_inverse=True)
        number, point = np.arange(1, row.size + 1), np.repeat(np.arange(P), len(upper[0]))
        matrix = csr_matrix((number, (row.ravel(), point)), shape=(len(place), P))
        return cls(matrix, place, place % m * m + place // m, m, matrix.data - 1).again(J)

    def again(self, J: csr_matrix) -> Normal:
        """Of other rows with entries in the same places."""
        value = J.data.reshape(J.shape[0], -1).astype(np.float32)
        upper = np.triu_indices(value.shape[1])
        products = (value[:, upper[0]] * value[:, upper[1]]).ravel()[self.order]
        places = products, self.products.indices, self.products.indptr
        return replace(self, products=csr_matrix(places, shape=self.products.shape))

    def matrix(self, weight: Float) -> Float:
        """(m, m) Σ w J'J for weights (P,)."""
        values = self.products @ weight.astype(np.float32)
        out = np.zeros(self.size * self.size)
        out[self.mirror] = values
        out[self.place] = values
        return out.reshape(self.size, self.size)
