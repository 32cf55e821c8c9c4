"""What is told of a motion: how much each part and each vertex moved."""

from __future__ import annotations

import numpy as np

from ..types import Float, Float32, SurfaceMesh, Trajectory
from .body import BodyMotion, PartMotion
from .field import MotionField, displacement
from .graph import Binding
from .parts import name_parts

ROWS_AT_ONCE = 4  # knots whose displacements are held


def amplitudes(mesh: SurfaceMesh, field: MotionField, binding: Binding) -> Float32:
    """(V,) m, rms over the knots of how far each vertex is from where it is at rest."""
    squares = np.zeros(len(mesh))
    for twist in field.twist:
        d = displacement(mesh.vertices_m, binding, field.node_m, twist)
        squares += np.einsum("vi,vi->v", d, d)
    return np.sqrt(squares / len(field.knot_s)).astype(np.float32)


def part_motions(mesh: SurfaceMesh, field: MotionField, binding: Binding, up: Float) -> tuple[PartMotion, ...]:
    """How far the middle of every part moved against the trunk, parts named by place. up : (3,) unit."""
    names, part = name_parts(mesh, up)
    mean = np.zeros((len(field.knot_s), len(names), 3))
    count = np.maximum(np.bincount(part[part >= 0], minlength=len(names)), 1)
    inside = np.flatnonzero(part >= 0)
    for f, twist in enumerate(field.twist):
        d = displacement(mesh.vertices_m[inside], binding.take(inside), field.node_m, twist)
        mean[f] = np.stack([np.bincount(part[inside], d[:, k], len(names)) for k in range(3)], axis=1) / count[:, None]
    mean -= mean.mean(0)
    far = 1e3 * np.linalg.norm(mean, axis=2)
    rms = np.sqrt((far**2).mean(0))
    seen = np.bincount(part[inside], minlength=len(names)) > 0
    return tuple(
        PartMotion(n, round(float(r), 2), round(float(p), 2))
        for n, r, p, s in zip(names, rms, far.max(0), seen, strict=True)
        if s
    )


def described(
    mesh: SurfaceMesh,
    field: MotionField,
    binding: Binding,
    trajectory: Trajectory,
    up: Float,
    left_out: tuple[float, float],
) -> BodyMotion:
    """Everything that is stored and told of a motion of `mesh`, at rest. left_out : before and after."""
    moved = 1e3 * amplitudes(mesh, field, binding)
    return BodyMotion(
        field=field,
        binding=binding,
        trajectory=trajectory,
        moved_mm=moved.astype(np.float32),
        parts=part_motions(mesh, field, binding, up),
        left_out_before=left_out[0],
        left_out_after=left_out[1],
    )
