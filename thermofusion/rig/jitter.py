"""Times of single thermal frames, where their stamps jitter: each outline says when its picture was taken.

A picture stamped dt too early shows the outline where it will stand dt later: shifted along its own velocity in the
image. One dt a view is solved for, held by a prior as wide as the views' dt scatter. It is believed where dt scatter
beyond their own errors, and where dt that one half of the outline says brings the other half nearer by more than the
same shift across the velocity does: errors of poses and of the model move outlines either way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.patches import patches
from ..robust import TUKEY, mad_sigma, tukey_weight
from ..types import Float
from .estimate import CLOCK, REACH_DEG, TWIST, Measured, OutlineSet, State
from .outlines import MIN_SCALE_PX, reach_px

ROUNDS = 3  # of measuring the outline again where the times say that it stands
FIT_STEPS = 5  # of the robust weights
CORRELATED_POINTS = 8.0  # neighbouring points of an outline share the model's error: so many count as one
MIN_POINTS = 20  # of half a view's outline
MIN_VIEWS = 6
BLOCK_M = 0.15  # halves of the body are blocks of this size by turns
MIN_SCATTER_SIGMAS = 2.5  # of dt's own errors: clean scans stay below 0.7
MIN_SCATTER_PX = 0.1  # of the path of outlines in one sigma of the scatter: clean scans stay below 0.02
MIN_GAIN = 0.15  # share by which the left-out outline must come nearer
MIN_OVER_ACROSS = 2.0  # that gain over the one by shifts across the velocity
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about the camera's axis


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """What single views' times lack, s (N,), to be added to the stamps, and its sigma; 0 where nothing is seen.

    scatter_s : one sigma of the views' dt. before_px, after_px : robust rms distance of left-out outline.
    """

    dt_s: Float
    sigma_s: Float
    scatter_s: float
    before_px: float
    after_px: float


def frame_times(outlines: OutlineSet, state: State, *, sure: bool = False) -> FrameTimes | None:
    """The times of single views that their outlines ask for; None where stamps are as good as the outline can tell.

    sure : stamps are known to jitter; None only where too few views show it.
    """
    n, reach = len(outlines.views), reach_px(outlines.lens, REACH_DEG[0])
    first = outlines.measure(state, reach)
    lever = first.jacobian[:, CLOCK]
    dt, sigma = _solved(first, lever, n)
    known = np.isfinite(sigma)
    if known.sum() < MIN_VIEWS:
        return None
    scatter = mad_sigma(dt[known] - np.median(dt[known]))
    wide = scatter > MIN_SCATTER_SIGMAS * np.median(sigma[known])
    if not sure and not (wide and scatter * np.sqrt(np.median(lever**2)) > MIN_SCATTER_PX):
        return None
    before, after = _left_out(outlines, first, lever)
    if not sure and before - after < max(MIN_GAIN * before, MIN_OVER_ACROSS * _gain_across(outlines, state, first)):
        return None
    total = np.zeros(n)
    for _ in range(ROUNDS):
        total, sigma, scatter = _held(total, dt, sigma)
        m = outlines.later(total).measure(state, reach)
        dt, sigma = _solved(m, m.jacobian[:, CLOCK], n)
    total, sigma, scatter = _held(total, dt, sigma)
    return FrameTimes(total, sigma, scatter, before, after)


def _gain_across(outlines: OutlineSet, state: State, m: Measured) -> float:
    """By how much left-out outline comes nearer by shifts across the velocity, px."""
    across = m.jacobian[:, TWIST] @ turned(outlines.twists(state)).T
    before, after = _left_out(outlines, m, across[np.arange(len(m.view)), m.view])
    return before - after


def _held(total: Float, step: Float, sigma: Float) -> tuple[Float, Float, float]:
    """Times (N,) moved by a step with its sigma, held by a prior as wide as they scatter; and that."""
    known = np.isfinite(sigma)
    raw, sigma = np.where(known, total + step, 0.0), np.where(known, sigma, 0.0)
    scatter = max(mad_sigma(raw[known] - np.median(raw[known])), 1e-6)
    share = np.where(known, scatter**2 / (scatter**2 + sigma**2), 0.0)
    return share * raw, np.where(known, np.sqrt(share) * sigma, scatter), scatter


def _solved(m: Measured, lever: Float, n: int, use: np.ndarray | None = None) -> tuple[Float, Float]:
    """Of each of n views the factor (n,) of a lever (points,) that explains its residuals robustly, and its sigma; NaN
    sigma where too few of the points in use show it."""
    residual = m.residual_px - np.median(m.residual_px)
    use = np.ones(len(residual), bool) if use is None else use
    x, sigma = np.zeros(n), np.full(n, np.nan)
    for k in range(n):
        mine = (m.view == k) & use
        r, a = residual[mine], lever[mine]
        if len(r) < MIN_POINTS or not a.any():
            continue
        for _ in range(FIT_STEPS):
            e = r - a * x[k]
            scale = max(mad_sigma(e), MIN_SCALE_PX)
            w = tukey_weight(e / (TUKEY * scale))
            square = float(w @ a**2)
            if square <= 0:
                break
            x[k] = w @ (a * r) / square
        if square > 0:
            sigma[k] = scale * np.sqrt(CORRELATED_POINTS / square)
    return x, sigma


def _left_out(outlines: OutlineSet, m: Measured, lever: Float) -> tuple[float, float]:
    """Robust rms of each half of the outline, px: as it is, and less the lever times what the other half says."""
    _, black = patches(np.concatenate([v.contour.point_m for v in outlines.views])[m.point], BLOCK_M)
    residual = m.residual_px - np.median(m.residual_px)
    after = residual.copy()
    for half in (black, ~black):
        x, sigma = _solved(m, lever, len(outlines.views), ~half)
        after -= np.where(half & np.isfinite(sigma)[m.view], lever * x[m.view], 0.0)
    return mad_sigma(residual), mad_sigma(after)


def turned(twist: Float) -> Float:
    """Twists (N, 6) whose image velocity is turned by a right angle."""
    return np.concatenate([twist[:, :3] @ QUARTER_TURN.T, twist[:, 3:] @ QUARTER_TURN.T], axis=1)
