"""From what a depth camera reports to true depth: smooth metric corrections, and Herrera's form for raw disparity.

Herrera, Kannala, Heikkilä, "Joint depth and color camera calibration with distortion correction", PAMI 2012: Eqs. 5-6,
1/z = c1 d_u + c0 and d_u = d + D(u, v)·exp(a0 - a1 d). The paper's D has one value per pixel; here it is a smooth field
of a few control values, which a few dozen boards can carry, and a0 = 750 a1: D is the bending at about 1 m, where it is
seen, and not at disparity 0, where nobody looks and a little more decay would be as good as a little less bending.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...types import Float

FIELD_SHAPE = (4, 5)  # control values down and across: a structured-light camera bends over about 1/4 image
FIELD = slice(2, None)  # part of MetricDepth's parameters, after scale and offset_m


def field_basis(u_px: Float, v_px: Float, size: tuple[int, int], shape: tuple[int, int] = FIELD_SHAPE) -> Float:
    """(N, rows·columns) weights of a smooth field's control values: tensor product of piecewise linear hats.

    u_px, v_px : (N,). size = (width, height) of the image. Rows sum to 1.
    """

    def hats(x: Float, n: int, length: int) -> Float:
        s = np.clip(x / (length - 1), 0, 1) * (n - 1)
        return np.maximum(0.0, 1.0 - np.abs(s[:, None] - np.arange(n)))

    rows, columns = shape
    across, down = hats(np.asarray(u_px, float), columns, size[0]), hats(np.asarray(v_px, float), rows, size[1])
    return (down[:, :, None] * across[:, None, :]).reshape(len(across), rows * columns)


@dataclass(frozen=True)
class MetricDepth:
    """z_true = z(1 + scale) + offset + z² Σ w_k f_k: scale and offset, and a field that grows as triangulation does.

    size : (width, height), px. sigma_* : priors of scale [1], offset [m] and field [m per m²] (a Kinect bends by some
    5 mm at 1 m). `scale` is held at 0 where the board's spacing is free: one of the two must carry the metre.
    """

    size: tuple[int, int]
    sigma_scale: float = 0.01
    sigma_offset_m: float = 0.005
    sigma_field: float = 0.004
    names: tuple[str, ...] = field(
        default=("scale", "offset_m", *(f"field_{i}" for i in range(FIELD_SHAPE[0] * FIELD_SHAPE[1])))
    )

    def start(self) -> Float:
        """(P,) scale [1], offset [m] and field [m per m²] of a camera that is right: zeros."""
        return np.zeros(len(self.names))

    def prior_sigma(self) -> Float:
        """(P,) one sigma of the parameters about `start`: scale [1], offset [m], field [m per m²]."""
        return np.array([self.sigma_scale, self.sigma_offset_m] + [self.sigma_field] * (len(self.names) - 2))

    def _basis(self, z: Float, u_px: Float, v_px: Float) -> Float:
        B = field_basis(u_px, v_px, self.size)
        return np.concatenate([z[:, None], np.ones((len(z), 1)), z[:, None] ** 2 * B], axis=1)

    def residual(
        self, theta: Float, value: Float, u_px: Float, v_px: Float, z_plane: Float
    ) -> tuple[Float, Float, Float]:
        """(N,) corrected depth minus plane [m], its derivative by theta (N, P) and by z_plane (N,).

        theta : (P,). value : (N,) m, reported at u_px, v_px (N,). z_plane : (N,) m.
        """
        B = self._basis(value, u_px, v_px)
        return value + B @ theta - z_plane, B, -np.ones(len(value))

    def to_depth_m(self, theta: Float, value: NDArray, u_px: NDArray, v_px: NDArray) -> Float:
        """True depth (N,) along z, m, of reported `value` (N,), m, at u_px, v_px (N,), by parameters theta (P,)."""
        z = np.asarray(value, np.float64)
        return z + self._basis(z, u_px, v_px) @ theta

    def of_images(self, theta: Float) -> Callable[[NDArray], NDArray[np.float32]]:
        """`to_depth_m` by parameters theta (P,) for whole images (H, W), m, NaN none."""
        w, h = self.size
        v, u = np.mgrid[0:h, 0:w].reshape(2, -1)
        bend = (field_basis(u, v, self.size) @ theta[FIELD]).astype(np.float32).reshape(h, w)
        gain, offset = np.float32(1 + theta[0]), np.float32(theta[1])
        return lambda z: np.asarray(z * (gain + z * bend) + offset, np.float32)
