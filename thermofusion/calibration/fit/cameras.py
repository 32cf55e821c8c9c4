"""The camera of the fit: projection with derivatives, and what is believed of a lens before any board is seen.

Intrinsics are a vector [fx, fy, cx, cy, k1, k2, p1, p2, k3] (OpenCV's order after the matrix), px and none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...types import Camera, Float

INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
FOCAL, PINHOLE, DISTORTION = slice(0, 2), slice(0, 4), slice(4, 9)  # parts of the intrinsics
TURN, SHIFT = slice(0, 3), slice(3, 6)  # parts of `to_rt`: rotation vector [rad], translation [m]


@dataclass(frozen=True)
class LensPrior:
    """Weak beliefs that keep a lens plausible where the views do not carry it; one sigma each.

    center_fraction : of the principal point about the image centre, in image widths. aspect : of ln(fx/fy).
    radial, tangential, radial3 : of k1 and k2, p1 and p2, k3 about zero.
    """

    center_fraction: float = 0.15
    aspect: float = 0.02
    radial: float = 1.0
    tangential: float = 0.02
    radial3: float = 1.0


def intrinsics_of(camera: Camera) -> Float:
    """(9,) vector of a camera without rational terms, px and none. Raises ValueError otherwise."""
    if len(camera.distortion) != 5:
        raise ValueError("the fit knows five distortion terms, not the rational form")
    K = camera.K
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera.distortion])


def camera_with(intrinsics: Float, size: tuple[int, int]) -> Camera:
    """A `Camera` with intrinsics (9,); size = (width, height), px."""
    return Camera(size[0], size[1], matrix(intrinsics), np.array(intrinsics[DISTORTION]))


def matrix(intrinsics: Float) -> Float:
    """K (3, 3) of intrinsics (9,), px."""
    fx, fy, cx, cy = intrinsics[PINHOLE]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def project_with_jacobian(points: Float, intrinsics: Float) -> tuple[Float, Float, Float]:
    """Pixels (N, 2) of points (N, 3), m, in the camera's frame, d px/d point (N, 2, 3) and d px/d intrinsics (N, 2, 9).

    The paper's Eqs. 4-8 in OpenCV's coefficient order.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = intrinsics
    inv_z = 1.0 / points[:, 2]
    x, y = points[:, 0] * inv_z, points[:, 1] * inv_z
    r2, xy = x * x + y * y, x * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)  # d radial / d r²
    x_d = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * x * x)
    y_d = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * xy
    cross = 2 * xy * slope + 2 * p1 * x + 2 * p2 * y
    dx_dx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    dy_dy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x

    uv = np.stack([fx * x_d + cx, fy * y_d + cy], axis=1)
    J = np.empty((len(points), 2, 3))
    J[:, 0, 0], J[:, 0, 1] = fx * dx_dx * inv_z, fx * cross * inv_z
    J[:, 1, 0], J[:, 1, 1] = fy * cross * inv_z, fy * dy_dy * inv_z
    J[:, :, 2] = -(J[:, :, 0] * x[:, None] + J[:, :, 1] * y[:, None])
    D = np.zeros((len(points), 2, 9))
    D[:, 0, 0], D[:, 1, 1], D[:, 0, 2], D[:, 1, 3] = x_d, y_d, 1, 1
    D[:, 0, DISTORTION] = fx * np.stack([x * r2, x * r2**2, 2 * xy, r2 + 2 * x * x, x * r2**3], axis=1)
    D[:, 1, DISTORTION] = fy * np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * xy, y * r2**3], axis=1)
    return uv, J, D


def rotations(w: Float) -> Float:
    """(N, 3, 3) matrices of rotation vectors (N, 3), rad."""
    return Rotation.from_rotvec(w).as_matrix()


def left_jacobians(w: Float) -> Float:
    """(N, 3, 3) J of rotation vectors (N, 3), rad, with R(w + dw) = exp([J dw]x) R(w) to first order
    (Barfoot, State Estimation for Robotics, 7.77)."""
    theta = np.linalg.norm(w, axis=1)[:, None, None]
    W = skew(w)
    safe = np.maximum(theta, 1e-8)
    a = np.where(theta < 1e-4, 0.5 - theta**2 / 24, (1 - np.cos(theta)) / safe**2)
    b = np.where(theta < 1e-4, 1 / 6 - theta**2 / 120, (theta - np.sin(theta)) / safe**3)
    return np.eye(3) + a * W + b * (W @ W)


def skew(w: Float) -> Float:
    """Vectors (..., 3), any unit, to the matrices of the cross product (..., 3, 3)."""
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return W - np.swapaxes(W, -1, -2)


def to_rt(T: Float) -> Float:
    """(..., 4, 4) to (..., 6): rotation vector [rad], then the translation itself [m] (no twist)."""
    T = np.asarray(T, np.float64)
    w = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*T.shape[:-2], 3)
    return np.concatenate([w, T[..., :3, 3]], axis=-1)


def from_rt(rt: NDArray) -> Float:
    """Inverse of `to_rt`: (..., 6), rad and m, to (..., 4, 4)."""
    rt = np.asarray(rt, np.float64)
    T = np.zeros((*rt.shape[:-1], 4, 4))
    T[..., :3, :3] = Rotation.from_rotvec(rt[..., TURN].reshape(-1, 3)).as_matrix().reshape(*rt.shape[:-1], 3, 3)
    T[..., :3, 3] = rt[..., SHIFT]
    T[..., 3, 3] = 1.0
    return T
