"""The pinhole camera: distortion, projection, pixel rays, viewing angles.

x right, y down, z forward; the centre of the first pixel is (0, 0) (paper Eqs. 2-8, with OpenCV's coefficient order).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..types import Camera, Float


def distort(x: NDArray, y: NDArray, distortion: Float) -> tuple[NDArray, NDArray]:
    """Ideal image-plane coordinates (z = 1) to distorted ones; OpenCV's rational + tangential model (Eqs. 6-7).

    x, y : any shape, positions on the plane z = 1. distortion : (5,) or (8,), see `Camera`.
    """
    k1, k2, p1, p2, k3 = distortion[:5]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if len(distortion) == 8:
        k4, k5, k6 = distortion[5:]
        radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xy2 = 2 * x * y
    return x * radial + p1 * xy2 + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + p2 * xy2


def undistort(x_d: NDArray, y_d: NDArray, distortion: Float, *, iterations: int = 30) -> tuple[NDArray, NDArray]:
    """Inverse of `distort` by fixed-point iteration with a Newton-like scale; NaN where it does not converge.

    x_d, y_d : any shape, positions on the plane z = 1. distortion : (5,) or (8,), see `Camera`.
    """
    x, y = np.array(x_d, np.float64), np.array(y_d, np.float64)
    if not np.any(distortion):
        return x, y
    for _ in range(iterations):
        fx, fy = distort(x, y, distortion)
        x, y = x + (x_d - fx), y + (y_d - fy)
    fx, fy = distort(x, y, distortion)
    lost = ~(np.hypot(fx - x_d, fy - y_d) < 1e-6)
    x[lost] = y[lost] = np.nan
    return x, y


def max_image_radius(distortion: Float) -> float:
    """Largest ideal radius r (z = 1, dimensionless) up to which the radial model is increasing; inf without distortion.

    distortion : (5,) or (8,). Beyond r a barrel-distorted model folds back: points far outside the field of view would
    land *inside* the image.
    """
    return _max_radius(np.asarray(distortion, np.float64).tobytes()) if np.any(distortion) else np.inf


@lru_cache(maxsize=64)
def _max_radius(distortion_bytes: bytes) -> float:
    """Of the coefficients' bytes: a camera is asked for each of its images."""
    distortion = np.frombuffer(distortion_bytes, np.float64)
    r = np.linspace(0, 4, 8001)
    radial = distort(r, np.zeros_like(r), np.concatenate([distortion[:2], [0, 0], distortion[4:]]))[0]
    falling = np.flatnonzero(~(np.diff(radial) > 0))
    return float(r[falling[0]]) if len(falling) else np.inf


def project(camera: Camera, points: NDArray) -> tuple[NDArray, NDArray]:
    """Points (N, 3) in the camera's frame to pixels (N, 2) (NaN: behind, or outside the model) and z (N,)."""
    z = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = points[:, 0] / z, points[:, 1] / z
        ok = (z > 1e-6) & (x * x + y * y < max_image_radius(camera.distortion) ** 2)
        x_d, y_d = distort(x, y, camera.distortion.astype(points.dtype))
        K = camera.K.astype(points.dtype)
        uv = np.stack([K[0, 0] * x_d + K[0, 2], K[1, 1] * y_d + K[1, 2]], axis=1)
    uv[~ok] = np.nan
    return uv, z


def pixel_rays(camera: Camera, u_px: NDArray | None = None, v_px: NDArray | None = None) -> Float:
    """Unit direction of each pixel's own ray in the camera's frame, (..., 3).

    u_px, v_px : (...), image positions; without them the whole image, (H, W, 3).
    """
    if u_px is None or v_px is None:
        u_px, v_px = np.meshgrid(
            np.arange(camera.width_px, dtype=np.float64), np.arange(camera.height_px, dtype=np.float64)
        )
    x_d = (u_px - camera.K[0, 2]) / camera.K[0, 0]
    y_d = (v_px - camera.K[1, 2]) / camera.K[1, 1]
    x, y = undistort(x_d, y_d, camera.distortion)
    d = np.stack([x, y, np.ones_like(x)], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def viewing_cosine(points: NDArray, normals: NDArray, eye: NDArray) -> NDArray:
    """Cosine of the viewing angle: between the unit normal and the ray from the surface to the eye, (N,).

    points : (N, 3) m. normals : (N, 3) unit. eye : (3,) m.
    The pixel's own ray, not the camera axis of the paper's Eq. 28; negative for back faces.
    """
    return np.asarray(_cosines(points, normals, eye.astype(points.dtype)))


@compiled
def _cosines(points: NDArray, normals: NDArray, eye: NDArray) -> NDArray:  # pragma: no cover
    """`viewing_cosine` in the points' type."""
    out = np.empty(points.shape[0], points.dtype)
    for k in range(points.shape[0]):
        x, y, z = eye[0] - points[k, 0], eye[1] - points[k, 1], eye[2] - points[k, 2]
        out[k] = (x * normals[k, 0] + y * normals[k, 1] + z * normals[k, 2]) / np.sqrt(x * x + y * y + z * z)
    return out
