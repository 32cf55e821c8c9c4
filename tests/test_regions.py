"""Regions of interest: areas, means, volumes and ways against calculation, and sigmas that cover the truth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.result_maker import result, sphere
from typer.testing import CliRunner

from thermofusion.cli import app
from thermofusion.errors import RecipeError, ScanError
from thermofusion.export import closed, export, palettes, read_mesh
from thermofusion.geometry.mesh import enclosed_volume
from thermofusion.regions import Brush, Lasso, Line, Measured, Measurer, Slab, Spot, read_regions, write_regions
from thermofusion.types import SharedErrors

FINE = {"rings": 160, "around": 260}
# The maker's mesh has z up and the front toward -y: upright x is the mesh's x, upright y its z, upright z its -y.


@pytest.fixture(scope="module")
def measurer():
    return Measurer(result(sphere(**FINE), unmeasured_below_m=-1))


def test_a_disc_on_a_sphere_has_the_cap_s_area_and_mean(measurer):
    """Within a chord r of the pole of a sphere: area πr²; T = 30 + 30 z, z uniform over area between the cap's ends."""
    for r in (0.02, 0.03, 0.07):
        reading = measurer.read(Brush(points_m=[(0, 0.1, 0)], normals=[(0, 1, 0)], radius_m=r))
        assert reading.area_cm2 == pytest.approx(np.pi * r**2 * 1e4, rel=4e-3)
        low = 0.1 - r**2 / 0.2
        assert reading.value_degC == pytest.approx(30 + 30 * (0.1 + low) / 2, abs=2e-3)
        assert reading.sd_K == pytest.approx(30 * (0.1 - low) / np.sqrt(12), rel=0.04, abs=1e-4)


def test_the_border_cuts_triangles(measurer):
    """The area is smooth in the radius: no vertex jumps in or out."""
    radii = np.linspace(0.02, 0.0202, 9)
    areas = [
        measurer.read(Brush(points_m=[(0, 0, 0.1)], normals=[(0, 0, 1)], radius_m=float(r))).area_cm2 for r in radii
    ]
    expected = np.pi * radii**2 * 1e4
    assert np.abs(np.diff(areas) - np.diff(expected)).max() < 0.3 * np.diff(expected).min()


def test_a_lasso_takes_what_the_eye_sees(measurer):
    """A square outline seen from the front: half the skin within it, never the back; unmeasured skin counts as area."""
    square = [(-0.05, -0.05, 0.2), (0.05, -0.05, 0.2), (0.05, 0.05, 0.2), (-0.05, 0.05, 0.2)]
    reading = measurer.read(Lasso(outline_m=square, toward_viewer=(0, 0, 1)))
    x, y = np.meshgrid(*[(np.arange(400) + 0.5) / 4000 - 0.05] * 2)
    z = np.sqrt(0.01 - x**2 - y**2)
    assert reading.area_cm2 == pytest.approx(float((0.1 / z).mean()) * 100, rel=4e-3)
    assert reading.value_degC == pytest.approx(30, abs=2e-3)
    half = Measurer(result(sphere(**FINE), unmeasured_below_m=0.0)).read(
        Lasso(outline_m=square, toward_viewer=(0, 0, 1))
    )
    assert half.area_cm2 == pytest.approx(reading.area_cm2)
    assert half.measured_fraction == pytest.approx(0.5, abs=0.01)
    assert half.value_degC > 30.5


def test_a_brush_stays_on_its_limb():
    """Two spheres 1 cm apart: a brush with a radius across the gap takes none of the other."""
    one, far = sphere(60, 90), sphere(60, 90)
    v = np.concatenate([one.vertices_m, far.vertices_m + np.float32([0.21, 0, 0])])
    both = type(one)(v, np.concatenate([one.triangles, far.triangles + len(one)]), np.tile(one.normals, (2, 1)))
    alone = Measurer(result(one)).read(Brush(points_m=[(0.06, 0, 0.08)], normals=[(0.6, 0, 0.8)], radius_m=0.1))
    beside = Measurer(result(both)).read(Brush(points_m=[(0.06, 0, 0.08)], normals=[(0.6, 0, 0.8)], radius_m=0.1))
    assert beside.area_cm2 == pytest.approx(alone.area_cm2, rel=1e-6)


def test_ways_over_a_sphere_are_great_circles(measurer):
    angle = np.radians(100)
    end = (0.1 * np.sin(angle), 0.1 * np.cos(angle), 0.0)
    reading = measurer.read(Line(points_m=[(0, 0.1, 0), end]))
    assert reading.length_mm == pytest.approx(100 * angle, rel=5e-3)
    middle = np.interp(reading.length_mm / 2, reading.profile["mm"], reading.profile["degC"])
    assert middle == pytest.approx(30 + 3 * np.cos(angle / 2), abs=0.01)


def test_volumes_of_a_slab_and_a_swelling(measurer):
    """Between planes at ±5 cm of a sphere of 10 cm: π(R²h - h³/12); above the membrane of a cap: the cap."""
    slab = measurer.read(Slab(point_m=(0, -0.05, 0), axis=(0, 1, 0), length_m=0.1))
    assert slab.volume_cm3 == pytest.approx(np.pi * (0.01 * 0.1 - 0.1**3 / 12) * 1e6, rel=5e-3)
    assert slab.area_cm2 == pytest.approx(2 * np.pi * 0.1 * 0.1 * 1e4, rel=5e-3)
    height = 0.06**2 / 0.2
    cap = measurer.read(Brush(points_m=[(0, 0.1, 0)], normals=[(0, 1, 0)], radius_m=0.06))
    assert cap.volume_cm3 == pytest.approx(np.pi * height**2 * (0.3 - height) / 3 * 1e6, rel=0.05)


def test_shared_errors_do_not_average_and_cancel_in_differences():
    """Noise falls with the root of the area in pixels; a common effect stays, and vanishes left against right."""
    mesh = result(sphere(**FINE), unmeasured_below_m=-1)
    n = len(mesh)
    parts = {"noise": np.full(n, 0.1), "normals": np.zeros(n), "calibration": np.full(n, 0.02)}
    mesh = type(mesh)(**{**vars(mesh), "uncertainty_parts": parts, "view_angle_deg": np.zeros(n)})
    shared = SharedErrors.of({"calibration 1": np.full(n, 0.02)}, 500.0, 0.025)
    measurer = Measurer(mesh, shared)
    discs = [Brush(name=f"{side} hip", points_m=[(x, 0, 0)], normals=[(x, 0, 0)], radius_m=0.04)
             for side, x in (("left", 0.1), ("right", -0.1))]  # fmt: skip
    found = Measured.of(measurer, discs)
    area = np.pi * 0.04**2
    for reading, side in zip(found.readings, (1, -1), strict=True):
        pixels = area / (2.25 * ((1.2 + side * 0.096) / 500) ** 2)
        assert reading.errors.budget_K["noise"] == pytest.approx(0.1 / np.sqrt(pixels), rel=0.01)
        assert reading.errors.budget_K["calibration"] == pytest.approx(0.02, rel=0.01)
        assert reading.sigma_K == pytest.approx(np.hypot(0.02, reading.errors.budget_K["noise"]), rel=0.01)
    (difference,) = found.differences
    assert (difference.first, difference.second) == ("left hip", "right hip")
    noise = [r.errors.budget_K["noise"] for r in found.readings]
    assert difference.sigma_K == pytest.approx(np.hypot(*noise), rel=0.01)
    spot = measurer.read(Spot(point_m=(0, 0.1, 0)))
    assert spot.sigma_K == pytest.approx(np.hypot(0.1, 0.02), rel=0.01)
    # a result of version 0.1.0 tells nothing of what vertices share: then nothing averages
    assert Measurer(mesh).read(discs[0]).sigma_K == pytest.approx(np.hypot(0.1, 0.02), rel=0.01)


def test_regions_come_back_from_their_file_and_strangers_are_refused(tmp_path):
    drawn = [
        Spot(name="<script>alert(1)</script> \u202eümlaut", point_m=(0, 0.1, 0)),
        Brush(points_m=[(0, 0, 0.1)], normals=[(0, 0, 1)], radius_m=0.01),
        Lasso(outline_m=[(0, 0, 0), (1, 0, 0), (0, 1, 0)], toward_viewer=(0, 0, 1)),
        Line(points_m=[(0, 0.1, 0), (0, 0, 0.1)]),
        Slab(point_m=(0, 0, 0), axis=(0, 1, 0), length_m=0.1),
    ]
    path = write_regions(tmp_path / "r.json", drawn, scan="s")
    assert read_regions(path) == drawn
    tree = json.loads(path.read_text())
    for change, says in (
        ({"schema": "thermofusion-regions/2"}, "schema"),
        ({"frame": "camera"}, "frame"),
        ({"regions": [{"kind": "spot", "point_m": [0, 0]}]}, "point_m"),
        ({"regions": [{"kind": "spot", "point_m": [0, 0, 1e9]}]}, "point_m"),
        ({"regions": [{"kind": "brush", "points_m": [[0, 0, 0]], "normals": [], "radius_m": 1}]}, "normals"),
        ({"regions": [{"kind": "brush", "points_m": [[0, 0, 0]], "normals": [[0, 0, 1]] * 2, "radius_m": 1}]}, "norm"),
        ({"regions": [{"kind": "lasso", "outline_m": [[0, 0, 0]], "toward_viewer": [0, 0, 1]}]}, "outline_m"),
        ({"regions": {"kind": "spot"}}, "regions"),
        ({"regions": [{"kind": "cone"}]}, "regions"),
    ):
        path.write_text(json.dumps(tree | change))
        with pytest.raises(ScanError, match=says):
            read_regions(path)
    for text in ("", "[]", "{", "[" * 100_000):
        path.write_text(text)
        with pytest.raises(ScanError):
            read_regions(path)


def test_off_the_skin_reads_nothing(measurer):
    far = [
        Brush(points_m=[(5, 5, 5)], normals=[(1, 0, 0)], radius_m=0.01),
        Lasso(outline_m=[(5, 5, 5), (6, 5, 5), (6, 6, 5)], toward_viewer=(0, 0, 1)),
        Slab(point_m=(5, 5, 5), axis=(0, 1, 0), length_m=0.1),
        Brush(points_m=[(0, 0.1, 0)], normals=[(0, 0, 0)], radius_m=0.01),
    ]
    for reading in Measured.of(measurer, far).readings:
        assert np.isnan(reading.value_degC)
        assert np.isnan(reading.sigma_K)
        assert reading.n == 0


def test_measure_writes_csv_and_json(tmp_path):
    from thermofusion.results.artifacts import save_artifact
    from thermofusion.temperature.solve import Temperature

    mesh = result()
    T = mesh.temperature_degC
    save_artifact(tmp_path / "result.npz", Temperature(mesh, T, T, T))
    regions = write_regions(tmp_path / "r.json", [Spot(name="=1+1", point_m=(0, 0.1, 0)),
                                                  Spot(name="b", point_m=(0, 0, 0.1))])  # fmt: skip
    done = CliRunner().invoke(app, ["measure", str(tmp_path), "--regions", str(regions), "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document == json.loads((tmp_path / "regions.json").read_text())
    assert document["regions"][0]["value_degC"] == pytest.approx(33, abs=0.01)
    (difference,) = document["differences"]
    assert difference["delta_K"] == pytest.approx(3, abs=0.02)
    assert difference["distance_mm"] == pytest.approx(50 * np.pi, rel=0.01)
    lines = (tmp_path / "regions.csv").read_text().splitlines()
    assert lines[0].startswith("name,kind,value_degC,sigma_K")
    assert lines[1].startswith("'=1+1,spot,33")
    assert len(lines) == 4
    more = ["measure", str(tmp_path), "--regions", str(regions), "--before", str(tmp_path), "--vertex", "7", "--json"]
    document = json.loads(CliRunner().invoke(app, more).stdout)
    assert [c["delta_K"] for c in document["changes"]] == [0, 0]
    assert [c["sigma_K"] for c in document["changes"]] == [None, None]  # of a relative result
    assert document["regions"][2]["name"] == "vertex 7"
    assert document["regions"][2]["value_degC"] == pytest.approx(float(T[7]))
    drawn = [Spot(name="s", point_m=(0, 0.1, 0)), Brush(name="cap", points_m=[(0, 0.1, 0)], normals=[(0, 1, 0)],
                                                       radius_m=0.06)]  # fmt: skip
    regions = write_regions(tmp_path / "drawn.json", drawn)
    for _ in range(2):  # its own file is replaced
        done = CliRunner().invoke(app, ["measure", str(tmp_path), "--regions", str(regions), "--labels"])
        assert done.exit_code == 0, done.output
    with np.load(tmp_path / "regions-labels.npz") as z:
        labels = z["labels"]
    upright_y = mesh.surface.vertices_m[:, 2]
    away = np.linalg.norm(mesh.surface.vertices_m - [0, 0, 0.1], axis=1)
    assert (labels == np.where(away < 0.06, 2, 0)).all()  # the second region; a spot covers nothing
    assert upright_y[labels == 2].min() > 0.07
    nothing = CliRunner().invoke(app, ["measure", str(tmp_path)])  # `main` makes exit code 2 of it
    assert isinstance(nothing.exception, RecipeError)


def test_a_closed_surface_keeps_volume_and_area_and_has_a_temperature_everywhere(tmp_path):
    """An ellipsoid with holes torn into it, two of them touching: watertight again, within 1 % and 2 % of the whole."""
    import trimesh

    whole = sphere(60, 90, (0.1, 0.12, 0.2))
    torn = np.ones(len(whole.triangles), bool)
    centre = whole.vertices_m[whole.triangles].mean(axis=1)
    for spot, radius in (((0.1, 0, 0), 0.02), ((0, 0, 0.2), 0.03), ((0, -0.12, 0), 0.01)):
        torn &= np.linalg.norm(centre - np.array(spot), axis=1) > radius
    pair = np.flatnonzero((whole.triangles == whole.triangles[torn][3000, 0]).any(axis=1))
    torn[pair[[0, 3]]] = False
    open_ = type(whole)(whole.vertices_m, whole.triangles[torn], whole.normals)
    mesh = closed(replace(result(open_), moved_mm=np.ones(len(open_), np.float32)))
    ours = trimesh.Trimesh(mesh.surface.vertices_m, mesh.surface.triangles, process=False)
    truth = trimesh.Trimesh(whole.vertices_m, whole.triangles, process=False)
    assert ours.is_watertight
    assert ours.is_winding_consistent
    assert ours.volume == pytest.approx(truth.volume, rel=0.01)
    assert enclosed_volume(mesh.surface.vertices_m, mesh.surface.triangles) == pytest.approx(ours.volume, rel=1e-6)
    assert ours.area == pytest.approx(truth.area, rel=0.02)
    assert mesh.measured.all()
    new = np.isnan(mesh.uncertainty_K)
    assert np.abs(mesh.temperature_degC - (30 + 30 * mesh.surface.vertices_m[:, 2]))[~new].max() < 1e-3
    names = [
        export(result(open_), tmp_path, ["vtk-mesh"], **named)[0].name for named in ({}, {"name": "mesh-apparent"})
    ]
    assert names == ["mesh-closed.vtp", "mesh-apparent-closed.vtp"]
    read = read_mesh(tmp_path / names[0])
    assert (read.temperature_degC == mesh.temperature_degC).all()


def test_foreign_readers_take_obj_and_stl(tmp_path):
    import trimesh

    mesh = result()
    obj, stl = export(mesh, tmp_path, ["obj", "stl"])
    for path in (obj, stl):
        read = trimesh.load(path, process=False)
        assert read.volume == pytest.approx(enclosed_volume(mesh.surface.vertices_m, mesh.surface.triangles), rel=1e-4)
    read = trimesh.load(obj, process=False)
    rgb = palettes.apply(mesh.temperature_degC, "inferno", *palettes.color_range(mesh.temperature_degC))
    assert np.abs(read.visual.vertex_colors[:, :3].astype(int) - rgb).max() <= 1
