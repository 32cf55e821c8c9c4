"""Grid points in thermal pictures: dark or bright, broken, partly missing.

A pin is a small spot of either sign. The picture is turned into a signed signal-to-noise map of spots; a predicted grid
is laid on its absolute value, shifted to where most spots agree, then every point takes its own peak and the grid is
bent onto them by a homography, in rounds with a shrinking window.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...robust import mad_sigma
from ...types import Float
from ..board.views import BoardPoints

SPOT_SIGMA_PX = 1.2  # a pin's image is hardly larger than the lens's blur
MIN_SNR = 3.0  # of a point accepted by itself
WEAK_SNR = 2.1  # of one that has the sign of its neighbours and lies where they say: noise does so in one of 20
FIXED_PATTERN_VIEWS = 8  # pictures from which a sensor's own pattern can be told from the scene
MIN_FOUND_SHARE = 0.4  # of a board's points that make it found
SATURATED_SHARE = 0.02  # of a picture's pixels on one end value: a scene within the range puts next to none there


@dataclass(frozen=True, eq=False)
class Detection:
    """points : accepted. tried : (N, 2) where each board point was expected at the end, accepted : (N,) of them.
    score : share of points accepted; 0 if the board was not found."""

    points: BoardPoints
    tried: Float
    accepted: NDArray[np.bool_]

    @property
    def score(self) -> float:
        return float(self.accepted.mean())


def spot_map(image: NDArray, sigma_px: float = SPOT_SIGMA_PX) -> NDArray[np.float32]:
    """(H, W) signed signal-to-noise of a spot of size sigma at each pixel; 0 in flat parts, local noise 1.

    A difference of Gaussians, over its own spread in the neighbourhood (spots themselves excluded by clipping).
    """
    x = image.astype(np.float32)
    x = x - np.median(x)
    d = cv2.GaussianBlur(x, (0, 0), sigma_px) - cv2.GaussianBlur(x, (0, 0), 2.2 * sigma_px)
    spread = mad_sigma(d) + 1e-6
    power = cv2.GaussianBlur(np.minimum(d * d, (3 * spread) ** 2), (0, 0), 12)
    return (d / np.sqrt(np.maximum(power, (0.3 * spread) ** 2))).astype(np.float32)


def fixed_pattern(images: list[NDArray]) -> NDArray[np.float32] | None:
    """(H, W) fine pattern of the sensor itself: what all pictures have in common beyond smooth shading, or None if they
    are too few. Pins move from view to view, dead pixels and column noise do not: the median takes these alone."""
    if len(images) < FIXED_PATTERN_VIEWS:
        return None
    fine = [i.astype(np.float32) - cv2.GaussianBlur(i.astype(np.float32), (0, 0), 6) for i in images]
    return np.median(np.stack(fine), axis=0).astype(np.float32)


def is_saturated(image: NDArray) -> bool:
    """True if more than 2 % of the pixels of a picture (H, W) sit on its highest or lowest value."""
    lo, hi = image.min(), image.max()
    share = max(np.mean(image == lo), np.mean(image == hi))
    return bool(image.dtype.kind in "ui" and hi > lo and share > SATURATED_SHARE)


def find_shift(
    spots: NDArray[np.float32], predicted: Float, reach_px: float, *, dilate_px: int = 2
) -> tuple[Float, float]:
    """Shift (2,) px of a `predicted` grid (N, 2), within `reach_px`, at which most points lie on `spots` (H, W); mean
    score.

    The score of a point is its |SNR| capped at 6 within `dilate_px`: many fair points beat a few bright ones.
    """
    strength = np.minimum(np.abs(spots), 6.0)
    strength[np.abs(spots) < 2.0] = 0
    strength = cv2.dilate(strength, np.ones((2 * dilate_px + 1,) * 2, np.uint8))
    r = int(np.ceil(reach_px))
    padded = cv2.copyMakeBorder(strength, r, r, r, r, cv2.BORDER_CONSTANT, value=0)
    h, w = spots.shape
    total = np.zeros((2 * r + 1, 2 * r + 1), np.float32)
    q = np.round(predicted).astype(int)
    inside = ((q >= 0) & (q < [w, h])).all(1)
    for u, v in q[inside]:
        total += padded[v : v + 2 * r + 1, u : u + 2 * r + 1]
    j, i = np.unravel_index(np.argmax(cv2.GaussianBlur(total, (0, 0), 1.0)), total.shape)
    return np.array([i - r, j - r], float), float(total[j, i]) / max(len(q), 1)


def complete(spots: NDArray[np.float32], predicted: Float, *, tolerance_px: float | None = None) -> Detection:
    """Take each point's peak near its prediction, bend the grid, and again with a smaller window.

    spots : (H, W) of `spot_map`. predicted : (N, 2) px of all board points, lens distortion included, wrong by up to
    half a step.
    """
    step = step_px(predicted)
    limit = max(1.2, 0.05 * step) if tolerance_px is None else tolerance_px
    q, inlier = predicted.copy(), np.zeros(len(predicted), bool)
    peak, snr = q, np.zeros(len(q))
    nothing = Detection(BoardPoints(np.zeros(0, int), np.zeros((0, 2))), q, inlier)
    for share in (0.42, 0.34, 0.27, 0.2, 0.2):
        peak, snr = _peaks(spots, q, max(share * step, 2.0))
        strong = snr > MIN_SNR
        if strong.sum() < max(8, 0.2 * len(q)):
            return nothing
        H, _ = cv2.findHomography(predicted[strong], peak[strong], cv2.RANSAC, max(1.5 * limit, 0.1 * step * share))
        if H is None:
            return nothing
        near = strong & (np.linalg.norm(_apply(H, predicted) - peak, axis=1) < 1.5 * limit)
        if near.sum() >= 8:
            H = cv2.findHomography(predicted[near], peak[near], 0)[0]
        q = _apply(H, predicted)
    peak, snr = _peaks(spots, q, limit + 0.5)
    close = np.linalg.norm(q - peak, axis=1) < limit
    inlier = close & (snr > MIN_SNR)
    if inlier.sum() >= 8:
        inlier |= close & (snr > WEAK_SNR) & _like_neighbours(spots, q, peak, inlier)
    if inlier.mean() < MIN_FOUND_SHARE:
        inlier = np.zeros(len(q), bool)
    index = np.flatnonzero(inlier)
    return Detection(BoardPoints(index, peak[index]), q, inlier)


def step_px(predicted: Float) -> float:
    """Median distance of predicted points (N, 2) px to their nearest neighbour."""
    d = np.linalg.norm(predicted[:, None] - predicted[None], axis=2)
    np.fill_diagonal(d, np.inf)
    return float(np.median(d.min(axis=1)))


def _peaks(spots: NDArray[np.float32], q: Float, radius: float) -> tuple[Float, Float]:
    """Strongest |SNR| within `radius` of each of (N, 2), nearer ones favoured: sub-pixel places (N, 2) and SNR (N,)."""
    h, w = spots.shape
    r = int(np.ceil(radius))
    dy, dx = np.mgrid[-r : r + 1, -r : r + 1]
    base = np.round(q).astype(int)
    u, v = base[:, 0, None, None] + dx, base[:, 1, None, None] + dy
    ok = (u >= 1) & (u < w - 1) & (v >= 1) & (v < h - 1)
    distance2 = (u - q[:, 0, None, None]) ** 2 + (v - q[:, 1, None, None]) ** 2
    uc, vc = np.clip(u, 1, w - 2), np.clip(v, 1, h - 2)
    a = np.abs(spots[vc, uc]) * ok * (distance2 <= radius**2)
    flat = (a * np.exp(-distance2 / (2 * (0.7 * radius) ** 2))).reshape(len(q), -1).argmax(axis=1)
    k = np.arange(len(q))
    snr = a.reshape(len(q), -1)[k, flat]
    ui, vi = uc.reshape(len(q), -1)[k, flat], vc.reshape(len(q), -1)[k, flat]
    sign = np.sign(spots[vi, ui])
    fu = _parabola(*(sign * spots[vi, ui + d] for d in (-1, 0, 1)))
    fv = _parabola(*(sign * spots[vi + d, ui] for d in (-1, 0, 1)))
    return np.stack([ui + fu, vi + fv], axis=1), snr


def _like_neighbours(spots: NDArray[np.float32], q: Float, peak: Float, inlier: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points whose spot has the sign that most of the five nearest accepted points have."""
    h, w = spots.shape
    u, v = np.clip(np.round(peak).astype(int).T, 0, [[w - 1], [h - 1]])
    sign = np.sign(spots[v, u])
    d = np.linalg.norm(q[:, None] - q[None, inlier], axis=2)
    d[d < 1e-6] = np.inf
    nearest = np.argsort(d, axis=1)[:, :5]
    return sign * np.sign(sign[inlier][nearest].sum(axis=1) + 0.0) > 0


def _parabola(a: NDArray, b: NDArray, c: NDArray) -> NDArray:
    d = a - 2 * b + c
    return np.where(d < -1e-9, np.clip(0.5 * (a - c) / np.where(d < -1e-9, d, 1), -0.6, 0.6), 0.0)


def _apply(H: NDArray, px: Float) -> Float:
    q = np.column_stack([px, np.ones(len(px))]) @ H.T
    return q[:, :2] / q[:, 2:]
