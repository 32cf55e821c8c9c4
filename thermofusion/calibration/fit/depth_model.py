"""From what a depth camera reports to true depth: smooth metric corrections, and Herrera's form for raw disparity.

Herrera, Kannala, Heikkilä, "Joint depth and color camera calibration with distortion correction", PAMI 2012: Eqs. 5-6,
1/z = c1 d_u + c0 and d_u = d + D(u, v)·exp(a0 - a1 d). The paper's D has one value per pixel; here it is a smooth field
of a few control values, which a few dozen boards can carry, and a0 = 750 a1: D is the bending at about 1 m, where it is
seen, and not at disparity 0, where nobody looks and a little more decay would be as good as a little less bending.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import lambertw

from ...scans.native.depth_correction import FIELD_SHAPE, MetricDepth, field_basis
from ...types import Float

MIDDLE_DISPARITY = 750.0  # counts; some 1.05 m for a Kinect v1
LINEAR, FIELD = slice(0, 3), slice(3, None)  # parts of the parameters: c0 [1/m], c1 [1/(m count)], decay; D [counts]


@dataclass(frozen=True)
class DisparityDepth:
    """Raw Kinect disparity: 1/z = c1 d_u + c0 with d_u = d + D(u, v) exp(-decay (d - 750)).

    Defaults of c0 [1/m] and c1 [1/(m count)] are those of a Kinect v1. sigma_field : prior of D in counts (one is some
    3 mm at 1 m).
    """

    size: tuple[int, int]
    c0: float = 3.0938
    c1: float = -0.002848
    decay: float = 0.002
    sigma_field: float = 2.0
    names: tuple[str, ...] = field(
        default=("c0", "c1", "decay", *(f"field_{i}" for i in range(FIELD_SHAPE[0] * FIELD_SHAPE[1])))
    )

    def start(self) -> Float:
        """(P,) c0 [1/m], c1 [1/(m count)], decay [1/count] and field [counts] of a Kinect v1 that does not bend."""
        return np.array([self.c0, self.c1, self.decay] + [0.0] * (len(self.names) - 3))

    def prior_sigma(self) -> Float:
        """(P,) one sigma of the parameters about `start`: how far one Kinect is from another."""
        return np.array([0.15, 1.5e-4, 0.001] + [self.sigma_field] * (len(self.names) - 3))

    def residual(
        self, theta: Float, value: Float, u_px: Float, v_px: Float, z_plane: Float
    ) -> tuple[Float, Float, Float]:
        """(N,) undistorted disparity minus the plane's [counts], its derivatives by theta (N, P) and z_plane (N,).

        theta : (P,). value : (N,) raw disparity at u_px, v_px (N,). z_plane : (N,) m.
        """
        c0, c1, decay = theta[LINEAR]
        B = field_basis(u_px, v_px, self.size)
        damp = np.exp(-decay * (value - MIDDLE_DISPARITY))
        bend = B @ theta[FIELD]
        plane = (1 / z_plane - c0) / c1
        J = np.concatenate(
            [
                np.full((len(value), 1), 1 / c1),
                (plane / c1)[:, None],
                ((MIDDLE_DISPARITY - value) * bend * damp)[:, None],
                B * damp[:, None],
            ],
            axis=1,
        )
        return value + bend * damp - plane, J, 1 / (c1 * z_plane**2)

    def to_depth_m(self, theta: Float, value: NDArray, u_px: NDArray, v_px: NDArray) -> Float:
        """Depth (N,) along z, m, of raw disparity `value` (N,) at u_px, v_px (N,), by parameters theta (P,)."""
        (c0, c1, decay), d = theta[LINEAR], np.asarray(value, np.float64)
        bend = field_basis(u_px, v_px, self.size) @ theta[FIELD]
        d_u = d + bend * np.exp(-decay * (d - MIDDLE_DISPARITY))
        return 1 / (c1 * d_u + c0)

    def to_disparity(self, theta: Float, z_m: NDArray, u_px: NDArray, v_px: NDArray) -> Float:
        """Inverse of `to_depth_m`: the disparity (N,) the camera would report, by Lambert's W (Herrera Eq. 8).

        theta : (P,). z_m, u_px, v_px : (N,).
        """
        c0, c1, decay = theta[LINEAR]
        d_u = (1 / np.asarray(z_m, np.float64) - c0) / c1
        bend = field_basis(u_px, v_px, self.size) @ theta[FIELD]
        bend = bend * np.exp(decay * MIDDLE_DISPARITY)
        # d + B e^(-a d) = d_u. With y = a (d_u - d): y e^(-y)... solved as d = d_u + W(-a B e^(-a d_u)) / a
        return d_u + np.real(lambertw(-decay * bend * np.exp(-decay * d_u))) / decay


DepthModel = MetricDepth | DisparityDepth
