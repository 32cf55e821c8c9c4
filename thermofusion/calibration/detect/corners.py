"""Checkerboard crossings to a few hundredths of a pixel: a model of the blurred crossing, fitted to the grey values.

Detectors that look for gradients or saddle points leave 0.05 px and more on tilted squares, alike for neighbouring
corners, which a calibration takes for distortion or a shifted principal point. Two straight edges crossing under a
blur are symmetric about the crossing whatever the tilt, so that the fit of such a model is not biased by it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from ...types import Float

WINDOW = 0.38  # radius of what is fitted, shorter square edges
HIDDEN = 0.12  # ... and of the middle left out: a pin or a drill mark sits there
MIN_RADIUS_PX, MAX_RADIUS_PX = 3.0, 14.0
ITERATIONS = 12  # of Gauss-Newton; the best of them is kept
PLACE, DIRECTIONS, SIGMA = slice(0, 2), slice(2, 4), slice(4, 5)  # of a crossing's five numbers: px, rad, px
MAX_MOVE_PX = 1.5  # a crossing that runs farther from its detection has met something else


def refine_corners(grey: NDArray, grid: Float) -> Float:
    """Detected crossings, `grid` (R, C, 2) px, in the picture `grey` (H, W), each moved to the best fit; where that
    fails, as it was.

    Brightness about a crossing: a plane, plus a plane times E1·E2, with E = erf(d / (sqrt(2) sigma)) of the distance d
    to each edge. Unknown for each crossing: its place, two edge directions, sigma, and the six numbers of the planes.
    """
    across, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    edge = float(np.min([np.linalg.norm(a, axis=2).min() for a in (across, down)]))
    radius = float(np.clip(WINDOW * edge, MIN_RADIUS_PX, MAX_RADIUS_PX))
    r = int(np.ceil(radius))
    start = grid.reshape(-1, 2)
    base = np.round(start).astype(int)
    if (base - r < 0).any() or (base + r >= [grey.shape[1], grey.shape[0]]).any():
        return grid
    dv, du = (a.ravel() for a in np.mgrid[-r : r + 1, -r : r + 1])
    ring = (np.hypot(du, dv) <= radius) & (np.hypot(du, dv) >= min(HIDDEN * edge, 0.5 * radius))
    du, dv = du[ring], dv[ring]
    values = grey[base[:, 1:] + dv, base[:, :1] + du].astype(np.float64)
    directions = [np.arctan2(a.reshape(-1, 2)[:, 1], a.reshape(-1, 2)[:, 0]) for a in (across, down)]
    shape = np.column_stack([start - base, *directions, np.ones(len(start))])
    error = np.full(len(start), np.inf)
    best = shape.copy()
    for _ in range(ITERATIONS):
        step, now = _step(shape, values, du, dv)
        better = now < error
        best[better], error[better] = shape[better], now[better]
        shape = shape + np.clip(step, [-1, -1, -0.2, -0.2, -0.3], [1, 1, 0.2, 0.2, 0.3])
        shape[:, SIGMA] = np.clip(shape[:, SIGMA], 0.3, 0.5 * radius)
    found = base + best[:, PLACE]
    good = (np.linalg.norm(found - start, axis=1) < MAX_MOVE_PX)[:, None]
    return np.where(good, found, start).reshape(grid.shape)


def _step(shape: Float, values: Float, du: NDArray, dv: NDArray) -> tuple[Float, Float]:
    """Gauss-Newton step (N, 5) of place, edge directions and sigma, planes solved along; mean square misfit (N,)."""
    x, y = du - shape[:, :1], dv - shape[:, 1:2]
    sigma = shape[:, SIGMA]
    E, slope, across, along = [], [], [], []
    for angle in np.split(shape[:, DIRECTIONS], 2, axis=1):
        c, s = np.cos(angle), np.sin(angle)
        d = -s * x + c * y
        E.append(erf(d / (np.sqrt(2) * sigma)))
        slope.append(np.sqrt(2 / np.pi) / sigma * np.exp(-0.5 * (d / sigma) ** 2))
        across.append((s, -c))  # change of d with the place
        along.append((-(c * x + s * y), d))
    one = np.ones_like(x)
    planes = [one, x, y]
    linear = np.stack([*planes, *(p * E[0] * E[1] for p in planes)], axis=2)
    A = np.transpose(linear, (0, 2, 1))
    coefficients = np.linalg.solve(A @ linear + 1e-6 * np.eye(6), A @ values[..., None])
    misfit = values - (linear @ coefficients)[..., 0]
    contrast = coefficients[:, 3:4, 0] + coefficients[:, 4:5, 0] * x + coefficients[:, 5:6, 0] * y
    g = [contrast * slope[0] * E[1], contrast * slope[1] * E[0]]
    columns = [
        g[0] * across[0][0] + g[1] * across[1][0],
        g[0] * across[0][1] + g[1] * across[1][1],
        g[0] * along[0][0],
        g[1] * along[1][0],
        -(g[0] * along[0][1] + g[1] * along[1][1]) / sigma,
    ]
    J = np.concatenate([np.stack(columns, axis=2), linear], axis=2)
    Jt = np.transpose(J, (0, 2, 1))
    H = Jt @ J
    diagonal = np.arange(H.shape[1])
    H[:, diagonal, diagonal] = H[:, diagonal, diagonal] * (1 + 1e-6) + 1e-9
    step = np.linalg.solve(H, Jt @ misfit[..., None])[:, :5, 0]
    return step, np.mean(misfit**2, axis=1)
