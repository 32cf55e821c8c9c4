"""A camera's field from an earlier scan: a start for the next one, as far as that one's own views bear it out."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.problems import problem_of
from support.synthetic_views import HEIGHT, WIDTH, make_world, vignetting_K
from test_crosscal import blackbodies

from thermofusion.errors import RecipeError, ScanError
from thermofusion.files.shipped import data_dir
from thermofusion.recipe import CrosscalSection, EarlierFieldSection, TemperatureSection, load_recipe
from thermofusion.results.artifacts import save_artifact
from thermofusion.results.earlier import with_field
from thermofusion.scans import open_scan
from thermofusion.temperature.blend import blend
from thermofusion.temperature.crosscal import calibrate
from thermofusion.temperature.sensor.earlier import handed_on
from thermofusion.temperature.sensor.field import ImageField
from thermofusion.temperature.solve import Temperature
from thermofusion.types import SurfaceMesh, ThermalMesh

LEFT_PX = 200  # of the image: beyond it the short scan sees no skin


def solved(world, field=None, rows=None, **known):
    """The calibration, and the temperatures of the vertices, from a world's views."""
    settings = TemperatureSection(crosscal=CrosscalSection(field=field))
    rows = world.observations if rows is None else rows
    problem = problem_of(rows, world.n_vertices, world.n_views, settings=settings, **known)
    found = calibrate(problem)
    return found, blend(problem, found)


def passed_on(c):
    return handed_on(c.field, c.sensor, c.covariance[c.layout.field, c.layout.field], c.slope_L)


def field_off_K(c, rows):
    """Rms of the field's error where a body was seen."""
    off = c.field(rows.u_px, rows.v_px) / c.slope_L - vignetting_K(rows.u_px, rows.v_px)
    return float(np.std(off))


@pytest.fixture(scope="module")
def found():
    return solved(make_world(40, n_vertices=3000))[0]


@pytest.fixture(scope="module")
def earlier(found):
    return passed_on(found)


def test_a_short_scan_of_the_same_camera_knows_its_field(earlier):
    """Five views over 60° do not carry it: over four seeds the field's error falls to a third, the map's by a third."""
    alone, with_it, inside = [], [], []
    for seed in (0, 1, 4, 5):
        world = make_world(seed, n_views=5, turn_deg=60.0, n_vertices=1200)
        for field, errors in ((None, alone), (earlier, with_it)):
            c, result = solved(world, field)
            known = result.count >= 2
            error, sigma = (result.absolute_K - world.T_K)[known], result.uncertainty.total_K[known]
            errors.append((field_off_K(c, world.observations), np.std(error), np.median(sigma)))
        assert c.field_change < 0.3
        inside.append(np.mean(np.abs(error - np.median(error)) < 1.96 * sigma))
    better = np.mean(with_it, axis=0) / np.mean(alone, axis=0)
    assert better[0] < 0.4
    assert better[1] < 0.8
    assert better[2] < 0.9
    assert np.mean(inside) > 0.92


def test_a_field_that_changed_is_not_believed(earlier):
    other = earlier.model_copy(update={"K": tuple(-3 * k for k in earlier.K)})
    world = make_world(7, n_vertices=2000)
    bare, found = solved(world)[0], solved(world, other)[0]
    assert found.field_change > 0.5
    assert any("is of no use" in m for m in found.messages)
    seen = world.observations
    off = (found.field(seen.u_px, seen.v_px) - bare.field(seen.u_px, seen.v_px)) / bare.slope_L
    assert np.std(off) < 0.01
    assert np.isnan(bare.field_change)


def test_a_blackbody_where_no_skin_was_seen_is_read_with_the_earlier_field():
    """At the dark border: without it the level is good to a few tenths, with it to one, and it says so."""
    world, field = make_world(2), ImageField.zero(WIDTH, HEIGHT)
    v, u = (a.ravel() for a in np.mgrid[0:HEIGHT:8, 0:WIDTH:8].astype(float))
    K = np.linalg.lstsq(np.column_stack([np.ones(len(u)), field.patterns(u, v)]), vignetting_K(u, v))[0][1:]
    calibrated = EarlierFieldSection(K=tuple(K), sigma_K=(0.01,) * len(K), width_px=WIDTH, height_px=HEIGHT)
    rows = world.observations.select(world.observations.u_px < LEFT_PX)
    known = {"blackbodies": tuple(blackbodies(world, u=310.0, v=120.0))}
    bare, _ = solved(world, rows=rows, **known)
    c, result = solved(world, calibrated, rows, **known)
    error = float(np.nanmedian(result.absolute_K - world.T_K))
    assert bare.level_sigma_K > 0.2
    assert c.level_sigma_K < 0.1
    assert abs(error) < 2 * c.level_sigma_K


def test_what_is_handed_on_is_the_field(found, earlier):
    c = found
    assert np.allclose(np.array(earlier.K) * c.slope_L, c.field.coefficients, atol=2e-5 * c.slope_L)
    assert (earlier.width_px, earlier.height_px) == (WIDTH, HEIGHT)
    assert passed_on(c) == earlier


def test_a_result_folder_hands_its_field_on(found, earlier, tmp_path):
    """With the days between the scans; a result without a field, or of another camera, is refused in a sentence."""
    scan = replace(open_scan(data_dir() / "demo"), recorded_at="2026-03-03T12:00:00+01:00")
    nan = np.full(1, np.nan, np.float32)
    surface = SurfaceMesh(np.zeros((1, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((1, 3), np.float32))
    mesh = ThermalMesh.from_temperature(surface, nan, mode="absolute", anchored=False)
    save_artifact(tmp_path / "result.npz", Temperature(mesh, nan, nan, nan, calibration=found))
    report = {"thermofusion": "0", "scan": {"recorded_at": "2026-03-01T11:00:00+00:00"}, "metadata": []}
    (tmp_path / "result.json").write_text(json.dumps(report))
    recipe = with_field(load_recipe("torso"), scan, tmp_path)
    assert recipe.temperature.crosscal.field == earlier.model_copy(update={"age_days": 2.0})
    assert load_recipe(recipe.model_dump(mode="json")) == recipe
    (tmp_path / "result.json").write_text("[]")
    with pytest.raises(ScanError, match="not what thermofusion wrote"):
        with_field(recipe, scan, tmp_path)
    (tmp_path / "result.json").write_text(json.dumps(report))
    other = replace(found, field=replace(found.field, width_px=640))
    save_artifact(tmp_path / "result.npz", Temperature(mesh, nan, nan, nan, calibration=other))
    with pytest.raises(ScanError, match="of 640 x 240 px, the thermal images of 320 x 240"):
        with_field(recipe, scan, tmp_path)
    save_artifact(tmp_path / "result.npz", Temperature(mesh, nan, nan, nan))
    with pytest.raises(ScanError, match="found no field of the camera"):
        with_field(recipe, scan, tmp_path)


def test_another_cameras_field_is_refused(earlier):
    with pytest.raises(ScanError, match="of 640 x 480 px, the thermal images of 320 x 240"):
        solved(make_world(1, n_vertices=500), earlier.model_copy(update={"width_px": 640, "height_px": 480}))
    with pytest.raises(RecipeError, match=r"field\.K"):
        load_recipe({"temperature": {"crosscal": {"field": {**earlier.model_dump(), "K": [0.1]}}}})
