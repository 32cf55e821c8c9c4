"""A small result with everything in it: an egg of skin, warmer toward +z, with an unmeasured cap and a budget."""

from __future__ import annotations

import numpy as np

from thermofusion.types import SurfaceMesh, ThermalMesh, VertexFlag


def sphere(rings: int = 24, around: int = 40, radii_m: tuple[float, float, float] = (0.1, 0.1, 0.1)) -> SurfaceMesh:
    """A closed ellipsoid, triangles counter-clockwise from outside, exact normals, grey-brown skin."""
    polar = np.linspace(0, np.pi, rings + 1)[1:-1]
    turn = np.linspace(0, 2 * np.pi, around, endpoint=False)
    t, p = np.meshgrid(polar, turn, indexing="ij")
    unit = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1).reshape(-1, 3)
    unit = np.vstack([unit, [0, 0, 1], [0, 0, -1]])
    top, bottom = len(unit) - 2, len(unit) - 1
    i = np.arange(around)
    j = (i + 1) % around
    triangles = [np.stack([np.full(around, top), i, j], 1)]
    for r in range(rings - 2):
        a, b, c, d = r * around + i, r * around + j, (r + 1) * around + i, (r + 1) * around + j
        triangles += [np.stack([a, c, d], 1), np.stack([a, d, b], 1)]
    last = (rings - 2) * around
    triangles.append(np.stack([np.full(around, bottom), last + j, last + i], 1))
    normals = unit / np.array(radii_m)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    color = np.clip(150 + 60 * unit, 0, 255).astype(np.uint8)
    vertices = (unit * radii_m).astype(np.float32)
    return SurfaceMesh(vertices, np.concatenate(triangles).astype(np.int32), normals.astype(np.float32), color)


def result(surface: SurfaceMesh | None = None, *, unmeasured_below_m: float = -0.07) -> ThermalMesh:
    """Absolute temperatures 30 °C + 30 K/m · z; NaN below a height; z is up and the front is toward -y."""
    surface = sphere() if surface is None else surface
    x, y, z = surface.vertices_m.T
    temperature = np.where(z < unmeasured_below_m, np.nan, 30 + 30 * z).astype(np.float32)
    measured = ~np.isnan(temperature)
    per = lambda values: np.where(measured, values, np.nan).astype(np.float32)  # noqa: E731
    return ThermalMesh(
        surface=surface,
        temperature_degC=temperature,
        mode="absolute",
        anchored=False,
        apparent_degC=per(temperature - 0.6),
        uncertainty_K=per(0.1 + np.abs(x)),
        view_angle_deg=per(200 * np.abs(y)),
        distance_m=per(1.2 + x),
        observations=np.where(measured, 3 + (x > 0), 0).astype(np.int32),
        flags=np.where(x > 0.05, VertexFlag.OBLIQUE | VertexFlag.CAVITY, 0).astype(np.uint8),
        residual=per(1 + x),
        uncertainty_parts={"noise": per(0.05 + 0 * x), "emissivity": per(0.1 + 0 * x)},
        metadata={"up": "0 0 1", "front": "0 -1 0", "recipe": 'täst "x"\n2', "voxel_mm": 3.25, "long": "ab " * 700},
    )
