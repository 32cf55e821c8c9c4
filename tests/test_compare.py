"""Comparisons: injected differences come back, surfaces find each other, readings are read or refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.result_maker import result, sphere

from thermofusion.cli import main
from thermofusion.errors import RecipeError, ScanError
from thermofusion.export import write_ply
from thermofusion.geometry.rigid import rotation_angle_deg, se3_exp, transform_points
from thermofusion.judge.compare import (
    Agreement,
    bland_altman_svg,
    compare,
    compare_contacts,
    compare_meshes,
    load_temperatures,
)
from thermofusion.judge.contacts import read_contacts
from thermofusion.judge.register import mirrored, register
from thermofusion.types import SurfaceMesh, ThermalMesh


def lumpy(rings=60, around=100) -> SurfaceMesh:
    """A body without symmetry: an egg with a nose, one shoulder and a hip."""
    s = sphere(rings, around, (0.16, 0.11, 0.26))
    p = s.vertices_m.astype(np.float64)
    out = np.stack([p[:, 0], p[:, 1], 0 * p[:, 0]], 1)
    out /= np.linalg.norm(out, axis=1, keepdims=True) + 1e-9
    bump = lambda c, r, h: h * np.exp(-((p - c) ** 2).sum(1) / r**2)  # noqa: E731
    grow = bump([0, -0.11, 0.15], 0.05, 0.03) + bump([0.13, 0, 0.1], 0.06, 0.03) + bump([-0.1, 0.05, -0.12], 0.07, 0.02)
    vertices = (p + grow[:, None] * out).astype(np.float32)
    from thermofusion.geometry.mesh import mesh_normals

    return SurfaceMesh(vertices, s.triangles, mesh_normals(vertices, s.triangles))


def smooth_field(points, rng, length_m=0.02):
    """An error of 1 K rms that varies over about `length_m`, as errors of maps do: a sum of random plane waves."""
    k = rng.normal(0, 1 / length_m, (200, 3))
    return np.sqrt(2 / 200) * np.cos(points @ k.T + rng.uniform(0, 2 * np.pi, 200)).sum(1)


def skin(surface, error_K=0.0, sigma_K=0.05, **changes) -> ThermalMesh:
    x, _, z = surface.vertices_m.T
    T = 33 + 4 * z + 0.6 * np.sin(20 * x) + error_K
    mesh = ThermalMesh.from_temperature(surface, T.astype(np.float32), metadata={"up": "0 0 1", "front": "0 -1 0"})
    return replace(mesh, uncertainty_K=np.full(len(surface), sigma_K, np.float32), **changes)


def moved(mesh, T):
    s = mesh.surface
    surface = replace(
        s,
        vertices_m=transform_points(T, s.vertices_m.astype(np.float64)).astype(np.float32),
        normals=(s.normals @ T[:3, :3].T).astype(np.float32),
    )
    axes = {k: " ".join(map(str, T[:3, :3] @ [float(x) for x in str(v).split()])) for k, v in mesh.metadata.items()}
    return replace(mesh, surface=surface, metadata=axes)


# ---------------------------------------------------------------- agreement


@pytest.mark.parametrize(("bias", "sd"), [(0.0, 0.05), (0.2, 0.1), (-0.4, 0.02)])
def test_limits_of_agreement_are_the_injected_error(bias, sd):
    """Two results of one body, meshed differently, in frames apart, each with errors of its own: within 10 %."""
    rng = np.random.default_rng(4)
    one, two = lumpy(60, 100), lumpy(71, 113)
    errors = [sd / np.sqrt(2) * smooth_field(s.vertices_m.astype(np.float64), rng) for s in (one, two)]
    a = skin(one, bias + errors[0], sigma_K=sd / np.sqrt(2))
    b = moved(skin(two, errors[1], sigma_K=sd / np.sqrt(2)), se3_exp([0.3, -0.2, 2.5, 0.4, -1.0, 0.2]))
    c = compare_meshes(a, b)
    g = c.agreement
    assert g.bias_K == pytest.approx(bias, abs=0.1 * sd)
    assert g.upper_K - g.lower_K == pytest.approx(2 * 1.96 * sd, rel=0.10)
    assert g.p97_5_K - g.p2_5_K == pytest.approx(2 * 1.96 * sd, rel=0.10)
    if bias == 0:
        assert g.within_95 == pytest.approx(0.95, abs=0.02)
    assert c.compared > 0.97
    assert c.registration.converged


def test_agreement_of_known_numbers():
    """Bland and Altman's own formulae, by hand."""
    g = Agreement.of(np.array([10.0, 12.0, 14.0]), np.array([9.0, 12.0, 12.0]))
    assert (g.bias_K, g.sd_K, g.mae_K) == pytest.approx((1.0, 1.0, 1.0))
    assert (g.lower_K, g.upper_K) == pytest.approx((1 - 1.96, 1 + 1.96))
    weighted = Agreement.of(np.array([1.0, 5.0]), np.zeros(2), weight=np.array([3.0, 1.0]))
    assert weighted.bias_K == pytest.approx(2.0)
    with pytest.raises(ScanError, match="too few"):
        Agreement.of(np.ones(1), np.ones(1))


def test_a_gain_shows_as_a_slope():
    a = skin(lumpy())
    b = replace(a, temperature_degC=(33 + 0.9 * (a.temperature_degC - 33)).astype(np.float32))
    assert compare_meshes(a, b, moved=False).agreement.slope == pytest.approx(0.1 / 0.95, rel=0.02)


# ---------------------------------------------------------------- surfaces


@pytest.mark.parametrize("axes", [True, False])
def test_any_pose_is_found(axes):
    """Turned by more than half a circle and shifted by a metre; with and without knowing which way is up."""
    T = se3_exp([0.1, 0.15, 2.9, 1.0, -0.5, 0.3])
    a, b = skin(lumpy()), moved(skin(lumpy(71, 113)), T)
    if not axes:
        a, b = replace(a, metadata={}), replace(b, metadata={})
    found = register(a, b)
    assert found.converged
    assert found.residual_mm < 0.3
    assert rotation_angle_deg(found.T_b_a @ np.linalg.inv(T)) < 0.2
    p = a.surface.vertices_m.astype(np.float64)
    assert np.linalg.norm(transform_points(found.T_b_a, p) - transform_points(T, p), axis=1).max() < 1e-3


def test_left_against_right():
    """A body alike on both sides, 0.5 K warmer on its left: the mirror image shows + and - 0.5 K."""
    surface = sphere(60, 100, (0.16, 0.11, 0.26))
    warm = np.tanh(surface.vertices_m[:, 0] / 0.01) * 0.25
    mesh = replace(skin(surface), temperature_degC=(33 + warm).astype(np.float32))
    c = compare_meshes(mesh, mirrored(mesh), moved=False)
    left = surface.vertices_m[:, 0] > 0.05
    assert np.nanmean(c.difference_K[left]) == pytest.approx(0.5, abs=0.01)
    assert np.nanmean(c.difference_K[surface.vertices_m[:, 0] < -0.05]) == pytest.approx(-0.5, abs=0.01)
    twice = mirrored(mirrored(mesh)).surface
    np.testing.assert_allclose(twice.vertices_m, surface.vertices_m, atol=1e-6)
    np.testing.assert_array_equal(twice.triangles, surface.triangles)


def test_unmeasured_skin_and_far_surfaces_do_not_count():
    a = skin(lumpy())
    hole = a.surface.vertices_m[:, 2] > 0.1
    b = replace(a, temperature_degC=np.where(hole, np.nan, a.temperature_degC).astype(np.float32))
    c = compare_meshes(a, b, moved=False)
    assert not np.isfinite(c.difference_K[a.surface.vertices_m[:, 2] > 0.12]).any()
    assert c.compared < 0.9
    with pytest.raises(ScanError, match="share no measured skin"):
        compare_meshes(a, moved(a, se3_exp([0, 0, 0, 1.0, 0, 0])), moved=False)


def test_what_cannot_be_compared_is_said():
    a = skin(lumpy(24, 40))
    remarks = compare_meshes(a, replace(a, mode="apparent", anchored=False), moved=False).messages
    assert any("different quantities" in m for m in remarks)
    assert any("bias says nothing" in m for m in remarks)


# ---------------------------------------------------------------- truth, readings, files


def test_truth_archive_and_verb(tmp_path, capsys):
    """`compare` of a mesh file with a truth: report, plot and picture; the same input gives the same bytes."""
    surface = lumpy()
    mesh = skin(surface, error_K=0.1)
    write_ply(tmp_path / "mesh.ply", mesh)
    truth = skin(surface)
    np.savez(
        tmp_path / "truth.npz",
        vertices_m=surface.vertices_m,
        triangles=surface.triangles,
        temperature_degC=truth.temperature_degC,
    )
    with pytest.raises(SystemExit) as stopped:
        main(["compare", str(tmp_path), str(tmp_path / "truth.npz"), "-o", str(tmp_path / "out"), "--json"])
    report = json.loads(capsys.readouterr().out)
    assert stopped.value.code == 0
    assert report["agreement"]["bias_K"] == pytest.approx(0.1, abs=0.002)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"bland-altman.svg", "comparison.json", "difference.png"}
    again = bland_altman_svg(compare(tmp_path, tmp_path / "truth.npz"))
    assert again == (tmp_path / "out" / "bland-altman.svg").read_text()
    assert again.startswith("<svg")


def contacts_csv(path, mesh, offset_K, rows=(10, 900, 2500, 4000)):
    lines = ["name, x_m, y_m, z_m, degC, uncertainty_K"]
    for n, i in enumerate(rows):
        p, T = mesh.surface.vertices_m[i], mesh.temperature_degC[i]
        lines.append(f"tc{n}, {p[0]:.5f}, {p[1]:.5f}, {p[2]:.5f}, {T - offset_K + 0.02 * (-1) ** n:.4f}, 0.1")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_contact_readings(tmp_path):
    mesh = skin(lumpy(), sigma_K=0.1)
    c = compare_contacts(mesh, read_contacts(contacts_csv(tmp_path / "tc.csv", mesh, 0.3)))
    assert c.agreement.bias_K == pytest.approx(0.3, abs=0.03)  # the map is a mean over 6 mm, the reading a point
    assert c.agreement.sd_K < 0.05
    assert c.places == ("tc0", "tc1", "tc2", "tc3")
    assert "tc2" in c.text()
    assert any("contact sensor changes what it measures" in m for m in c.messages)
    listed = [
        {"p_world_m": r.p_world_m.tolist(), "degC": r.degC, "uncertainty_K": r.uncertainty_K, "name": r.name}
        for r in read_contacts(tmp_path / "tc.csv")
    ]
    (tmp_path / "tc.json").write_text(json.dumps(listed))
    same = compare_contacts(mesh, read_contacts(tmp_path / "tc.json"))
    assert same.agreement == c.agreement


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.csv", "x_m,y_m,z_m,degC\n0,0,0,33\n", "1 column missing: uncertainty_K"),
        ("a.csv", "x_m,y_m,z_m,degC,uncertainty_K\n", "no contact reading"),
        ("a.csv", "x_m,y_m,z_m,degC,uncertainty_K\n0,0,zero,33,0.1\n", "reading 1"),
        ("a.csv", "x_m,y_m,z_m,degC,uncertainty_K\n0,0,0,33,-1\n", "uncertainty_K"),
        ("a.json", "{", "not valid JSON"),
        ("a.json", "{}", "must be a list"),
        ("a.json", '[{"p_world_m": [0, 0], "degC": 33, "uncertainty_K": 0.1}]', "reading 1"),
        ("a.json", '[{"p_world_m": [0, 0, 0], "degC": NaN, "uncertainty_K": 0.1}]', "NaN"),
    ],
)
def test_readings_that_cannot_be_used(tmp_path, name, text, match):
    (tmp_path / name).write_text(text)
    with pytest.raises(ScanError, match=match):
        read_contacts(tmp_path / name)


def test_refusals(tmp_path):
    mesh = skin(lumpy(24, 40))
    write_ply(tmp_path / "mesh.ply", mesh)
    far = tmp_path / "far.csv"
    far.write_text("x_m,y_m,z_m,degC,uncertainty_K\n1,1,1,33,0.1\n1,1,1,33,0.1\n")
    with pytest.raises(ScanError, match="cm off the surface"):
        compare(tmp_path, far)
    with pytest.raises(RecipeError, match="mirrored"):
        compare(tmp_path, far, mirror=True)
    with pytest.raises(ScanError, match="nothing here"):
        load_temperatures(tmp_path / "absent")
    np.savez(tmp_path / "bad.npz", vertices_m=np.zeros((3, 3)))
    with pytest.raises(ScanError, match="the truth has no array 'triangles'"):
        load_temperatures(tmp_path / "bad.npz")
    unmeasured = result()
    write_ply(tmp_path / "egg.ply", unmeasured)
    assert np.isnan(load_temperatures(tmp_path / "egg.ply").temperature_degC).any()
