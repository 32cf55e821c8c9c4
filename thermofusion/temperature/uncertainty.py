"""How far one observation can be trusted, and how the errors of many add up in one vertex.

The parts of one observation's error follow the error budget of docs/radiometry.md; each is a one-sigma in the radiance
that the camera reports, so that 1/Σσ² is the observation's statistical weight (it replaces the plain cosθ/d²).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from ..physics.band import Band
from ..physics.emissivity import AngleTable, EmissivityModel
from ..recipe import TemperatureSection
from ..robust import median
from ..types import Float, Float32, Observations, ThermalCamera, cause_of

DEFAULT_SIGMA_NORMAL_DEG = 2.0  # of normals over a 25 mm window of a Kinect's surface
PIXEL_VARIANCE_PX2, SAMPLING_VARIANCE_PX2 = 1 / 12, 1 / 6  # of a square pixel; of bilinear weights, on average
DEFAULT_PSF_PX = 0.7  # point spread of a microbolometer camera in focus, where it was not measured
EDGE_MARGIN_PX = 0.5  # fused surfaces shrink or swell by about this much of a thermal pixel
BILINEAR_VARIANCE = 4 / 9  # mean over sub-pixel positions of the noise variance left by bilinear sampling
AIR_LOSS_PER_M = 0.006  # 1-τ of a metre of room air at 50 % humidity, 7.5-13.5 µm (62 mK at 10 K contrast)
PATH_M = 0.5  # by which a reference may stand nearer or farther than the subject: so much air is not known
LINKED_EPSILON0_SIGMA = 0.005  # of ε(0) of skin in the literature, also where it follows the fitted shape
ALONG_SURFACE = 2**-0.5  # share of a shift away from the body's middle that runs along its surface
MAX_LEVER = 4.0  # bound on a normal error's lever near grazing, where the linear form no longer holds


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """One-sigma errors of what an observation depends on.

    netd_K : noise of a pixel. sigma_normal_deg : of the surface normal, per axis. sigma_shape : relative, of 1-E(θ),
    where it is not fitted. sigma_registration_px : of the thermal image on the surface. sigma_reflected_K : of the
    room's reflected temperature. gradient_K_per_m : temperature gradient along the surface, scalar or (V,). blurred_K :
    what the thermal image's own blur takes of the temperature, scalar or (V,).
    sigma_emissivity0 : of ε(0). sigma_gain : of the camera's gain. sigma_depth_scale : of the depth camera's scale.
    aligned_px : what the alignment left between the outlines, NaN = not measured; depth_scale : error of the depth's
    scale that it asks for. psf_sigma_px : point spread of the
    thermal image, which mixes room into skin at silhouettes; edge_margin_px : how much nearer a silhouette may be than
    the mesh says.
    """

    netd_K: float
    sigma_normal_deg: float
    sigma_shape: float
    sigma_registration_px: float
    sigma_reflected_K: float
    sigma_emissivity0: float
    sigma_gain: float = 0.0
    sigma_depth_scale: float = 0.0
    aligned_px: float = float("nan")
    depth_scale: float = 0.0
    psf_sigma_px: float = DEFAULT_PSF_PX
    edge_margin_px: float = EDGE_MARGIN_PX
    gradient_K_per_m: float | Float32 = 0.0
    blurred_K: float | Float32 = 0.0

    def informed(self, gradient_K_per_m: Float32, blurred_K: Float32) -> ErrorModel:
        """With what a map tells of its own vertices, (V,)."""
        return replace(self, gradient_K_per_m=gradient_K_per_m, blurred_K=blurred_K)

    def at(self, vertices: NDArray, of: int) -> ErrorModel:
        """Of some vertices (N,) among `of`."""
        own = (np.broadcast_to(np.asarray(x, np.float32), (of,)) for x in (self.gradient_K_per_m, self.blurred_K))
        return self.informed(*(x[vertices] for x in own))

    @property
    def blur_px(self) -> float:
        """One sigma of what blurs the thermal image on the surface: point spread, pixel, bilinear sampling."""
        return float(np.sqrt(self.psf_sigma_px**2 + PIXEL_VARIANCE_PX2 + SAMPLING_VARIANCE_PX2))

    @property
    def registration_over(self) -> float:
        """What the alignment left of the outlines over the stated registration error; 1 where it was not measured."""
        known = np.isfinite(self.aligned_px) and self.sigma_registration_px > 0
        return self.aligned_px / self.sigma_registration_px if known else 1.0

    def aligned(self, outline_px: float, depth_scale: float) -> ErrorModel:
        """With what the alignment left of the outlines, px, and the error of the depth's scale that they ask for."""
        return replace(self, aligned_px=outline_px, depth_scale=depth_scale)

    @classmethod
    def of(cls, camera: ThermalCamera, settings: TemperatureSection) -> ErrorModel:
        """From the camera and the recipe."""
        normal = settings.sigma_normal_deg
        return cls(
            netd_K=camera.netd_K,
            sigma_normal_deg=DEFAULT_SIGMA_NORMAL_DEG if normal is None else normal,
            sigma_shape=settings.sigma_shape,
            sigma_registration_px=settings.sigma_registration_px,
            sigma_reflected_K=settings.sigma_reflected_K,
            sigma_emissivity0=settings.sigma_emissivity0,
            sigma_gain=settings.sigma_gain,
            sigma_depth_scale=settings.sigma_depth_scale,
            psf_sigma_px=DEFAULT_PSF_PX if camera.psf_sigma_px is None else camera.psf_sigma_px,
        )


@dataclass(frozen=True, eq=False)
class AngleTables:
    """E(θ) = ε(θ)/ε(0), float64, and |dE/dθ| [rad-1], float32, as fast tables over cosθ."""

    relative: AngleTable
    slope: AngleTable

    @classmethod
    def of(cls, model: EmissivityModel) -> AngleTables:
        mu = AngleTable.knots()
        theta = np.arccos(np.clip(mu, 1e-4, 1 - 1e-9))
        slope = np.minimum(np.abs(model.derivative(theta)) / model.normal, MAX_LEVER)
        return cls(AngleTable.of(model.relative(mu), np.float64), AngleTable.of(slope))


def observation_variance(
    observations: Observations,
    excess: float | NDArray,
    tables: AngleTables,
    errors: ErrorModel,
    slope_L: float,
) -> Float32:
    """Variance of each observation about the model L_r + E·x + b, (N,) float32, (W m-2 sr-1)².

    excess : x, normal-equivalent radiance above what is reflected, scalar or (N,). slope_L : dL/dT at skin
    temperature, which turns K into radiance. Parts: noise; normals; shape of ε; registration on a gradient; T_refl;
    room mixed in at silhouettes.
    """
    cos = observations.cos_angle
    x = np.asarray(excess, np.float32)
    variance = np.full(len(cos), (errors.netd_K * slope_L) ** 2, np.float32)
    loss = (1 - tables.relative(cos)).astype(np.float32)
    variance += (x * tables.slope(cos) * np.float32(np.radians(errors.sigma_normal_deg))) ** 2
    variance += (loss * (np.abs(x) * np.float32(errors.sigma_shape))) ** 2
    variance += (loss * np.float32(errors.sigma_reflected_K * slope_L)) ** 2
    variance += (x * silhouette_share(observations.edge_px, errors)) ** 2
    gradient = np.asarray(errors.gradient_K_per_m, np.float32)
    if np.any(gradient):
        g = gradient.take(observations.vertex) if gradient.ndim else gradient
        variance += (g * np.float32(slope_L) * registration_m(observations, errors)) ** 2
    return variance


def registration_m(observations: Observations, errors: ErrorModel) -> Float32:
    """Registration error along the surface, m: pixels x range/(f cosθ), with range/f from the footprint."""
    per_px = np.sqrt(observations.footprint_m2 / np.maximum(observations.cos_angle, np.float32(0.05)))
    return np.asarray(np.float32(errors.sigma_registration_px) * per_px, np.float32)


def silhouette_share(edge_px: NDArray, errors: ErrorModel) -> Float32:
    """Share of a pixel's signal that comes from beyond a straight silhouette `edge_px` away: ½ erfc(d/√2σ).

    For 10 K of contrast and 0.7 px: 766/161/21/2/0.1 mK at 1/1.5/2/2.5/3 px.
    """
    out = np.zeros(len(edge_px), np.float32)
    near = np.flatnonzero(edge_px < errors.edge_margin_px + 4.5 * errors.psf_sigma_px)
    d = np.maximum(edge_px[near] - np.float32(errors.edge_margin_px), 0)
    out[near] = 0.5 * erfc(d / np.float32(np.sqrt(2) * errors.psf_sigma_px))
    return out


def skin_slope(band: Band, radiance: NDArray) -> float:
    """dL/dT at the median of observed radiances (N,): the factor between K and W m-2 sr-1 in weights and bounds."""
    typical = float(np.nanmedian(radiance[:: max(1, len(radiance) // 10_000)])) if len(radiance) else float("nan")
    T = float(band.temperature_K(typical))
    return float(band.d_radiance_dT(T if np.isfinite(T) else 306.15))


# ---------------------------------------------------------------- per vertex


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """One sigma of a result: per vertex, and of the level common to all vertices. K; NaN = unmeasured.

    What errs from vertex to vertex and what shifts all vertices together are kept apart: the first decides whether a
    difference within the result is real, the second whether its level is. For one vertex's absolute temperature both
    count: √(total² + level²).

    total_K : (V,) float32, one sigma about the common level; total² = Σ parts². parts_K : (V,) each.
        noise : of the pixels. calibration : offsets and field of the views. shape : of ε(θ), where it is not fitted.
        normals : of the surface. registration : thermal image on a temperature gradient. silhouette : room mixed in at
        the body's outline. air : differences in the air path. emissivity0, reflected : what errors of ε(0) and T_refl
        do beyond their common shift. gain : likewise. scale : of the depth, on a gradient. resolution : what the
        image's own blur takes of spots and veins as small as itself. pattern : what
        residuals still have in common by place in the image. views : how far views disagree beyond what the other
        parts explain; for methods that do not calibrate them, all of it.
        path : of air between subject and camera, more or less than the reference's. operator : who holds the camera.
        scatter : of the lens's scatter that was taken off, or could be there.
        not_skin : emissivity of what is flagged as not skin.
    level_parts_K : reference, emissivity0, reflected: one number each. A relative result has no reference: its level is
        unknown beyond these.
    modes_K : (V, R) float32, what one sigma of each strong error of the calibration does, signed: parts_K's
        `calibration` is its length, and neighbours have it in common.
    """

    total_K: Float32
    parts_K: dict[str, Float32]
    level_parts_K: dict[str, float]
    common_K: dict[str, Float32]  # signed effect per vertex of one sigma of what is common
    modes_K: Float32

    @classmethod
    def of(cls, parts_K: dict[str, NDArray], common_K: dict[str, NDArray], modes_K: NDArray) -> Uncertainty:
        """From parts_K of single vertices, signed effects common_K (V,) of common errors, and modes_K (V, R)."""
        parts = {name: np.asarray(value, np.float32) for name, value in parts_K.items()}
        common = {name: np.asarray(value, np.float32) for name, value in common_K.items()}
        level: dict[str, float] = {}
        for name, effect in common.items():
            cause, known = cause_of(name), effect[np.isfinite(effect)]
            middle = median(known) if len(known) else 0.0
            level[cause] = float(np.hypot(level.get(cause, 0.0), middle))
            if len(known) and np.ptp(known) > 0:
                off = np.abs(effect - np.float32(middle))
                parts[cause] = np.hypot(parts[cause], off) if cause in parts else off
        total = np.sqrt(np.sum([p.astype(np.float64) ** 2 for p in parts.values()], axis=0))
        return cls(total.astype(np.float32), parts, level, common, np.asarray(modes_K, np.float32))

    @property
    def absolute_K(self) -> Float32:
        """(V,) one sigma of a vertex's temperature on an absolute scale: its parts, and all of what is common."""
        causes = {cause_of(name) for name in self.common_K}
        own = {name: value for name, value in self.parts_K.items() if name not in causes}
        squares = [v.astype(np.float64) ** 2 for v in (*own.values(), *self.common_K.values())]
        return np.sqrt(np.sum(squares, axis=0)).astype(np.float32)

    @property
    def level_K(self) -> float:
        """One sigma of the common level."""
        return float(np.sqrt(sum(v**2 for v in self.level_parts_K.values())))


@dataclass(frozen=True, eq=False)
class Levers:
    """How errors of observations reach a vertex: x = Σ h·(L - L_r), with h = wE/ΣwE² in each row.

    All sums run over a vertex's rows, (V,). squared : Σh². total : Σh. loss : Σ h(1-E). slope, slope_squared : Σ h|E'|
    and Σ (hE')². registration_m : Σ h·m. silhouette : Σ h·share of the room. modes : (V, R) effect of each mode of the
    calibration's covariance. room : (V, R) what one sigma of each error of the room adds to the light that meets the
    vertex, W m-2 sr-1.
    """

    squared: Float
    total: Float
    loss: Float
    slope: Float
    slope_squared: Float
    registration_m: Float
    silhouette: Float
    modes: Float
    room: Float


@dataclass(frozen=True, eq=False)
class Budget:
    """What the errors of all vertices have in common.

    epsilon0 : 1 where nothing is corrected. absolute : the output is divided by ε(0), else normal-equivalent. slope_L :
    dL/dT at skin's temperature, W m-2 sr-1 K-1. shape_fitted : ε(θ)'s shape was
    solved for; epsilon0_follows : ε(0) with it. level_sigma_K : of the common level, NaN without a reference.
    sigma_normal_deg : as the residuals show it. registration_over : the alignment's own residual over the stated one.
    pattern_K : of what residuals still have in common by place in the image. gain_pivot_K : where an error of the gain
    changes nothing; None: the gain was solved for. body_m : rms distance of vertices from the body's middle.
    """

    errors: ErrorModel
    epsilon0: float
    absolute: bool
    slope_L: float
    shape_fitted: bool
    epsilon0_follows: bool
    level_sigma_K: float
    air_K: float | None
    transmission_per_m: float
    sigma_normal_deg: float
    registration_over: float
    pattern_K: float
    gain_pivot_K: float | None
    body_m: float

    @property
    def divisor(self) -> float:
        """What the excess x is divided by on its way to the output, dimensionless."""
        return self.epsilon0 if self.absolute else 1.0


def vertex_uncertainty(
    budget: Budget, levers: Levers, x: Float, T_K: Float, path_m: NDArray, radius_m: NDArray, views_K: NDArray | None
) -> tuple[dict[str, NDArray], dict[str, NDArray], NDArray]:
    """Errors of each vertex, K: (parts, signed effects of what is common, modes (V, R)), for `Uncertainty.of`.

    x : (V,) normal-equivalent excess, W m-2 sr-1. T_K : (V,) K. path_m : (V,) distance beyond the typical one, m.
    radius_m : (V,) distance from the body's middle, m. views_K : (V,) spread of views that were not calibrated, K. The
    budget is that of docs/radiometry.md.
    """
    b, errors = budget, budget.errors
    scale = 1 / (b.slope_L * b.divisor)  # radiance of x -> K of the output
    zero = np.zeros(len(x))
    normal = np.radians(b.sigma_normal_deg)
    # An error of a normal tilts the surface to some views and away from others: between coherent and independent.
    tilt = np.sqrt(0.5 * (levers.slope**2 + levers.slope_squared))
    reflected = 1 - levers.total / b.divisor  # dL_s/dL_r
    sigma_epsilon0 = errors.sigma_emissivity0
    if b.epsilon0_follows:
        sigma_epsilon0 = min(sigma_epsilon0, LINKED_EPSILON0_SIGMA)
    # The level comes from a reference (or is relative), so only the path's differences count; a corrected path is taken
    # to be right to a third of itself.
    air_loss = AIR_LOSS_PER_M if b.transmission_per_m == 1 else (1 - b.transmission_per_m) / 3
    modes = scale * levers.modes
    # A scale that is known to be wrong shifts places against each other; which one stays nobody knows.
    shift_m = np.hypot(errors.sigma_depth_scale * radius_m, errors.depth_scale * np.hypot(radius_m, b.body_m))
    parts = {
        "noise": scale * errors.netd_K * b.slope_L * np.sqrt(BILINEAR_VARIANCE * levers.squared),
        "calibration": np.sqrt((modes**2).sum(1)),
        "shape": zero if b.shape_fitted else scale * np.abs(x * levers.loss) * errors.sigma_shape,
        "normals": scale * np.abs(x) * tilt * normal,
        "registration": np.asarray(errors.gradient_K_per_m) * levers.registration_m * b.registration_over,
        "scale": np.asarray(errors.gradient_K_per_m) * shift_m * ALONG_SURFACE,
        "resolution": zero + np.asarray(errors.blurred_K),
        "pattern": zero + b.pattern_K,
        "silhouette": scale * np.abs(x) * levers.silhouette,
        "air": zero if b.air_K is None else np.abs(T_K - b.air_K) * air_loss * np.abs(path_m),
    }
    if views_K is not None:
        parts["views"] = np.nan_to_num(views_K)
    common = {
        "reference": zero + np.nan_to_num(b.level_sigma_K) / b.divisor,
        "emissivity0": scale * x / b.epsilon0 * sigma_epsilon0 if b.absolute else zero,
    }
    if b.air_K is not None:
        common["path"] = air_loss * PATH_M * (T_K - b.air_K)
    for i, lit in enumerate(levers.room.T, 1):
        common[f"reflected {i}" if levers.room.shape[1] > 1 else "reflected"] = reflected * lit / b.slope_L
    if b.gain_pivot_K is not None:
        common["gain"] = errors.sigma_gain * (T_K - b.gain_pivot_K)
    return parts, common, modes


def covariance_modes(covariance: Float, count: int) -> Float:
    """(P, R) vectors whose outer products add up to the `count` strongest modes of a covariance (P, P)."""
    values, vectors = np.linalg.eigh(covariance)
    top = np.argsort(values)[::-1][:count]
    return np.asarray(vectors[:, top] * np.sqrt(np.maximum(values[top], 0)))
