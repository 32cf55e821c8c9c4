"""Corrections of single views: found where the subject swayed, not kept where it stood still."""

from __future__ import annotations

import numpy as np
import pytest
from support.walkround import blank, ellipsoid, make_scan, walk

from thermofusion.geometry.rigid import invert, se3_exp, transform_points
from thermofusion.mapping.corrections import view_corrections
from thermofusion.mapping.views import thermal_views
from thermofusion.types import Scan, SurfaceMesh


@pytest.fixture(scope="module")
def body() -> SurfaceMesh:
    return ellipsoid()


@pytest.fixture(scope="module")
def still(body) -> Scan:
    return make_scan(body, walk())


def test_swaying_subject(body):
    """4 mm and 0.1° from view to view: the outline's share of it comes back to a fraction of a millimetre."""
    rng = np.random.default_rng(3)
    sway = np.concatenate([rng.normal(0, np.radians(0.1), (24, 3)), rng.normal(0, 0.004, (24, 3))], axis=1)
    scan = make_scan(body, walk(), sway=sway)
    views, _ = thermal_views(scan, walk(), 0.5)
    result = view_corrections(scan.thermal, body, views)
    assert result.kept
    assert result.views_fitted == 24
    assert result.residual_px_after < 0.5 * result.residual_px_before
    # Where the camera sees the body's rim, before and after, against where it really was: across the line of sight.
    points = body.vertices_m[::50].astype(np.float64)

    def across_m(T_world_thermal):
        truth = [
            transform_points(invert(T) @ se3_exp(s), points) for T, s in zip(views.T_world_thermal, sway, strict=True)
        ]
        model = [transform_points(invert(T), points) for T in T_world_thermal]
        return np.sqrt(np.mean((np.array(truth) - np.array(model))[..., :2].mean(1) ** 2))

    assert across_m(views.T_world_thermal) > 0.003
    assert across_m(result.T_world_thermal) < 0.001


def test_still_subject_is_left_alone(body, still):
    views, _ = thermal_views(still, walk(), 0.5)
    result = view_corrections(still.thermal, body, views)
    assert not result.kept
    np.testing.assert_array_equal(result.T_world_thermal, views.T_world_thermal)
    assert np.median(result.correction_mm) < 1.5  # mostly along the line of sight, where an outline says little
    assert "not kept" in result.messages[0]


def test_nothing_to_see(body, still):
    views, _ = thermal_views(still, walk(), 0.5)
    result = view_corrections(blank(still).thermal, body, views)
    assert not result.kept
    assert result.views_fitted == 0
    assert np.isnan(result.residual_px_before)
    assert "does not stand out" in result.messages[0]
