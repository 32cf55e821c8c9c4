"""What is told of a motion: how much each part and each vertex moved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ..types import Bool, Float, Float32, SurfaceMesh, Trajectory
from .body import BodyMotion, PartMotion
from .estimate import Solution
from .field import MotionField, affine
from .graph import Binding
from .parts import name_parts

UNSETTLED_SIGMAS = 2.0  # rms of a point in frames left out: 0.6 where motion is followed
FAR_SHARE = 0.10  # of what a frame sees: if so much is farther off than noise, the motion was not followed
BENT_M = 3e-3  # by which a node's motion misses a line between knots: what is in between is not known that well
LEAST_BAD = 3  # such frames of those left out, in a row


def amplitudes(mesh: SurfaceMesh, field: MotionField, binding: Binding) -> Float32:
    """(V,) m, rms over the knots of how far each vertex is from where it is at rest."""
    squares = np.zeros((len(binding.node), 4, 4))  # of p -> D (p, 1), summed: one quadratic form of p
    for D in _of_groups(field, binding):
        squares += np.einsum("gij,gik->gjk", D, D)
    p = _homogeneous(mesh)
    far2 = np.einsum("vj,vjk,vk->v", p, squares[binding.group], p)
    return np.sqrt(np.maximum(far2, 0) / len(field.knot_s)).astype(np.float32)


def _of_groups(field: MotionField, binding: Binding) -> Iterator[Float]:
    """Knot by knot (G, 3, 4): D (p, 1) is how far a vertex p of each group of the binding is displaced, m."""
    alike = replace(binding, group=np.arange(len(binding.node), dtype=np.int32))
    for twist in field.twist:
        D = affine(field.node_m, twist, alike).astype(np.float64)
        D[:, [0, 1, 2], [0, 1, 2]] -= 1
        yield D


def _homogeneous(mesh: SurfaceMesh) -> Float:
    return np.concatenate([mesh.vertices_m, np.ones((len(mesh), 1))], axis=1, dtype=np.float64)


def part_motions(mesh: SurfaceMesh, field: MotionField, binding: Binding, up: Float) -> tuple[PartMotion, ...]:
    """How far the middle of every part moved against the trunk, parts named by place. up : (3,) unit."""
    names, part = name_parts(mesh, up)
    inside = np.flatnonzero(part >= 0)
    count = np.bincount(part[inside], minlength=len(names))
    groups = len(binding.node)
    pair, of = np.unique(part[inside] * groups + binding.group[inside], return_inverse=True)
    p = _homogeneous(mesh)[inside]
    # of a part's vertices that are carried alike
    total = np.stack([np.bincount(of, p[:, k]) for k in range(4)], axis=1)
    share = csr_matrix((np.ones(len(pair)), (pair // groups, np.arange(len(pair)))), shape=(len(names), len(pair)))
    moved = [np.einsum("aij,aj->ai", D[pair % groups], total) for D in _of_groups(field, binding)]
    mean = np.array([share @ m for m in moved]) / np.maximum(count, 1)[:, None]
    mean -= mean.mean(0)
    far = 1e3 * np.linalg.norm(mean, axis=2)
    rms = np.sqrt((far**2).mean(0))
    seen = count > 0
    return tuple(
        PartMotion(n, round(float(r), 2), round(float(p), 2))
        for n, r, p, s in zip(names, rms, far.max(0), seen, strict=True)
        if s
    )


def described(mesh: SurfaceMesh, solution: Solution, binding: Binding, trajectory: Trajectory, up: Float) -> BodyMotion:
    """Everything that is stored and told of a motion. mesh, binding : at rest. up : (3,) unit."""
    field, left = solution.field, solution.after
    nearest = cKDTree(solution.point_m).query(mesh.vertices_m)[1]
    bent, area = bends(field) > BENT_M, np.zeros(len(field.node_m))
    group = np.bincount(binding.group, minlength=len(binding.node))  # vertices of each
    np.add.at(area, binding.node, binding.weight * group[:, None])
    quick = (bent @ area) > FAR_SHARE * area.sum()
    lost = bent.mean(0) > FAR_SHARE  # nodes that are too quick too often
    return BodyMotion(
        field=field,
        binding=binding,
        trajectory=trajectory,
        moved_mm=(1e3 * amplitudes(mesh, field, binding)).astype(np.float32),
        unsettled=(left.of_point[nearest] > UNSETTLED_SIGMAS) | lost[binding.node[:, 0]][binding.group],
        parts=part_motions(mesh, field, binding, up),
        left_out_before=solution.before,
        left_out_after=left.rms,
        too_much=joined(ranges(left.times_s, left.far_share > FAR_SHARE) + ranges(field.knot_s[1:-1], quick)),
    )


def bends(field: MotionField) -> Float:
    """(F - 2, K) m, about how far each node is, half-way between knots, from the line that stands for its motion.

    Of a motion with acceleration a, linear over steps h, a h²/8 is missed: an eighth of the second difference.
    """
    x = field.twist[:, :, 3:]
    return np.asarray(np.linalg.norm(x[:-2] - 2 * x[1:-1] + x[2:], axis=2) / 8)


def joined(stretches: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """(start, stop) s in order, those that overlap made one."""
    out: list[tuple[float, float]] = []
    for start, stop in sorted(stretches):
        if out and start <= out[-1][1]:
            out[-1] = out[-1][0], max(out[-1][1], stop)
        else:
            out.append((start, stop))
    return tuple(out)


def ranges(times_s: Float, bad: Bool) -> tuple[tuple[float, float], ...]:
    """(start, stop) s of stretches in which most of the moments times_s (N,) are bad (N,): `LEAST_BAD` at least, gaps
    of one bridged."""
    out: list[tuple[float, float]] = []
    bridged = bad.copy()
    bridged[1:-1] |= bad[:-2] & bad[2:]
    edge = np.flatnonzero(np.diff(np.concatenate([[0], bridged.astype(np.int8), [0]])))
    for start, stop in edge.reshape(-1, 2):
        if stop - start >= LEAST_BAD:
            out.append((float(times_s[start]), float(times_s[stop - 1])))
    return tuple(out)
