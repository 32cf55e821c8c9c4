"""Light that a lens spreads: taken off, found by its halo, and not found where there is none."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, gaussian_filter
from support.problems import LENS
from support.synthetic_views import BAND, HEIGHT, WIDTH
from test_surroundings import sphere_part

from thermofusion.diagnosis.radiation import of_lens
from thermofusion.geometry.camera import pixel_rays
from thermofusion.mapping.background import find_background
from thermofusion.mapping.scatter import UNKNOWN_SIGMA, estimate_scatter
from thermofusion.physics.scatter import without_scatter
from thermofusion.physics.signal import SignalConverter
from thermofusion.types import LensScatter, SignalCurve, ThermalCamera, ThermalStream, ThermalViews

RADIUS_M, VIEWS = 0.2, 16
CAMERA = ThermalCamera(LENS, np.eye(4), SignalCurve("radiance"), netd_K=0.05)
SLOPE = float(BAND.d_radiance_dT(295.0))


def poses():
    """A walk round the origin that looks a little past it, up and down."""
    out = np.tile(np.eye(4), (VIEWS, 1, 1))
    for k in range(VIEWS):
        a = 2 * np.pi * k / VIEWS
        eye = np.array([np.cos(a), np.sin(a), 0.2 * np.sin(2.7 * k)])
        aim = 0.15 * np.array([np.sin(5.1 * k), np.cos(3.3 * k), np.sin(1.9 * k)])
        forward = (aim - eye) / np.linalg.norm(aim - eye)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        out[k, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        out[k, :3, 3] = eye
    return out


@cache
def pictures():
    """A warm ball in a room that is warmer on one side, as an ideal lens shows it; radiance."""
    rays, rng = pixel_rays(LENS), np.random.default_rng(2)
    out = []
    for k, T in enumerate(poses()):
        d = rays @ T[:3, :3].T
        along = -(d @ T[:3, 3])
        hit = T[:3, 3] @ T[:3, 3] - along**2 < RADIUS_M**2
        degC = np.where(hit, 33.0, 22.0 + 1.5 * d[..., 0] - 0.5 * d[..., 2]) + 0.3 * np.sin(k)
        out.append(BAND.radiance(273.15 + degC + rng.normal(0, 0.05, degC.shape)))
    return out


def spread_by(parts):
    """The pictures through a lens; parts: (share, sigma px)."""
    share = sum(g for g, _ in parts)
    return [
        ((1 - share) * L + sum(g * gaussian_filter(L, s, mode="nearest") for g, s in parts)).astype(np.float32)
        for L in pictures()
    ]


def found_in(images):
    stream = ThermalStream(
        np.arange(VIEWS) * 1.0, images.__getitem__, ("",) * VIEWS, np.arange(VIEWS), np.ones(VIEWS, bool), CAMERA
    )
    views = ThermalViews(np.arange(VIEWS, dtype=np.int32), np.arange(VIEWS) * 1.0, poses())
    ball = sphere_part(RADIUS_M, 1e-3, np.pi - 1e-3, inward=False)
    background = find_background(stream, ball, views, SignalConverter(CAMERA))
    return background, estimate_scatter(background, LENS, BAND)


@pytest.mark.parametrize(
    "parts", [((0.02, 30.0),), ((0.012, 14.0),), ((0.008, 12.0), (0.012, 40.0))], ids=["broad", "narrow", "tailed"]
)
def test_a_halo_tells_the_share_and_taking_it_off_leaves_the_ideal_picture(parts):
    images = spread_by(parts)
    background, scatter = found_in(images)
    share = sum(g for g, _ in parts)
    assert scatter.share == pytest.approx(share, rel=0.2)
    assert abs(scatter.share - share) < 2 * scatter.sigma
    (said,) = of_lens(scatter)
    assert said.size == pytest.approx(100 * share, rel=0.2)
    off = [[], []]
    for y, L in zip(images, pictures(), strict=True):
        skin = binary_erosion(gaussian_filter(L, 1.0) > BAND.radiance(301.0), iterations=4)
        for kept, image in zip(off, (y, without_scatter(y, scatter)), strict=True):
            kept.append((gaussian_filter(image - L, 1.0)[skin] ** 2).mean() / SLOPE**2)
    before, after = (np.sqrt(np.mean(squares)) for squares in off)
    assert before > 0.02
    assert after < 0.3 * before
    ideal, _ = found_in([L.astype(np.float32) for L in pictures()])
    keys = [(b.view * 1000 + b.v_px.astype(int)) * 1000 + b.u_px.astype(int) for b in (ideal, background)]
    _, i, j = np.intersect1d(*keys, return_indices=True)
    assert len(i) > 0.9 * len(background)
    rms = [
        np.sqrt(np.mean((b.radiance[j] - ideal.radiance[i]) ** 2)) for b in (background, background.without(scatter))
    ]
    assert rms[1] < 0.25 * rms[0]


def test_an_ideal_lens_gets_no_scatter():
    _, scatter = found_in([L.astype(np.float32) for L in pictures()])
    assert scatter.share == 0
    assert scatter.sigma < UNKNOWN_SIGMA
    assert of_lens(scatter) == []


def test_a_masked_background_says_nothing():
    masked = [np.where(BAND.radiance(303.0) < L, L, 50.0).astype(np.float32) for L in pictures()]
    background, scatter = found_in(masked)
    assert len(background) == 0
    assert (scatter.share, scatter.sigma) == (0.0, UNKNOWN_SIGMA)


def test_an_even_picture_stays_and_holes_stay_holes():
    image = np.full((HEIGHT, WIDTH), 55.0, np.float32)
    image[10, 20] = np.nan
    out = without_scatter(image, LensScatter(((0.02, 0.1),), 0.001))
    assert np.isnan(out[10, 20])
    np.testing.assert_allclose(out[np.isfinite(image)], 55.0, rtol=1e-6)
