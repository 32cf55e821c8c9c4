"""A room at a finite distance is found by its parallax; one far away stays endless."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_scatter import CAMERA, found_in, pictures, poses

from thermofusion.geometry.camera import pixel_rays
from thermofusion.mapping.span import from_middle, placed
from thermofusion.physics.band import Band
from thermofusion.types import ThermalViews

BAND = Band(*CAMERA.band_um)
VIEWS = ThermalViews(np.arange(16, dtype=np.int32), np.arange(16.0), poses())


def wall(span_m):
    """A warm ball in a round room of this radius whose wall carries a coarse pattern, by rays; radiance."""
    out, rng = [], np.random.default_rng(5)
    for k, T in enumerate(poses()):
        d = pixel_rays(CAMERA.lens) @ T[:3, :3].T
        along = d @ T[:3, 3]
        hit = T[:3, 3] @ T[:3, 3] - along**2 < 0.2**2
        at = T[:3, 3] + (np.sqrt(along**2 - T[:3, 3] @ T[:3, 3] + span_m**2) - along)[..., None] * d
        x, y, z = np.moveaxis(at / span_m, -1, 0)
        degC = np.where(hit, 33.0, 22 + 2 * x - y + 1.5 * np.sin(6 * x + 2) * np.cos(5 * y) + z) + 0.3 * np.sin(k)
        out.append(BAND.radiance(273.15 + degC + rng.normal(0, 0.05, degC.shape)).astype(np.float32))
    return out


def test_rays_meet_the_room_where_trigonometry_says():
    middle = np.array([0.5, 0.0, 1.0])
    eye, d = middle + np.array([[1.2, 0, 0]]), np.array([[-np.cos(0.4), np.sin(0.4), 0.0]])
    # law of sines in the triangle of middle, eye and wall: the ray's own angle, and 1.2/3 of its sine at the wall
    angle = 0.4 + np.arcsin(1.2 / 3 * np.sin(0.4))
    expected = [-np.cos(angle), np.sin(angle), 0.0]
    np.testing.assert_allclose(from_middle(eye, d, middle, 3.0)[0], expected, atol=1e-12)
    np.testing.assert_array_equal(from_middle(eye, d, middle, np.inf), d)
    outside = middle + np.array([[9.0, 0, 0]])
    np.testing.assert_array_equal(from_middle(outside, np.array([[0.0, 1, 0]]), middle, 3.0), [[0.0, 1, 0]])


@pytest.mark.parametrize(("span_m", "low", "high"), [(2.5, 1.8, 3.5), (1e6, np.inf, np.inf)])
def test_parallax_tells_how_far_the_room_is(span_m, low, high):
    background, _ = found_in(wall(span_m))
    found = placed(background, VIEWS, np.zeros(3), CAMERA.lens, BAND)
    assert low <= found.span_m <= high
    if np.isinf(span_m) or span_m > 100:
        assert found is background


def test_an_even_room_is_left_as_it_is():
    flat = [np.where(BAND.radiance(301.0) < L, L, BAND.radiance(295.0)).astype(np.float32) for L in pictures()]
    rng = np.random.default_rng(1)
    background, _ = found_in([(L + rng.normal(0, 0.04, L.shape)).astype(np.float32) for L in flat])
    assert placed(background, VIEWS, np.zeros(3), CAMERA.lens, BAND) is background
    few = replace(background, **{n: getattr(background, n)[:50] for n in ("view", "direction", "radiance", "halo")})
    assert placed(few, VIEWS, np.zeros(3), CAMERA.lens, BAND) is few
