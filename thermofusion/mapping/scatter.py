"""How much light the lens spreads, from the halo round the subject on the background of the scan itself.

    y = room(direction) + b_view + φ(u, v) + Σ g_k K_k∗y',      g_k >= 0

y' is the picture with an even room round the subject: a window's own halo stands still with it and belongs to the room,
and a window explained by its own blur would tell of no lens. Room and field are of order 2, a cell of 10° may differ: a
warm wall stays where it is, a halo goes with the subject.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_matrix

from ..geometry.sphere import cell_of, harmonics
from ..physics.band import Band
from ..physics.scatter import WIDTHS, HaloNormal, halo, on_widths, reduced
from ..physics.signal import SignalConverter
from ..robust import MAD_PER_SIGMA, TUKEY, evenly, tukey_weight
from ..types import Camera, Float, Float32, LensScatter, Observations, ThermalStream, ThermalViews
from .background import Background

ROWS = 30_000  # blocks of background that are asked, evenly
FEWER_ROWS = 10_000  # where only their agreement is asked
LEAST_ROWS, LEAST_VIEWS = 3000, 8
FOLDS = 6  # blocks of views that are left out in turn
ROUNDS = 3  # of reweighting
NOISE_K = 0.05  # of a block, to begin with
WIDE_K = 5.0  # one sigma of what room, offsets and field may be
CELL_K = 0.1  # of a cell about the room's harmonics: texture, no halo
LEAST_SHARE, LEAST_SIGMAS = 0.003, 5.0  # of the light, below which no scatter is taken off
MODEL_SIGMA, MODEL_SHARE = 0.0015, 0.08  # one sigma of the share: what point spread and field leave, and of its size
SPREAD_VIEWS = 20  # that the effect on vertices is averaged over
UNKNOWN_SIGMA, UNKNOWN_WIDTH = 0.005, 0.1  # one sigma of the share where no background shows it; image widths


def unknown_scatter() -> LensScatter:
    """None is known of, and some may be there."""
    return LensScatter(((0.0, UNKNOWN_WIDTH),), UNKNOWN_SIGMA)


def estimate_scatter(background: Background, lens: Camera, band: Band) -> LensScatter:
    """The lens's scatter with its sigma; share 0 where the background shows none."""
    asked = _asked(background, lens, band)
    if asked is None:
        return unknown_scatter()
    shares, sigma, jackknife = _solved(*asked, np.eye(len(WIDTHS)))
    share = float(shares.sum())
    if share < max(LEAST_SHARE, LEAST_SIGMAS * jackknife):
        return LensScatter(((0.0, UNKNOWN_WIDTH),), sigma)
    return LensScatter(tuple((float(g), w) for g, w in zip(shares, WIDTHS, strict=True) if g > 0), sigma)


def check_scatter(background: Background, lens: Camera, band: Band, stated: LensScatter) -> LensScatter:
    """The scatter that was measured of the lens by itself; where the halo in the scan is beyond doubt another one of
    that shape, what it differs by, in sigma too."""
    asked = _asked(background, lens, band)
    if asked is None:
        return stated
    shares, sigma, _ = _solved(*asked, on_widths(stated.unit)[:, None])
    differs = float(shares.sum()) - stated.share
    if abs(differs) < LEAST_SIGMAS * np.hypot(sigma, stated.sigma):
        return stated
    return replace(stated, sigma=float(np.hypot(stated.sigma, differs)), differs=differs)


def _asked(background: Background, lens: Camera, band: Band) -> tuple[list[HaloNormal], Float] | None:
    """Normal equations by block of views and the prior; None where too little background is seen."""
    if len(background) < LEAST_ROWS or len(np.unique(background.view)) < LEAST_VIEWS:
        return None
    slope_L = float(band.d_radiance_dT(band.temperature_K(float(np.median(background.radiance)))))
    rows = np.arange(0, len(background), max(1, -(-len(background) // ROWS)))
    return _normals(background, rows, (lens.width_px, lens.height_px), slope_L)[:2]


def disagreement(background: Background, lens: Camera, band: Band) -> float:
    """How little readings of one direction agree among views, in logarithms; NaN where hardly any is seen."""
    if len(background) < LEAST_ROWS or len(np.unique(background.view)) < LEAST_VIEWS:
        return float("nan")
    slope_L = float(band.d_radiance_dT(band.temperature_K(float(np.median(background.radiance)))))
    rows = np.arange(0, len(background), max(1, -(-len(background) // FEWER_ROWS)))
    return _normals(background, rows, (lens.width_px, lens.height_px), slope_L)[2]


def _solved(parts: list[HaloNormal], prior: Float, shapes: Float) -> tuple[Float, float, float]:
    """Shares of shapes (K, S) on `WIDTHS`, (S,); one sigma of their sum, and of it what views left out tell."""
    whole = HaloNormal(np.sum([p.N for p in parts], axis=0), np.sum([p.rhs for p in parts], axis=0))
    shares = whole.shares(prior, shapes)
    left_out = np.array([whole.less(p).shares(prior, shapes).sum() for p in parts])
    jackknife = float(np.sqrt((FOLDS - 1) / FOLDS * ((left_out - left_out.mean()) ** 2).sum()))
    return shares, float(np.sqrt(jackknife**2 + MODEL_SIGMA**2 + (MODEL_SHARE * shares.sum()) ** 2)), jackknife


def _normals(
    background: Background, rows: NDArray, image_px: tuple[int, int], slope_L: float
) -> tuple[list[HaloNormal], Float, float]:
    """Normal equations by block of views, the prior's inverse variances (P,), and how much is left: mean of
    log(1 + (r/NOISE_K)²)."""
    direction, view = background.direction[rows].astype(np.float64), background.view[rows]
    _, view = np.unique(view, return_inverse=True)
    cells, cell = np.unique(cell_of(direction), return_inverse=True)
    x, y_px = (2 * background.u_px[rows] / image_px[0] - 1), (2 * background.v_px[rows] / image_px[1] - 1)
    y = background.radiance[rows].astype(np.float64)
    middle = np.median(y)
    design = np.column_stack(
        [background.halo[rows] - middle, harmonics(direction), x, y_px, x * x, x * y_px, y_px * y_px]
    )
    R, n, M, C = len(rows), design.shape[1], int(view.max()) + 1, len(cells)
    index = np.column_stack([np.tile(np.arange(n), (R, 1)), n + view, n + M + cell])
    value = np.column_stack([design, np.ones((R, 2))])
    A = csr_matrix((value.ravel(), index.ravel(), np.arange(0, R * (n + 2) + 1, n + 2)), shape=(R, n + M + C))
    y = y - middle
    K = len(WIDTHS)
    wide, texture = (WIDE_K * slope_L) ** -2, (CELL_K * slope_L) ** -2
    prior = np.concatenate([np.zeros(K), np.full(n - K + M, wide), np.full(C, texture)])
    weak = np.concatenate([np.ones(K), np.zeros(len(prior) - K)])
    robust, sigma = np.ones(R), NOISE_K * slope_L
    for _ in range(ROUNDS):
        w = robust / sigma**2
        N = (A.T @ A.multiply(w[:, None]).tocsr()).toarray() + np.diag(prior + weak)
        r = np.abs(y - A @ cho_solve(cho_factor(N), A.T @ (w * y)))
        sigma = max(float(np.median(r)) / MAD_PER_SIGMA, 1e-3 * NOISE_K * slope_L)
        robust = tukey_weight(r / (TUKEY * sigma))
    block, parts = view * FOLDS // M, []
    w = robust / sigma**2
    for fold in range(FOLDS):
        mine = np.flatnonzero(block == fold)
        a = A[mine]
        parts.append(HaloNormal((a.T @ a.multiply(w[mine, None]).tocsr()).toarray(), a.T @ (w[mine] * y[mine])))
    return parts, prior, float(np.mean(np.log1p((r / (NOISE_K * slope_L)) ** 2)))


def spread_on(
    stream: ThermalStream, views: ThermalViews, converter: SignalConverter, observations: Observations, n_vertices: int
) -> Float32:
    """(V,) Σ g_k (K_k∗y - y) of the converter's scatter, all of the light spread: what errors of its share do to each
    vertex in the mean of some views, W m-2 sr-1."""
    scatter = (converter.scatter or unknown_scatter()).unit
    chosen = evenly(len(views), SPREAD_VIEWS)
    edges = np.searchsorted(observations.view, np.arange(len(views) + 1))
    total, count = np.zeros(n_vertices), np.zeros(n_vertices)
    for view in chosen.tolist():
        frame, mine = int(views.frame[view]), slice(edges[view], edges[view + 1])
        coarse = reduced(converter.radiance(stream.load(frame), stream.places[frame]))
        added = halo(coarse, scatter) - coarse
        scale = stream.camera.lens.width_px / coarse.shape[1]
        row = np.clip(observations.v_px[mine] / scale, 0, coarse.shape[0] - 1).astype(int)
        column = np.clip(observations.u_px[mine] / scale, 0, coarse.shape[1] - 1).astype(int)
        total += np.bincount(observations.vertex[mine], added[row, column], n_vertices)
        count += np.bincount(observations.vertex[mine], minlength=n_vertices)
    seen = count > 0
    out = np.full(n_vertices, np.median(total[seen] / count[seen]) if seen.any() else 0.0, np.float32)
    out[seen] = total[seen] / count[seen]
    return out
