"""What the recording states of each thermal frame: read, written; a room, air or sensor that changes on the way."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import support.scan_maker as make
from support.problems import problem_of
from support.synthetic_views import BAND, HEIGHT, WIDTH, make_world
from test_phantom import reduced

from thermofusion.errors import ScanError
from thermofusion.phantom.simulate import simulate
from thermofusion.physics.air import AirModel, water_g_m3
from thermofusion.physics.equation import apparent_radiance
from thermofusion.pipeline import fuse
from thermofusion.recipe import TemperatureSection, load_recipe
from thermofusion.results.stages import fingerprint
from thermofusion.scans import open_scan, with_thermal
from thermofusion.scans.check import missing_metadata
from thermofusion.scans.native.write import excerpt, scan_json, write_scan
from thermofusion.scans.thermal import read_thermal
from thermofusion.temperature.blend import blend
from thermofusion.temperature.crosscal import calibrate
from thermofusion.temperature.room.changing import Changing
from thermofusion.temperature.solve import solve
from thermofusion.types import Environment, FrameConditions, ThermalViews

ROOMS = ((20.0, 20.0, 40.0), (28.0, 28.0, 70.0))  # reflected, air °C, humidity %: of the walk's halves
NAMES = ("reflected_degC", "air_degC", "relative_humidity_pct")
TAU = 0.99  # of a metre of the mean air


def with_conditions(scan, **columns):
    told = FrameConditions.of(len(scan.thermal), {k: np.array(v) for k, v in columns.items()})
    return replace(scan, thermal=replace(scan.thermal, conditions=told))


def test_columns_are_read_written_cut_and_told_from_none(tmp_path):
    scan = make.tiny_scan(frames=5)
    told = with_conditions(scan, air_degC=[21.0, np.nan, 22.5, 23.1], fpa_degC=[30.0, 30.1, 30.30000001, 31.0])
    back = open_scan(write_scan(told, tmp_path / "told"))
    assert tuple(back.thermal.conditions.stated) == ("air_degC", "fpa_degC")
    for name, column in told.thermal.conditions.stated.items():
        np.testing.assert_array_equal(getattr(back.thermal.conditions, name), column)
    first = (tmp_path / "told/frames.csv").read_text().splitlines()
    assert first[0] == "stream,index,time_s,path,shutter,air_degC,fpa_degC"
    assert {line.count(",") for line in first} == {6}
    part = excerpt(back, thermal=[0, 3])
    np.testing.assert_array_equal(part.thermal.conditions.fpa_degC, [30.0, 31.0])
    bare = open_scan(write_scan(scan, tmp_path / "bare"))
    assert bare.thermal.conditions is None
    assert (tmp_path / "bare/frames.csv").read_text().startswith("stream,index,time_s,path,shutter\n")
    changed = with_conditions(back, air_degC=[21.0, np.nan, 22.5, 23.2])
    assert (
        len({fingerprint(s) for s in (back, changed, replace(back, thermal=replace(back.thermal, conditions=None)))})
        == 3
    )
    nowhere = replace(back, environment=Environment())
    assert not any("air_degC" in m for m in missing_metadata(nowhere))
    assert any("reflected_degC" in m for m in missing_metadata(nowhere))


@pytest.mark.parametrize(
    ("cell", "says"),
    [("warm", "air_degC must be a number or empty"), ("295", "expected -60 to 80"), ("inf", "expected")],
)
def test_a_wrong_cell_is_named_with_its_line(tmp_path, cell, says):
    root = write_scan(with_conditions(make.tiny_scan(), air_degC=[21.0, 22.0, 23.0]), tmp_path / "scan")
    table = root / "frames.csv"
    table.write_text(table.read_text().replace(",22.0", f",{cell}"))
    number = next(i for i, line in enumerate(table.read_text().splitlines(), 1) if line.endswith(cell))
    with pytest.raises(ScanError, match=says) as error:
        open_scan(root)
    assert str(error.value.place).endswith(f"frames.csv, line {number}")


def test_what_flir_files_were_told_with_each_frame_comes_along(tmp_path):
    scan = make.tiny_scan()
    raw = np.full((40, 56), 14000, np.uint16)
    blocks = [bytearray(make.flir_block(raw, time_s=1_300_000_000 + i)) for i in range(3)]
    record = len(blocks[0]) - 0x400
    for block, air_K in zip(blocks, (293.15, 294.15, 296.15), strict=True):
        block[record + 0x2C : record + 0x30] = np.float32(air_K).tobytes()
    (tmp_path / "walk.seq").write_bytes(b"".join(map(bytes, blocks)))
    rig = {k: scan_json(scan)[k] for k in ("cameras", "extrinsics")}
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    frames = read_thermal(tmp_path / "walk.seq")
    np.testing.assert_allclose(frames.conditions.air_degC, [20, 21, 23])
    bare = replace(scan, thermal=None, environment=Environment())
    joined = with_thermal(bare, frames, tmp_path / "rig.json", times_s=scan.thermal.times_s)
    assert tuple(joined.thermal.conditions.stated) == ("air_degC",)  # what stands still is the environment's
    assert any("changes from frame to frame" in n for n in joined.notes)
    said = replace(bare, environment=Environment(air_degC=22.0))
    stated = with_thermal(said, frames, tmp_path / "rig.json", times_s=scan.thermal.times_s)
    assert stated.thermal.conditions is None  # whoever stated it knew better


# ---------------------------------------------------------------- used


def test_air_as_cameras_reckon_with_it():
    """Saturated air holds 19.4 g of water in a cubic metre at 22 °C, 6.8 g at 5 °C (tables); τ from the constants."""
    water = water_g_m3(np.array([22.0, 5.0]), 1.0)
    np.testing.assert_allclose(water, [19.4, 6.8], rtol=0.02)
    a = 1.9 * np.exp(-np.sqrt(50) * (0.006569 - 0.002276 * np.sqrt(water[0] / 2)))
    b = 0.9 * np.exp(-np.sqrt(50) * (0.01262 - 0.00667 * np.sqrt(water[0] / 2)))
    assert AirModel().transmission(50.0, 22.0, 0.5) == pytest.approx(a - b, abs=1e-12)
    assert 1 - AirModel().transmission(1.0, 22.0, 0.5) == pytest.approx(0.006, abs=5e-4)  # the budget's .6 % of a metre


def test_each_view_loses_its_own_air():
    world = make_world(2, n_vertices=500, n_views=8)
    rows = world.observations
    scan = make.tiny_scan(frames=9)
    air = np.linspace(18.0, 32.0, 8)
    scan = with_conditions(scan, air_degC=air, relative_humidity_pct=[30.0] + [np.nan] * 6 + [79.0])
    views = ThermalViews(np.arange(8, dtype=np.int32), np.arange(8.0), np.tile(np.eye(4), (8, 1, 1)))
    humidity = np.linspace(30.0, 79.0, 8)  # straight between the frames that state it
    lost = [-np.log(float(AirModel().transmission(1.0, t, w / 100))) for t, w in zip(air, humidity, strict=True)]
    mean = -np.log(float(AirModel().transmission(1.0, air.mean(), humidity.mean() / 100)))
    tau = TAU ** (np.array(lost) / mean)
    path = tau[rows.view] ** rows.range_m.astype(float)
    L_air = BAND.radiance(air + 273.15)[rows.view]
    through = apparent_radiance(rows.radiance.astype(float), 1.0, 0.0, transmission=path, L_air=L_air)
    seen = replace(rows, radiance=through.astype(np.float32))
    assert np.abs(seen.radiance - rows.radiance).max() > 0.08 * world.slope_L
    changing = Changing.of(scan, views, TemperatureSection(), BAND)
    freed = changing.without_air(seen, TAU, 298.15, BAND)
    np.testing.assert_allclose(freed.radiance, rows.radiance, rtol=1e-6)
    assert changing.without_air(seen, 1.0, 298.15, BAND) is seen
    overruled = Changing.of(scan, views, TemperatureSection(air_degC=25.0, reflected_degC=23.0), BAND)
    assert overruled.air_degC is None
    assert overruled.room is None


@pytest.fixture(scope="module")
def warming(tmp_path_factory):
    """A ball of 36 °C; the room about it is 8 K warmer, and damper, during the second half of the walk."""
    root = tmp_path_factory.mktemp("warming")
    lost = [-np.log(float(AirModel().transmission(1.0, t, w / 100))) for _, t, w in ROOMS]
    mean = -np.log(float(AirModel().transmission(1.0, 24.0, 0.55)))
    for i, (reflected, air, _) in enumerate(ROOMS):
        config = reduced("sphere")
        room = replace(config.room, reflected_degC=reflected, air_degC=air, transmission_per_m=TAU ** (lost[i] / mean))
        simulate(replace(config, room=room), root / str(i), seed=2)
    with (root / "0/frames.csv").open() as f:
        rows = list(csv.DictReader(f))
    thermal = [row for row in rows if row["stream"] == "thermal"]
    for i, row in enumerate(thermal):
        late = int(i >= len(thermal) // 2)
        row.update(zip(NAMES, map(str, ROOMS[late]), strict=True))
        if late:
            shutil.copy(root / "1" / row["path"], root / "0" / row["path"])
    with (root / "0/frames.csv").open("w", newline="") as f:
        writer = csv.DictWriter(f, [*rows[0], *NAMES], restval="")
        writer.writeheader()
        writer.writerows(rows)
    return open_scan(root / "0")


def test_a_room_that_warms_on_the_way_is_followed_where_it_is_stated(warming):
    recipe = load_recipe("torso", [f"temperature.transmission_per_m={TAU}"])
    result = fuse(warming, recipe)
    bare = replace(warming, thermal=replace(warming.thermal, conditions=None))
    window = recipe.surface.normal_window_mm / 1e3
    sections = {"mapping": recipe.mapping, "temperature": recipe.temperature}
    without = solve(bare, result.surface.mesh, result.mapped, normal_window_m=window, **sections)

    def p95(found):
        good = np.isfinite(found.absolute_degC) & (found.mesh.view_angle_deg < 60)
        off = found.absolute_degC[good] - np.median(found.absolute_degC[good])
        inside = np.abs(off) < 1.96 * found.mesh.uncertainty_K[good]
        return np.percentile(np.abs(off), 95), inside.mean()

    assert p95(result.temperature)[0] < 0.06
    assert p95(result.temperature)[1] > 0.95
    assert p95(without)[0] > 0.15
    told = {row["what"]: (row["value"], row["source"]) for row in result.report["radiometry"]}
    assert told["reflected temperature"] == ("20 to 28 °C, stated of 16 frames", "frames.csv")
    assert told["humidity"] == ("40 to 70 %, stated of 16 frames", "frames.csv")


def test_a_pattern_follows_the_sensors_temperature_only_where_left_out_views_agree():
    world, n = make_world(4, n_views=40, netd_K=0.04), 40
    rows, rng = world.observations, np.random.default_rng(0)
    degC = 30 + np.cumsum(rng.normal(size=n)) * 0.5
    x, y = (rows.u_px - WIDTH / 2) / (WIDTH / 2), (rows.v_px - HEIGHT / 2) / (WIDTH / 2)
    warmed = (degC - degC[0]) / np.abs(degC - degC[0]).max()
    pattern = 0.1 * warmed[rows.view] * np.cos(5 * x) * np.cos(4 * y + 1)
    faulty = replace(rows, radiance=(rows.radiance + world.slope_L * pattern).astype(np.float32))

    def solved(rows, name=None, column=degC):
        changing = None if name is None else Changing(Environment(), sensor_degC={name: column})
        problem = problem_of(rows, world.n_vertices, n, changing=changing)
        calibration = calibrate(problem)
        off = blend(problem, calibration, with_uncertainty=False).absolute_K - world.T_K
        return calibration.criticism["left_out_views_better"], off - np.nanmedian(off)

    better, off = solved(faulty, "fpa_degC")
    assert next(iter(better)) == "drift by fpa_degC"
    assert "drift" not in better
    assert np.nanstd(off) < 0.02  # without the pattern .017, with the time in place of the temperature .035
    another = 30 + np.cumsum(np.random.default_rng(9).normal(size=n))
    assert "drift by lens_degC" not in solved(faulty, "lens_degC", another)[0]
    np.testing.assert_array_equal(
        solved(rows, "fpa_degC")[1], solved(rows)[1]
    )  # nothing is asked for: not a bit differs
