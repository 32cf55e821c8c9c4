"""The subject's outline in a set of thermal views: read once, measured for every guess of where the camera was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.outline import Contour, OutlineCaster, project_contour
from ..geometry.rigid import invert
from ..motion.body import Standing
from ..physics.signal import SignalConverter
from ..progress import Progress, silent
from ..robust import TUKEY, mad_sigma, tukey_weight
from ..types import Camera, Float, Float32, ThermalStream
from .edges import find_edges, smooth_image

MAX_POINTS = 400  # contour points used in a view
MIN_POINTS_OF_VIEW = 30
MIN_POINTS = 200
MIN_STEP_NETD = 8.0  # an outline whose step is smaller than this many NETD shows nothing
MIN_STEP_SHARE = 0.4  # of the usual step: weaker ones are other things (hair, clothes, a warm background)
CONTRAST_REACH_DEG = 1.6
MIN_REACH_PX = 3.0
SEARCH_PX = 4  # step of the search for a rig that is far off, and how far it reaches
SEARCH_REACH_DEG = 7.0
SEARCH_CLEAR = 4.0  # times the score of a shift taken at random
MIN_SCALE_PX = 0.15


@dataclass(frozen=True, eq=False)
class OutlineView:
    """A thermal view that shows enough outline.

    row : its place among the views asked for. smooth : (H, W) from `smooth_image`, in-band radiance. contour : the
    model's outline from the pose at which it was read. range_m : median distance of the outline.
    """

    row: int
    smooth: Float32
    contour: Contour
    range_m: float

    @classmethod
    def of(cls, row: int, smooth: Float32, contour: Contour, T_world_thermal: Float) -> OutlineView:
        """With `MAX_POINTS` at most of a contour as seen from T_world_thermal (4, 4); smooth : (H, W)."""
        every = -(-len(contour) // MAX_POINTS)
        thinned = Contour(contour.point_m[::every], contour.normal[::every])
        range_m = float(np.median(np.linalg.norm(thinned.point_m - T_world_thermal[:3, 3], axis=1)))
        return cls(row, smooth, thinned, range_m)


@dataclass(frozen=True, eq=False)
class Contrast:
    """sign : body minus background. step : usual height of the outline's step, in-band radiance."""

    sign: float
    step: float


@dataclass(frozen=True, eq=False)
class OutlineResidual:
    """Where a view's image shows the outline.

    residual_px : (n,) distance from prediction to edge, positive outward. motion : (n, 6) its derivative by a motion of
    the world in the camera's frame (rotation vector, translation). point : (n,) which contour points they are.
    """

    residual_px: Float
    motion: Float
    point: NDArray[np.intp]


def read_outlines(
    stream: ThermalStream,
    body: Standing,
    frames: Sequence[int],
    T_world_thermal: Float,
    progress: Progress = silent,
) -> tuple[tuple[OutlineView, ...], Contrast | None]:
    """Images and model outlines of thermal frames at poses (N, 4, 4), and how the outline shows in them.

    body : the subject's surface at each of the frames. The contrast is None where nothing stands
    out. Raises ScanError for an image that cannot be read.
    """
    lens = stream.camera.lens
    converter, caster = SignalConverter(stream.camera), OutlineCaster(body.rest, lens)
    views: list[OutlineView] = []
    for row, frame in enumerate(frames):
        contour = caster.posed(body(row)).contour(T_world_thermal[row])
        if len(contour) >= MIN_POINTS_OF_VIEW:
            radiance = converter.radiance(stream.load(int(frame)), stream.places[frame])
            views.append(OutlineView.of(row, smooth_image(radiance), contour, T_world_thermal[row]))
        progress("rig", row + 1, len(frames))
    level = [float(np.nanmedian(v.smooth)) for v in views]
    if not np.isfinite(level).any():
        return tuple(views), None
    band = converter.band
    noise = stream.camera.netd_K * float(band.d_radiance_dT(band.temperature_K(np.nanmedian(level))))
    return tuple(views), _contrast(lens, views, invert(T_world_thermal), noise)


def _contrast(camera: Camera, views: Sequence[OutlineView], T_thermal_world: Float, noise: float) -> Contrast | None:
    reach = reach_px(camera, CONTRAST_REACH_DEG)
    steps = [
        find_edges(v.smooth, project_contour(camera, T_thermal_world[v.row], v.contour), reach, 0.0).step for v in views
    ]
    found = np.concatenate([s[np.isfinite(s)] for s in steps])
    if len(found) < MIN_POINTS or abs(np.median(found)) < MIN_STEP_NETD * noise:
        return None
    return Contrast(float(np.sign(np.median(found))), float(abs(np.median(found))))


def search_shift(camera: Camera, views: Sequence[OutlineView], T_thermal_world: Float) -> Float | None:
    """(2,) px by which all images are shifted against the model's outlines, or None if no shift stands out.

    For a rig that is off by more than edges are looked for: a wrong direction of the camera shifts every view alike.
    Every shift of a coarse grid is judged by how much the image differs across the shifted outline, in all views.
    """
    total: Float | None = None
    for view in views:
        coarse = view.smooth[::SEARCH_PX, ::SEARCH_PX]
        outline = project_contour(camera, T_thermal_world[view.row], view.contour)
        known = np.isfinite(outline.uv_px).all(axis=1) & np.isfinite(outline.normal_px).all(axis=1)
        uv, out = outline.uv_px[known] / SEARCH_PX, 2.0 * outline.normal_px[known]
        reach = int(np.radians(SEARCH_REACH_DEG) * camera.focal_px / SEARCH_PX)
        step = _shifted(coarse, uv - out, reach) - _shifted(coarse, uv + out, reach)
        seen = np.isfinite(step).sum(axis=1)
        with np.errstate(invalid="ignore"):
            score = np.nansum(step, axis=1) / np.sqrt(np.maximum(seen, 1)) / np.nanstd(coarse)
        total = score if total is None else total + score
    if total is None or not np.isfinite(total).all():
        return None
    side = 2 * reach + 1
    strength = np.abs(total)
    best = int(np.argmax(strength))
    shift = np.array([best % side, best // side]) - reach
    chance = float(np.median(strength))
    if strength[best] < SEARCH_CLEAR * chance or np.abs(shift).max() == reach:
        return None
    return np.asarray(shift * SEARCH_PX, np.float64)


def _shifted(image: Float32, uv: Float, reach: int) -> Float32:
    """(S, N) the image at points (N, 2) under all shifts up to ±reach, rows first; NaN outside."""
    h, w = image.shape
    padded = np.full((h + 2, w + 2), np.nan, np.float32)
    padded[1:-1, 1:-1] = image
    d = np.arange(-reach, reach + 1)
    u = np.clip(np.rint(uv[:, 0]).astype(int) + d[:, None] + 1, 0, w + 1)
    v = np.clip(np.rint(uv[:, 1]).astype(int) + d[:, None] + 1, 0, h + 1)
    return padded[v[:, None, :], u[None, :, :]].reshape(len(d) ** 2, -1)


def measure_outline(
    camera: Camera, view: OutlineView, T_thermal_world: Float, reach_px: float, contrast: Contrast
) -> OutlineResidual:
    """Distances from a view's outline as T_thermal_world (4, 4) predicts it to its image's, where the step there is a
    body's against the room."""
    outline = project_contour(camera, T_thermal_world, view.contour)
    edges = find_edges(view.smooth, outline, reach_px, contrast.sign)
    step = contrast.sign * edges.step / contrast.step
    with np.errstate(invalid="ignore"):
        good = np.isfinite(edges.offset_px) & (step > MIN_STEP_SHARE) & (step < 1 / MIN_STEP_SHARE)
    along = outline.px_per_m[good]
    motion = np.concatenate([np.cross(outline.point_m[good], along), along], axis=1)  # along · (ω x p + v)
    return OutlineResidual(edges.offset_px[good], motion, np.flatnonzero(good))


def reach_px(camera: Camera, reach_deg: float) -> float:
    """An angle in pixels, but no less than edges need."""
    return max(MIN_REACH_PX, float(np.radians(reach_deg)) * camera.focal_px)


def weights_about_median(residual: Float) -> tuple[Float, float]:
    """Tukey's biweights (N,) about the median of residuals (N,) (a common offset is the estimate's business), and the
    robust scale, px."""
    middle = np.median(residual)
    scale = max(mad_sigma(residual - middle), MIN_SCALE_PX)
    return tukey_weight((residual - middle) / (TUKEY * scale)), scale
