"""Parts that are not bare skin: read by their own ε(θ) against truth, refused where they cannot be read, and files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import support.scan_maker as make
from scipy.spatial import cKDTree
from support.problems import problem_of
from support.synthetic_views import BAND, L_ROOM, make_world
from support.truth import truth_of
from test_crosscal import blackbodies
from test_phantom import reduced

from thermofusion.errors import ScanError
from thermofusion.phantom.scene import MaterialConfig, PatchConfig
from thermofusion.phantom.simulate import simulate
from thermofusion.physics.emissivity import Blackbody, Fresnel, Scaled
from thermofusion.physics.equation import apparent_radiance
from thermofusion.pipeline import fuse, plan
from thermofusion.recipe import load_recipe
from thermofusion.scans import open_scan
from thermofusion.scans.native.write import write_scan
from thermofusion.temperature.blend import blend
from thermofusion.temperature.crosscal import calibrate
from thermofusion.temperature.materials import Cover, Covers
from thermofusion.types import VertexFlag

SKIN = Fresnel(1.33)
RECIPE = load_recipe("torso", ["temperature.reflected_degC=20", "output.views=false", "output.report=false"])
CLOTH, CREAM = Scaled(Blackbody(), 0.85), Fresnel(1.45)


def covered_world(seed=3):
    """A body of skin with cloth, cream and foil on it: the world, its observations, where each lies."""
    world = make_world(seed)
    where = {
        "cloth": np.flatnonzero(world.points_m[:, 2] > 0.2),
        "cream": np.flatnonzero((world.points_m[:, 2] < -0.18) & (world.points_m[:, 0] > 0)),
        "foil": np.flatnonzero((world.points_m[:, 2] < -0.18) & (world.points_m[:, 0] < -0.03)),
    }
    rows, L = world.observations, world.observations.radiance.astype(float)
    skin = BAND.radiance(world.T_K)
    for name, model in (("cloth", CLOTH), ("cream", CREAM), ("foil", Scaled(Blackbody(), 0.1))):
        mine = np.flatnonzero(np.isin(rows.vertex, where[name]))
        at, mu = skin[rows.vertex[mine]], rows.cos_angle[mine].astype(float)
        L[mine] += apparent_radiance(at, model(mu), L_ROOM) - apparent_radiance(at, SKIN(mu), L_ROOM)
    return world, replace(rows, radiance=L.astype(np.float32)), where


def test_materials_are_read_by_their_own_emissivity_and_skin_is_left_as_it_is():
    world, rows, where = covered_world()
    known = {"emissivity": SKIN, "blackbodies": tuple(blackbodies(world))}
    problem = problem_of(rows, world.n_vertices, world.n_views, **known)
    foil = "it reflects more than it emits"
    covers = Covers(
        (
            Cover("cloth", where["cloth"].astype(np.int32), CLOTH, 0.02),
            Cover("cream", where["cream"].astype(np.int32), CREAM, 0.01),
            Cover("foil", where["foil"].astype(np.int32), None, 0.03, foil),
        ),
        world.n_vertices,
    )
    apart = covers.apart_from(problem)
    calibration = calibrate(apart)
    plain = blend(apart, calibration)
    found = covers.read(plain, apart, calibration)
    error = found.absolute_K - world.T_K
    skin = ~covers.anywhere
    np.testing.assert_array_equal(found.absolute_K[skin], plain.absolute_K[skin])
    for name in ("cloth", "cream"):
        v = where[name]
        assert abs(np.nanmedian(plain.absolute_K[v] - world.T_K[v])) > 0.1  # as if it were skin
        assert abs(np.nanmedian(error[v]) - np.nanmedian(error[skin])) < 0.01
    assert np.isnan(found.absolute_K[where["foil"]]).all()
    assert np.isnan(found.uncertainty.total_K[where["foil"]]).all()
    assert np.isfinite(found.apparent_K[where["foil"]]).mean() > 0.9  # what the camera reads is no claim

    # dT/dε(0) = (L_s - L_r)/(ε(0) dL/dT), from the truth alone
    v = where["cloth"][np.isfinite(found.absolute_K[where["cloth"]])]
    expected = 0.02 / 0.85 * (BAND.radiance(world.T_K[v]) - L_ROOM) / world.slope_L
    common = found.uncertainty.common_K
    assert common["material cloth"][v] == pytest.approx(expected, rel=0.03)
    assert (common["material cloth"][skin & np.isfinite(found.absolute_K)] == 0).all()
    assert (found.uncertainty.total_K[v] > 0.95 * np.abs(expected)).all()
    told = covers.told(found)
    assert told["foil"] == {**told["foil"], "measured": 0, "median_degC": None, "reason": foil}
    assert told["cloth"]["median_degC"] == pytest.approx(np.median(world.T_K[v]) - 273.15, abs=0.1)
    assert told["cloth"]["measured"] == len(v) > 0.9 * len(where["cloth"])


def test_what_is_found_not_to_be_skin_goes_to_the_material_that_claims_it():
    other = np.isin(np.arange(10), [2, 3, 7])
    covers = Covers(
        (
            Cover("hair", np.array([8], np.int32), CLOTH, 0.03, not_skin=True),
            Cover("cream", np.array([3, 4], np.int32), CREAM, 0.01),
        ),
        10,
    )
    assert covers.with_found(other).covers[0].vertices.tolist() == [2, 7, 8]  # 3 is cream, as somebody said
    assert covers.with_found(other).covers[1] is covers.covers[1]
    assert covers.with_found(np.zeros(10, bool)) is covers
    film = replace(covers, covers=(covers.covers[0], replace(covers.covers[1], as_warm=True)))
    assert np.flatnonzero(film.with_found(other).flagged(other)).tolist() == [2, 7, 8]
    assert np.flatnonzero(covers.with_found(other).flagged(other)).tolist() == [2, 3, 4, 7, 8]
    unread = replace(film, covers=(replace(film.covers[1], model=None),))
    assert np.flatnonzero(unread.flagged(other)).tolist() == [2, 3, 4, 7]


# ---------------------------------------------------------------- through a whole run


@pytest.fixture(scope="module")
def covered(tmp_path_factory):
    """A ball of 36 °C in 20 °C with a dressing of ε = .85 on one side and foil on the other; the scan, the result
    without a word of either, and what lies on each vertex: 0 skin, 1 dressing, 2 foil."""
    dressing, foil = (MaterialConfig("diffuse", epsilon=e) for e in (0.85, 0.1))
    patches = (
        PatchConfig("dressing", (0.12, 0, 1.12), 0.06, dressing),
        PatchConfig("foil", (-0.12, 0, 1.12), 0.05, foil),
    )
    root = simulate(replace(reduced("sphere"), patches=patches), tmp_path_factory.mktemp("covered") / "scan", seed=2)
    result = fuse(open_scan(root), RECIPE, out=root.parent / "out")
    truth = truth_of(root)
    nearest = cKDTree(truth["vertices_m"]).query(result.mesh_in_world.surface.vertices_m)[1]
    return root, result, truth["material"][nearest]


def stated(folder, out, *materials):
    """The scan, copied, with materials stated."""
    root = write_scan(open_scan(folder), out)
    document = json.loads((root / "scan.json").read_text())
    document["materials"] = materials
    (root / "scan.json").write_text(json.dumps(document))
    return root


DRESSING = {"name": "dressing", "emissivity": {"model": "blackbody", "epsilon0": 0.85}}
FOIL = {"name": "foil", "emissivity": {"model": "blackbody", "epsilon0": 0.1}}


def test_a_dressing_is_read_foil_is_not_and_earlier_stages_stay(covered, tmp_path):
    root, before, material = covered
    labels = {"labels": "labels.npz", "label": 1}, {"labels": "labels.npz", "label": 2}
    told = stated(root, tmp_path / "told", DRESSING | labels[0], FOIL | labels[1])
    np.savez(told / "labels.npz", labels=material)
    bare = open_scan(root)
    scan = replace(bare, materials=open_scan(told).materials)
    assert [s.reuse for s in plan(scan, RECIPE, root.parent / "out")] == [True] * 4 + [False]
    assert [s.reuse for s in plan(bare, RECIPE, root.parent / "out")] == [True] * 5
    result = fuse(scan, RECIPE)
    degC, sigma = result.mesh.temperature_degC, result.mesh.uncertainty_K
    good = np.isfinite(degC) & (result.mesh.view_angle_deg < 60)
    level = np.median(degC[good & (material == 0)])
    dressing = good & (material == 1)
    assert np.median(before.mesh.temperature_degC[dressing]) < 34.5  # as if it were skin
    assert np.median(degC[dressing]) - level == pytest.approx(0, abs=0.1)
    assert (np.abs(degC[dressing] - level) < 1.96 * sigma[dressing]).mean() > 0.95
    assert np.isnan(degC[material == 2]).all()
    assert (before.mesh.measured & ~result.mesh.measured & (material != 2)).sum() == 0
    assert (((result.mesh.flags & VertexFlag.NOT_SKIN) > 0) == (material > 0)).all()
    said = result.report["temperature"]["materials"]
    assert said["foil"]["measured"] == 0
    assert said["dressing"]["vertices"] == (material == 1).sum()
    assert any("'foil'" in m and "reflects more than it emits" in m for m in result.report["messages"])
    numbers = {row["what"]: row["value"] for row in result.report["radiometry"]}
    assert numbers["emissivity of 'dressing'"] == "model = blackbody, epsilon0 = 0.85"
    other = replace(scan.materials[0], of_vertices=len(material) + 1)
    with pytest.raises(ScanError, match=f"this one has {len(material)}"):
        fuse(replace(bare, materials=(other,)), RECIPE)


def test_skin_told_to_be_skin_changes_nothing_and_an_outline_in_a_picture_is_found(covered, tmp_path):
    root, before, _ = covered
    bare = open_scan(root)
    rows, frame = before.mapped.observations, int(bare.thermal.index[before.mapped.views.frame[5]])
    u, v = rows.u_px[rows.view == 5], rows.v_px[rows.view == 5]
    box = [float(np.quantile(x, q)) for x in (u, v) for q in (0.3, 0.7)]
    outline = [[box[0], box[2]], [box[1], box[2]], [box[1], box[3]], [box[0], box[3]]]
    inside = ((u > box[0]) & (u < box[1]) & (v > box[2]) & (v < box[3])).sum()
    skin = {"name": "skin", "emissivity": {"model": "dielectric"}}  # n = 1.33, as the recipe has it
    skin["polygons"] = [{"frame": frame, "thermal_polygon_px": outline}, {"frame": 999, "thermal_polygon_px": outline}]
    scan = replace(bare, materials=open_scan(stated(root, tmp_path / "skin", skin)).materials)
    same = fuse(scan, RECIPE)
    np.testing.assert_array_equal(same.mesh.temperature_degC, before.mesh.temperature_degC)
    np.testing.assert_array_equal(same.mesh.uncertainty_K, before.mesh.uncertainty_K)
    np.testing.assert_array_equal(same.mesh.flags, before.mesh.flags)
    assert same.report["temperature"]["materials"]["skin"]["vertices"] == inside
    assert any("read as skin" in m for m in same.report["messages"])
    assert any("thermal frame 999 is none of those that were used" in m for m in same.report["messages"])


def test_what_is_stated_survives_writing_and_what_is_wrong_is_named(tmp_path):
    bare = write_scan(make.tiny_scan(), tmp_path / "bare")
    whole = {"polygons": [{"frame": 2, "thermal_polygon_px": [[20, 20], [50, 20], [50, 30]]}]}
    numbers = {"vertices": [3, 1, 2], "of_vertices": 9, "sigma_emissivity0": 0.04}
    root = stated(
        bare,
        tmp_path / "one",
        DRESSING | numbers | whole,
        {"name": "hair", "not_skin": True, "counts_as_skin": True, "emissivity": "skin"},
    )
    m, hair = open_scan(write_scan(open_scan(root), tmp_path / "two")).materials
    assert (m.name, m.emissivity, m.sigma_emissivity0) == ("dressing", DRESSING["emissivity"], 0.04)
    assert (m.vertices.tolist(), m.of_vertices, m.polygons_px[0][0]) == ([1, 2, 3], 9, 2)
    assert hair.counts_as_skin
    assert not m.counts_as_skin
    assert (hair.name, hair.emissivity, hair.sigma_emissivity0, hair.not_skin) == ("hair", "skin", None, True)
    wrong = (
        ({}, "where it is must be said"),
        ({"vertices": [9], "of_vertices": 9}, "none of 9"),
        ({"labels": "../labels.npz"}, "leaves the scan's folder"),
        ({"labels": "none.npz"}, "none.npz"),
        ({"vertices": [1], "emissivity": {"modle": "water"}}, "modle"),
        ({"vertices": [1], "sigma_emissivity0": 0.0}, "sigma_emissivity0"),
        ({"polygons": [{"frame": 2, "thermal_polygon_px": [[0, 0], [9, 9], [9000, 2]]}]}, "beyond the thermal image"),
    )
    for number, (material, said) in enumerate(wrong):
        with pytest.raises(ScanError) as fault:
            open_scan(stated(bare, tmp_path / f"wrong{number}", {"name": "dressing", **material}))
        assert said in str(fault.value)
