"""All views' poses in one solution: each by its outline, and all by the pattern that they have in common.

Unknown are six numbers and an offset a view; common to all, how far the image's outline lies outside the model's, a
low-order field over the image and the shape of emissivity. The outline says where the cameras stand to the surface, the
pattern where they stand to each other: what the outline leaves loose in one view, others of the same skin hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...geometry.patches import patches
from ...geometry.rigid import invert, se3_exp
from ...types import Float, Float32
from ..estimate import BLOCK_M
from ..outlines import measure_outline, reach_px, weights_about_median
from .outline import OutlineFitter
from .pattern import COMMON_COLUMNS, OFFSET, POSE, VIEW_COLUMNS, PatternRows, PatternSampler, of_poses, pattern_normal

REACH_DEG = (0.8, 0.6) + (0.5,) * 8
BLUR_SHARE = (0.008, 0.004) + (0.002,) * 8  # of the image's width: pattern is compared blurred, then sharp
STEP_ROTATION_DEG = 1.5  # prior of one step, one sigma
STEP_TRANSLATION_M = 0.03
PRIOR_SHARE = 0.01  # of these priors' weight that is left in the covariance: what nothing tells must show
PRIOR_WIDTH_PX = 2.0
PRIOR_COMMON = 0.5  # of field and shape, as a share of the contrast between skin and room
SHARP_FROM = 2  # iterations with blur before
AT_REST = 0.5  # of a sigma: a smaller step ends the iterations; the outline's sampling alone makes one of a third
SYSTEMATIC_PX = 0.1  # errors of the model's outline that all points of a view share: no average removes them


@dataclass(frozen=True, eq=False)
class Joint:
    """Poses of N views, T_world_thermal (N, 4, 4), and their covariance (N, 6, 6): rad, m, a twist of the world in the
    camera's frame.

    width_px : how far the image's outline lies outside the model's. outline_px : robust RMS residual. pattern : (N,)
    that of each view's pattern, radiance, NaN where no other view saw the same. range_m : (N,) distance of the outline.
    rest : the last step in sigmas, RMS.
    """

    T_world_thermal: Float
    covariance: Float
    width_px: float
    outline_px: float
    pattern: Float
    range_m: Float
    rest: float

    @property
    def converged(self) -> bool:
        """The iterations came to rest."""
        return self.rest < AT_REST


def solve_jointly(
    fitter: OutlineFitter,
    sampler: PatternSampler,
    radiance: Sequence[Float32],
    rows: Sequence[int],
    T_world_thermal: Float,
    netd: float,
) -> Joint:
    """From T_world_thermal (N, 4, 4) that are right to a degree, of the views `rows` (N,) among the fitter's images.

    radiance : the images (H, W). netd : noise of a pixel, radiance.
    """
    n, T, width = len(T_world_thermal), T_world_thermal.copy(), 0.0
    columns = n * VIEW_COLUMNS + COMMON_COLUMNS + 1
    result: Joint | None = None
    for number, (reach_deg, blur) in enumerate(zip(REACH_DEG, BLUR_SHARE, strict=True)):
        seen = [_outline_rows(fitter, row, P, reach_deg) for row, P in zip(rows, T, strict=True)]
        read = [_read(sampler, i, P, blur) for i, P in zip([radiance[row] for row in rows], T, strict=True)]
        normal = pattern_normal(read, len(sampler.point_m), netd)
        H, b, outline_px = _outline_normal(seen, width, columns)
        H[:-1, :-1] += normal.matrix / normal.effect
        b[:-1] += normal.right / normal.effect
        b[-1] -= width / PRIOR_WIDTH_PX**2
        ranges = np.array([s.range_m for s in seen])
        step, cov = _solved(H, b, _prior(n, fitter.images.contrast.step), n)
        T = np.stack([P @ invert(se3_exp(step[k * VIEW_COLUMNS :][POSE])) for k, P in enumerate(T)])
        width += float(step[-1])
        rest = float(np.sqrt(np.mean([_rest(step[k * VIEW_COLUMNS :][POSE], c) ** 2 for k, c in enumerate(cov)])))
        result = Joint(T, cov + _systematic(fitter, seen), width, outline_px, normal.of_view, ranges, rest)
        if number >= SHARP_FROM and rest < AT_REST:
            break
    assert result is not None
    return result


def _read(sampler: PatternSampler, image: Float32, T_world_thermal: Float, blur: float) -> PatternRows:
    soft = cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), max(0.6, blur * image.shape[1]))
    return sampler.rows(np.asarray(soft, np.float32), T_world_thermal)


@dataclass(frozen=True, eq=False)
class _OutlineRows:
    """One view's: residual_px (n,), motion (n, 6) its derivative by the pose, block (n,) where on the body."""

    residual_px: Float
    motion: Float
    block: NDArray[np.intp]
    range_m: float


def _outline_rows(fitter: OutlineFitter, row: int, T_world_thermal: Float, reach_deg: float) -> _OutlineRows:
    view = fitter.view(row, T_world_thermal)
    if view is None:
        return _OutlineRows(np.zeros(0), np.zeros((0, 6)), np.zeros(0, np.intp), 1.0)
    reach = reach_px(fitter.lens, reach_deg)
    m = measure_outline(fitter.lens, view, invert(T_world_thermal), reach, fitter.images.contrast)
    block, _ = patches(view.contour.point_m[m.point], BLOCK_M)
    limb = fitter.limb_px(view, T_world_thermal)[m.point]
    return _OutlineRows(m.residual_px - limb, m.motion, block, view.range_m)


def _outline_normal(seen: Sequence[_OutlineRows], width_px: float, columns: int) -> tuple[Float, Float, float]:
    """Matrix, right side and the residual's scale, px; what neighbouring points share makes them fewer."""
    H, b = np.zeros((columns, columns)), np.zeros(columns)
    weight, scale = weights_about_median(np.concatenate([s.residual_px for s in seen]) - width_px)
    parts = np.split(weight, np.cumsum([len(s.residual_px) for s in seen])[:-1])
    grouped = alone = 0.0
    for k, (s, w) in enumerate(zip(seen, parts, strict=True)):
        J, r = np.column_stack([s.motion, np.ones(len(s.motion))]), s.residual_px - width_px
        at = np.append(k * VIEW_COLUMNS + np.arange(OFFSET), columns - 1)
        H[np.ix_(at, at)] += J.T @ (w[:, None] * J) / scale**2
        b[at] += J.T @ (w * r) / scale**2
        left = w * (r - np.median(r) if len(r) else r)
        grouped += float((np.bincount(s.block, left) ** 2).sum())
        alone += float((left**2).sum())
    effect = max(1.0, grouped / max(alone, 1e-300))
    return H / effect, b / effect, scale


def _systematic(fitter: OutlineFitter, seen: Sequence[_OutlineRows]) -> Float:
    """(N, 6, 6): what `SYSTEMATIC_PX` does to a pose: sideways, and along the axis, where the outline's size tells."""
    angle, out = SYSTEMATIC_PX / fitter.lens.focal_px, []
    for s in seen:
        px_per_m = np.sqrt(np.mean(s.motion[:, 5] ** 2)) if len(s.motion) else fitter.lens.focal_px / s.range_m
        out.append(np.diag([angle**2] * 3 + [(angle * s.range_m) ** 2] * 2 + [(SYSTEMATIC_PX / px_per_m) ** 2]))
    return np.stack(out)


def _prior(n: int, contrast: float) -> Float:
    """Diagonal (P,) that keeps steps small and nuisances sane."""
    view = [np.radians(STEP_ROTATION_DEG) ** -2.0] * 3 + [STEP_TRANSLATION_M**-2.0] * 3 + [contrast**-2.0]
    return np.array(view * n + [(PRIOR_COMMON * contrast) ** -2.0] * COMMON_COLUMNS + [PRIOR_WIDTH_PX**-2.0])


def _solved(H: Float, b: Float, prior: Float, n: int) -> tuple[Float, Float]:
    """The step (P,) and every view's covariance (N, 6, 6). prior : (P,) diagonal that keeps the step small."""
    loose = H + np.diag(np.where(of_poses(n, len(b)), PRIOR_SHARE, 1.0) * prior)
    size = np.sqrt(np.diag(loose))
    inverse = np.linalg.inv(loose / np.outer(size, size)) / np.outer(size, size)
    at = [slice(k * VIEW_COLUMNS, k * VIEW_COLUMNS + OFFSET) for k in range(n)]
    return np.asarray(np.linalg.solve(H + np.diag(prior), b)), np.stack([inverse[a, a] for a in at])


def _rest(step: Float, covariance: Float) -> float:
    """The size of a view's step, in sigmas."""
    return float(np.sqrt(step @ np.linalg.solve(covariance, step) / len(step)))
