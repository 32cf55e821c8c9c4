"""One camera by itself: the reference every joint fit is held against."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...errors import ScanError
from ...types import Camera, Float
from ..board.views import BoardView, CalibrationSet
from .bundle import Options, Problem
from .cameras import LensPrior, camera_with, from_rt, to_rt
from .solver import Fit, solve
from .start import zhang

K3_GAIN = 0.02  # a third radial term must lower the rms by this share ...
K3_SIGMAS = 4.0  # ... and stand this far from zero
MIN_TILT_SPREAD_DEG = 8.0  # boards more parallel than this leave focal length and distance interchangeable
MAX_PLAUSIBLE_RMS = 0.02  # of the image width: worse means other points than the board's


@dataclass(frozen=True, eq=False)
class SingleFit:
    """A camera alone. sigma_px : one sigma of a point's coordinate. poses : T_camera_board by view."""

    fit: Fit
    camera: str
    sigma_px: float
    uses_k3: bool

    @property
    def intrinsics(self) -> Float:
        """(9,) px and none."""
        return self.fit.block(self.camera)

    @property
    def sigmas(self) -> Float:
        """(9,) one sigma of the intrinsics, px and none; 0 for what was held."""
        return np.sqrt(np.diag(self.fit.block_covariance(self.camera)))

    @property
    def model(self) -> Camera:
        """The lens found."""
        return camera_with(self.intrinsics, self.fit.problem.sizes[self.camera])

    @property
    def rms_px(self) -> float:
        """Root mean square distance of projected and seen points, px."""
        return self.fit.rms_px(self.camera)

    def poses(self) -> dict[str, Float]:
        """T_camera_board (4, 4), m, by view."""
        return {v.name: from_rt(self.fit.block(f"view:{v.name}")) for v in self.fit.problem.views}


def fit_camera(data: CalibrationSet, camera: str, *, lens: LensPrior | None = None) -> SingleFit:
    """Intrinsics and board poses from one camera's pictures.

    Raises ScanError: too few views, boards all parallel, or a residual that says the board is another one.
    """
    one = replace(data, views=tuple(BoardView(v.name, {camera: v.points[camera]}) for v in data.seen_by(camera)))
    start, poses = zhang(one, camera)
    _check_tilts(camera, np.stack(list(poses.values())))
    problem = Problem(one)
    x0 = np.zeros(len(problem.names))
    x0[problem.slices[camera]] = start
    for name, T in poses.items():
        x0[problem.slices[f"view:{name}"]] = to_rt(T)
    options = Options(lens=lens or LensPrior(), fixed=frozenset({"spacing", f"{camera}.k3"}), sigma={camera: 0.5})
    plain = _with_noise(problem, x0, options, camera)
    width = data.image_size[camera][0]
    if plain.rms_px(camera) > MAX_PLAUSIBLE_RMS * width:
        raise ScanError(
            f"the {camera} camera's points miss a board of {data.board.columns} x {data.board.rows} points by "
            f"{plain.rms_px(camera):.0f} px rms",
            hint="check the board's columns and rows, and that only one board is in view",
        )
    cubic = _with_noise(problem, plain.x, replace(plain.options, fixed=frozenset({"spacing"})), camera)
    k3 = problem.names.index(f"{camera}.k3")
    carried = abs(cubic.x[k3]) > K3_SIGMAS * np.sqrt(cubic.covariance[k3, k3])
    carried = carried and cubic.rms_px(camera) < (1 - K3_GAIN) * plain.rms_px(camera)
    fit = cubic if carried else plain
    return SingleFit(fit, camera, fit.options.sigma[camera], bool(carried))


def _with_noise(problem: Problem, x0: Float, options: Options, camera: str) -> Fit:
    """Solve, take the noise level from the residuals, solve again with it."""
    fit = solve(problem, x0, options)
    return solve(problem, fit.x, replace(options, sigma={camera: noise_px(fit, camera)}))


def noise_px(fit: Fit, camera: str, free_per_view: float = 6.0) -> float:
    """One sigma of a point's coordinate from the residuals: Huber's scale, corrected for what the fit took up."""
    e, view = fit.residuals()[camera]
    sigma = float(np.sqrt(np.mean(np.minimum(np.sum(e**2, axis=1), _cap(e)) / 2)))
    used = (free_per_view * len(np.unique(view)) + 8) / (2 * len(e))
    return max(sigma / np.sqrt(max(1 - used, 0.1)), 1e-3)


def _cap(e: Float) -> float:
    """Squared distance beyond which a point is an outlier: five times the median-based sigma."""
    d2 = np.sum(e**2, axis=1)
    return float(25 * np.median(d2) / 1.386)  # median of a two-dimensional Gaussian's d² is 1.386 σ²


def _check_tilts(camera: str, T: Float) -> None:
    normal = T[:, :3, 2]
    mean = normal.mean(0) / np.linalg.norm(normal.mean(0))
    spread = np.degrees(np.arccos(np.clip(normal @ mean, -1, 1)))
    if spread.max() < MIN_TILT_SPREAD_DEG:
        raise ScanError(
            f"all boards seen by the {camera} camera are parallel within {spread.max():.1f} deg, so that its focal "
            "length cannot be told from the distance",
            hint="tilt the board by 20 to 45 deg to the left, right, up and down",
        )
