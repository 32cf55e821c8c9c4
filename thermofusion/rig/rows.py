"""Whether rows of a thermal image are taken one after another, told by the outlines.

A row that is read s·y later than the image's middle, y = v/height - 1/2, shows the outline where it stands s·y later:
shifted along its own velocity in the image, by more the farther its row is from the middle. One s for all views is
solved for beside the rig's own unknowns. It is believed where it stands out of errors that the points of a view, and
those of one place of the body, have in common; where it moves outlines visibly; where both halves of the views say it;
and where the same shift across the velocity stands out by far less: errors of poses and model move outlines either way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.outline import project_contour
from ..robust import TUKEY, mad_sigma, tukey_weight
from ..types import Float
from .estimate import REACH_DEG, TWIST, Measured, OutlineSet, State
from .jitter import turned
from .outlines import MIN_SCALE_PX, reach_px

MIN_VIEWS = 8
FIT_STEPS = 30  # of the robust weights: residuals of a moving edge have two humps
MIN_SIGMAS = 5.0  # of its own error
MIN_SHIFT_PX = 0.04  # rms over the outlines: clean scans stay below 0.02
HALF_SIGMAS = 2.0  # by which s of each half of the views must stand out by itself
MIN_OVER_ACROSS = 1.5  # its sigmas, over those of a shift across the velocity: errors of the model go either way


@dataclass(frozen=True)
class ReadOut:
    """Seconds from the image's first row to its last (negative: the last is first), their sigma, and what that moves
    outlines by, px rms."""

    readout_s: float
    sigma_s: float
    shift_px: float


def readout_time(outlines: OutlineSet, state: State) -> ReadOut | None:
    """The time that reading an image's rows takes; None where rows may as well be taken all at once."""
    if len(outlines.views) < MIN_VIEWS:
        return None
    m = outlines.measure(state, reach_px(outlines.lens, REACH_DEG[-1]))
    row = _rows(outlines, state)[m.point] / outlines.lens.height_px - 0.5
    twist = outlines.twists(state)
    along, across = (row * (m.jacobian[:, TWIST] * t[m.view]).sum(1) for t in (twist, turned(twist)))
    s, sigma = _solved(m, along)
    shift_px = abs(s) * float(np.sqrt(np.mean(along**2)))
    if not (abs(s) > MIN_SIGMAS * sigma and shift_px > MIN_SHIFT_PX):
        return None
    beside, beside_sigma = _solved(m, across)
    if abs(s) / sigma < MIN_OVER_ACROSS * abs(beside) / beside_sigma:
        return None
    for half in (m.view % 2 == 0, m.view % 2 == 1):
        own, own_sigma = _solved(m.part(half), along[half])
        if own * np.sign(s) < HALF_SIGMAS * own_sigma:
            return None
    return ReadOut(s, sigma, shift_px)


def _rows(outlines: OutlineSet, state: State) -> Float:
    """Image rows, px, of all contour points of all views, one view after the other."""
    T_thermal_world = outlines.poses(state)
    uv = [
        project_contour(outlines.lens, T, v.contour).uv_px for v, T in zip(outlines.views, T_thermal_world, strict=True)
    ]
    return np.concatenate(uv)[:, 1]


def _solved(m: Measured, lever: Float) -> tuple[float, float]:
    """Factor of a lever (points,) that explains residuals robustly beside the rig's unknowns, and its sigma, clustered
    by view and by place of the body."""
    X = np.column_stack([lever, m.jacobian])
    p, w = _fitted(X, m.residual_px)
    e, unit = m.residual_px - X @ p, np.sqrt(np.mean(X**2, axis=0))
    X = X / unit
    inverse = np.linalg.pinv(X.T @ (w[:, None] * X))
    variance = 0.0
    for group in (m.view, m.block):
        score = np.zeros((group.max() + 1, X.shape[1]))
        np.add.at(score, group, X * (w * e)[:, None])
        variance += float((inverse @ (score.T @ score) @ inverse)[0, 0])
    return float(p[0]), float(np.sqrt(variance) / unit[0])


def _fitted(X: Float, residual_px: Float) -> tuple[Float, Float]:
    """Factors (P,) of columns (n, P) that explain residuals (n,) robustly, and the points' weights (n,)."""
    unit, w = np.sqrt(np.mean(X**2, axis=0)), np.ones(len(X))
    for _ in range(FIT_STEPS):
        root = np.sqrt(w)[:, None]
        p = np.linalg.lstsq(root * (X / unit), root[:, 0] * residual_px, rcond=None)[0] / unit
        e = residual_px - X @ p
        w = tukey_weight(e / (TUKEY * max(mad_sigma(e), MIN_SCALE_PX)))
    return np.asarray(p), w
