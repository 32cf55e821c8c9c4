"""The phantom's uneven room, its operator and its lens, against closed forms and integrals written apart from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.special import erf

from thermofusion.errors import RecipeError
from thermofusion.phantom.physics import Band
from thermofusion.phantom.scattering import BLOCK_PX, scattered, wide_camera
from thermofusion.phantom.scene import OperatorConfig, RoomConfig, ScatterConfig, ThingConfig, scene_from_mapping
from thermofusion.phantom.simulate import build_phantom
from thermofusion.phantom.surround import BEHIND_M, OPERATOR_WIDTH_M, Surround
from thermofusion.phantom.thermal_cameras import thermal_camera

BAND = Band.of((7.5, 13.5))
EVERYWHERE = lambda points, place: np.ones(len(points), bool)  # noqa: E731


def light(**room: object) -> Surround:
    return Surround(replace(RoomConfig(reflected_degC=23.0), **room), BAND)


def hemisphere(normal: np.ndarray, n: int = 400_000) -> np.ndarray:
    """Cosine-weighted directions (n, 3), drawn."""
    v = np.random.default_rng(3).normal(size=(n, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    v = v + normal
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_one_warm_wall_lights_a_vertical_surface_by_a_quarter_pi():
    """∫ cosφ · cosθ dω/π over the hemisphere before an upright surface in an endless round room is π/4."""
    surround = light(side_K=0.3, side_deg=90.0, ceiling_m=1e7)
    eye = np.array([0.0, 0.0, 5e6])
    for normal, share in (([1.0, 0, 0], np.pi / 4), ([-1.0, 0, 0], -np.pi / 4), ([0, -1.0, 0], 0.0)):
        mean = surround.walls(eye, hemisphere(np.array(normal))).mean()
        assert (mean - BAND.emit(np.array(23.0))) / BAND.slope(23.0) == pytest.approx(0.3 * share, abs=0.003)


def test_the_ceiling_is_warmer_than_the_floor_by_what_is_said():
    surround = light(floor_to_ceiling_K=3.0, span_m=1e5)
    up = surround.walls(np.array([0, 0, 1.3]), hemisphere(np.array([0, 0, 1.0]))).mean()
    level = surround.walls(np.array([0, 0, 1.3]), hemisphere(np.array([1.0, 0, 0]))).mean()
    assert BAND.invert(up) == pytest.approx(24.5, abs=0.01)
    assert BAND.invert(level) == pytest.approx(23.0, abs=0.02)


def test_a_window_fills_what_the_view_factor_of_a_rectangle_says():
    """Element to parallel rectangle before it: Siegel and Howell, configuration B-3, four quarters."""
    d, w, h = 2.5, 1.2, 1.6
    surround = light(things=(ThingConfig((d, 0.0, 1.0), w, h, 8.0),))
    found = surround.things_on(np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]]), EVERYWHERE)[0]
    a, b = w / 2 / d, h / 2 / d
    root_a, root_b = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
    factor = 2 / np.pi * (a / root_a * np.arctan(b / root_a) + b / root_b * np.arctan(a / root_b))
    assert found == pytest.approx(factor * (BAND.emit(np.array(8.0)) - BAND.emit(np.array(23.0))), rel=0.01)
    none = surround.things_on(np.array([[0.0, 0, 1]]), np.array([[-1.0, 0, 0]]), EVERYWHERE)
    assert none == 0


def test_a_window_is_seen_where_it_stands():
    surround = light(things=(ThingConfig((2.0, 0.0, 1.0), 1.0, 1.0, 8.0),))
    eye = np.array([-1.0, 0.0, 1.0])
    at = np.array([[2.0, 0, 1], [2.0, 0.45, 1.45], [2.0, 0.55, 1], [2.0, 0, 1.55], [-4.0, 0, 1]])
    assert BAND.invert(surround.seen(eye, at - eye)) == pytest.approx([8, 8, 23, 23, 23], abs=1e-3)
    hidden = replace(surround, room=replace(surround.room, background_degC=21.0))
    assert BAND.invert(hidden.seen(eye, at - eye)) == pytest.approx(21.0, abs=1e-3)


def test_the_operator_fills_what_an_integral_over_the_body_says():
    surround = light(operator=OperatorConfig(degC=31.0, height_m=1.7))
    eye, point, normal = np.array([0.0, -1.2, 1.4]), np.array([0.05, -0.1, 1.2]), np.array([0.3, -1.0, 0.1])
    normal = normal / np.linalg.norm(normal)

    def share(z: float, x: float) -> float:
        way = np.array([x, -1.2 - BEHIND_M, z]) - point
        r = np.linalg.norm(way)
        return float(max(way @ normal, 0) * max(-way[1], 0) / (np.pi * r**4))

    filled = dblquad(share, -OPERATOR_WIDTH_M / 2, OPERATOR_WIDTH_M / 2, 0, 1.7)[0]
    found = surround.operator_on(point[None], normal[None], eye)[0]
    more = float(BAND.emit(np.array(31.0)) - BAND.emit(np.array(23.0)))
    assert found == pytest.approx(filled * more, rel=0.02)
    assert 0.03 < filled < 0.2


def test_a_lens_spreads_an_edge_as_the_error_function_and_keeps_the_light():
    parts = (ScatterConfig(share=0.02, width=0.1),)
    model = thermal_camera(scene_from_mapping({"thermal": {"preset": "p3"}}).thermal)
    h, w = model.camera.shape
    wide = wide_camera(model.camera)
    u = (np.arange(wide.width_px) - w // BLOCK_PX) * BLOCK_PX + (BLOCK_PX - 1) / 2
    hot = 50.0 + 10.0 * (u[None] > w / 2 - 0.5) * np.ones((wide.height_px, 1))
    image = np.repeat(50.0 + 10.0 * (np.arange(w) > w / 2 - 0.5)[None], h, 0)
    out = scattered(image.astype(np.float32), hot.astype(np.float32), parts, (h, w))
    x = np.arange(w) - (w / 2 - 0.5)
    expected = 50.0 + 10.0 * (0.98 * (x > 0) + 0.02 * 0.5 * (1 + erf(x / (0.1 * w * np.sqrt(2)))))
    assert np.abs(out[h // 2] - expected).max() < 0.004  # W m-2 sr-1: 2 % of what is spread
    even = scattered(np.full((h, w), 50, np.float32), np.full(wide.shape, 50, np.float32), parts, (h, w))
    assert np.abs(even - 50).max() < 1e-4
    for kernel in ("exponential", "tail", "disc"):
        other = (ScatterConfig(share=0.02, width=0.1, kernel=kernel),)
        row = scattered(image.astype(np.float32), hot.astype(np.float32), other, (h, w))[h // 2]
        assert row[w // 2 - 2] - 50 == pytest.approx(0.1, abs=0.012)  # half of what is spread, beside the edge
        assert np.all(np.diff(row[: w // 2 - 2]) > -1e-3)


def test_an_uneven_room_is_one_that_stands_still():
    scene = {"shape": {"kind": "sphere"}, "room": {"side_K": 2.0}, "walk": {"subject_turns": True}}
    with pytest.raises(RecipeError, match="subject_turns"):
        build_phantom(scene_from_mapping(scene))
