"""Files of a result: round trips, foreign readers, damaged files."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
import warnings
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.result_maker import result, sphere

from thermofusion.errors import RecipeError, ResourceError, ScanError, ThermofusionError
from thermofusion.export import (
    axes_of,
    export,
    read_csv,
    read_glb,
    read_mesh,
    read_ply,
    read_trajectory,
    read_vtp,
    showing,
    view_axes,
    write_csv,
    write_glb,
    write_ply,
    write_trajectory,
    write_vtp,
)
from thermofusion.export.columns import COLUMNS, KNOWN, vertex_normals
from thermofusion.export.palettes import apply, color_range, srgb_to_linear
from thermofusion.files.whole import write_whole
from thermofusion.geometry.rigid import pose
from thermofusion.types import SurfaceMesh, ThermalMesh, Trajectory, VertexFlag

JS = Path(__file__).parent / "js"
DOCS = Path(__file__).parent.parent / "docs" / "formats.md"
PER_VERTEX = [c.field for c in COLUMNS]


def assert_same(got: ThermalMesh, want: ThermalMesh, order: np.ndarray | None = None) -> None:
    """Equal to the bit, `got`'s vertices being `want`'s in `order`."""
    order = np.arange(len(want)) if order is None else order
    assert (got.mode, got.anchored, got.metadata) == (want.mode, want.anchored, want.metadata)
    np.testing.assert_array_equal(got.surface.vertices_m, want.surface.vertices_m[order])
    np.testing.assert_array_equal(got.surface.normals, want.surface.normals[order])
    for name in PER_VERTEX:
        assert getattr(got, name).dtype == getattr(want, name).dtype
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name)[order], err_msg=name)


# ---------------------------------------------------------------- round trips


@pytest.mark.parametrize(("write", "read"), [(write_ply, read_ply), (write_vtp, read_vtp)])
def test_lossless_round_trip(tmp_path, write, read):
    mesh = result()
    back = read(write(tmp_path / "m", mesh))
    assert_same(back, mesh)
    np.testing.assert_array_equal(back.surface.triangles, mesh.surface.triangles)
    assert back.uncertainty_parts.keys() == mesh.uncertainty_parts.keys()
    for name, values in mesh.uncertainty_parts.items():
        np.testing.assert_array_equal(back.uncertainty_parts[name], values)
    first = (tmp_path / "m").read_bytes()
    assert write(tmp_path / "again", mesh).read_bytes() == first  # same input, same bytes


@pytest.mark.parametrize(("write", "read"), [(write_ply, read_ply), (write_vtp, read_vtp), (write_glb, read_glb)])
def test_motion_travels_where_there_was_some(tmp_path, write, read):
    mesh = result()
    assert read(write(tmp_path / "still", mesh)).moved_mm is None
    assert b"moved" not in (tmp_path / "still").read_bytes().lower()
    moved_mm = np.linspace(0.0, 37.5, len(mesh), dtype=np.float32)
    back = read(write(tmp_path / "moved", replace(mesh, moved_mm=moved_mm)))
    order = np.argmin(np.linalg.norm(back.surface.vertices_m[:, None] - mesh.surface.vertices_m, axis=2), axis=1)
    known = np.isfinite(back.moved_mm)  # glTF carries the measured skin's alone
    assert known.sum() >= mesh.measured.sum()
    np.testing.assert_array_equal(back.moved_mm[known], moved_mm[order][known])
    write_csv(tmp_path / "m.csv", replace(mesh, moved_mm=moved_mm))
    np.testing.assert_allclose(read_csv(tmp_path / "m.csv")["moved_mm"], moved_mm, atol=6e-5)


def test_skin_colour_only_if_asked(tmp_path):
    mesh = result()
    assert read_ply(write_ply(tmp_path / "a.ply", mesh)).surface.color_rgb is None
    back = read_ply(write_ply(tmp_path / "b.ply", mesh, color="skin"))
    np.testing.assert_array_equal(back.surface.color_rgb, mesh.surface.color_rgb)
    with pytest.raises(ValueError, match="no skin colour"):
        write_ply(tmp_path / "c.ply", replace(mesh, surface=replace(mesh.surface, color_rgb=None)), color="skin")


@pytest.mark.parametrize("unmeasured_below_m", [-9.0, -0.07, 0.0, 9.0])
def test_glb_round_trip(tmp_path, unmeasured_below_m):
    mesh = result(unmeasured_below_m=unmeasured_below_m)
    mesh = replace(mesh, observations=np.where(mesh.measured, mesh.observations, 0), flags=mesh.flags * mesh.measured)
    back = read_glb(write_glb(tmp_path / "m.glb", mesh))
    # The vertices come back in another order; positions of a sphere are unique.
    keys = [{tuple(p): i for i, p in enumerate(m.surface.vertices_m.tolist())} for m in (mesh, back)]
    order = np.array([keys[0][tuple(p)] for p in back.surface.vertices_m.tolist()])
    assert sorted(order) == list(range(len(mesh)))
    normals = vertex_normals(mesh.surface.vertices_m, mesh.surface.triangles)
    if unmeasured_below_m in (-0.07, 0.0):  # some vertices of mixed triangles are measured and must stay so
        assert (
            mesh.measured[mesh.surface.triangles].any(axis=1).sum() > mesh.measured[mesh.surface.triangles].all(1).sum()
        )
    same_normals = replace(back, surface=replace(back.surface, normals=mesh.surface.normals[order]))
    assert np.abs(back.surface.normals - mesh.surface.normals[order]).max() < 1e-6
    assert np.einsum("ij,ij->i", normals[order], back.surface.normals).min() > 0.99
    if mesh.measured.any():
        assert_same(same_normals, mesh, order)
    rows = lambda faces: {tuple(np.roll(f, -f.argmin())) for f in faces}  # noqa: E731
    assert rows(order[back.surface.triangles]) == rows(mesh.surface.triangles)


def test_csv_round_trip(tmp_path):
    mesh = result()
    table = read_csv(write_csv(tmp_path / "m.csv", mesh))
    np.testing.assert_allclose(
        np.stack([table[n] for n in ("x_m", "y_m", "z_m")], 1), mesh.surface.vertices_m, atol=5.1e-7
    )
    for name in PER_VERTEX:
        np.testing.assert_allclose(table[name], getattr(mesh, name), atol=5.1e-5, err_msg=name)
    np.testing.assert_allclose(table["uncertainty_noise_K"], mesh.uncertainty_parts["noise"], atol=5.1e-5)
    assert set(table["output_mode"]) == {"absolute"}
    assert set(table["level"]) == {"relative"}
    assert ",nan," not in (tmp_path / "m.csv").read_text()


def test_trajectory_round_trip(tmp_path):
    rng = np.random.default_rng(3)
    T = np.stack(
        [pose(R, t) for R, t in zip(Rotation.random(40, rng=rng).as_matrix(), rng.normal(size=(40, 3)), strict=True)]
    )
    back = read_trajectory(write_trajectory(tmp_path / "t.txt", Trajectory(1.4e9 + np.arange(40) / 30, T)))
    np.testing.assert_allclose(back.T_world_depth, T, atol=5e-9)
    np.testing.assert_allclose(back.times_s, 1.4e9 + np.arange(40) / 30, atol=1e-6)


def test_names_are_the_agreed_ones(tmp_path):
    write_ply(tmp_path / "m.ply", result())
    header = (tmp_path / "m.ply").read_bytes().split(b"end_header\n")[0].decode("ascii")
    assert re.findall(r"property (\w+) (\w+)\n", header) == [
        *[("float", n) for n in ("x", "y", "z", "nx", "ny", "nz")],
        *[("uchar", n) for n in ("red", "green", "blue")],
        ("float", "scalar_temperature"),
        ("float", "scalar_temperature_apparent"),
        ("float", "scalar_uncertainty"),
        ("float", "scalar_view_angle"),
        ("float", "scalar_distance"),
        ("float", "scalar_observations"),
        ("float", "scalar_flags"),
        ("float", "quality"),
        ("float", "scalar_uncertainty_noise"),
        ("float", "scalar_uncertainty_emissivity"),
    ]
    assert "property list uchar int vertex_indices" in header
    assert max(map(len, header.splitlines())) < 256  # MeshLab refuses 500
    assert 'comment thermofusion output_mode "absolute"' in header
    assert 'comment thermofusion level "relative"' in header
    assert [c.glb for c in COLUMNS][:4] == ["_TEMPERATURE", "_TEMPERATURE_APPARENT", "_UNCERTAINTY", "_VIEW_ANGLE"]


def test_export_writes_the_folder(tmp_path):
    mesh = result()
    paths = export(mesh, tmp_path / "a/b", ("ply", "glb", "vtp", "csv"), palette="iron")
    assert {p.name for p in paths} == {"mesh.ply", "mesh.glb", "mesh.vtp", "mesh.csv"}
    assert sorted(p.name for p in (tmp_path / "a/b").iterdir()) == sorted(p.name for p in paths)
    assert_same(read_mesh(tmp_path / "a/b"), mesh)
    for arguments in ({"formats": ["fbx"]}, {"palette": "jet"}, {"range_degC": (36.0, 30.0)}):
        with pytest.raises(RecipeError):
            export(mesh, tmp_path, **arguments)
    with pytest.raises(ScanError, match="no mesh format"):
        read_mesh(tmp_path / "mesh.obj")
    with pytest.raises(ScanError, match="no mesh"):
        read_mesh(tmp_path)


def test_showing_never_mixes_modes():
    mesh = result()
    apparent = showing(mesh, "apparent")
    np.testing.assert_array_equal(apparent.temperature_degC, mesh.apparent_degC)
    assert apparent.mode == "apparent"
    assert np.isnan(apparent.uncertainty_K).all()
    assert showing(mesh, "absolute") is mesh
    with pytest.raises(RecipeError, match="not normal-equivalent"):
        showing(mesh, "normal-equivalent")


# ---------------------------------------------------------------- the type


def test_thermal_mesh_is_validated():
    mesh = result()
    for name in (*PER_VERTEX, "mode"):
        wrong = "warm" if name == "mode" else getattr(mesh, name)[:-1]
        with pytest.raises(ValueError, match=f"{name}|output mode"):
            replace(mesh, **{name: wrong})
    with pytest.raises(ValueError, match="infinite"):
        replace(mesh, temperature_degC=np.full(len(mesh), np.inf))
    assert (((mesh.flags & VertexFlag.UNMEASURED) > 0) == np.isnan(mesh.temperature_degC)).all()
    assert {f.name for f in fields(ThermalMesh)} >= set(PER_VERTEX)


def test_writers_refuse_broken_meshes(tmp_path):
    mesh = result()
    v = mesh.surface.vertices_m.copy()
    v[5] = np.nan
    far = mesh.surface.triangles.copy()
    far[0, 0] = len(mesh)
    for broken in (replace(mesh.surface, vertices_m=v), replace(mesh.surface, triangles=far)):
        for write in (write_ply, write_glb, write_vtp, write_csv):
            with pytest.raises(ValueError, match=r"not a finite|names a vertex"):
                write(tmp_path / "x", replace(mesh, surface=broken))
    with pytest.raises(ValueError, match="small letters"):
        write_ply(tmp_path / "x", replace(mesh, uncertainty_parts={"a b": mesh.uncertainty_K}))
    with pytest.raises(ValueError, match="without triangles"):
        write_glb(tmp_path / "x", replace(mesh, surface=replace(mesh.surface, triangles=np.zeros((0, 3), np.int32))))
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- whole or not at all


def test_files_are_whole_or_absent(tmp_path):
    path = tmp_path / "a"
    write_whole(path, [b"first thermofusion"])

    def torn():
        yield b"second, torn"
        raise OSError(28, "No space left on device")

    with pytest.raises(ResourceError, match="No space left"):
        write_whole(path, torn())
    assert path.read_bytes() == b"first thermofusion"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    with pytest.raises(ResourceError):
        write_ply(tmp_path / "absent" / "m.ply", result())
    with pytest.raises(ScanError, match="absent"):
        read_ply(tmp_path / "nothing.ply")


@pytest.mark.parametrize(
    ("write", "read"), [(write_ply, read_ply), (write_glb, read_glb), (write_vtp, read_vtp), (write_csv, read_csv)]
)
def test_damaged_files_are_refused_or_read(tmp_path, write, read):
    """Torn anywhere: always an error. Bytes flipped: a mesh or one clear error, nothing else."""
    small = result(sphere(6, 8))
    path = write(tmp_path / "m", small)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    head = len(data) if write is write_csv else min(len(data), 6000)
    for cut in {0, 1, 3, *rng.integers(0, len(data) - 1, 40).tolist()}:
        path.write_bytes(data[:cut])
        if write is write_csv and cut:
            read_or_refuse(read, path)
        elif write is not write_vtp or cut < data.rfind(b"</AppendedData>"):
            with pytest.raises(ScanError):
                read(path)
    for _ in range(250):
        torn = bytearray(data)
        for at in rng.integers(0, head if rng.random() < 0.8 else len(data), rng.integers(1, 4)):
            torn[at] = rng.integers(0, 256)
        path.write_bytes(torn)
        read_or_refuse(read, path)


def read_or_refuse(read, path):
    try:
        read(path)
    except ThermofusionError as e:
        named = e.place is not None and str(path) in e.place
    else:
        named = True
    assert named


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        (b"ply\n", b"obj\n", "no PLY"),
        (b"binary_little_endian", b"binary_big_endian", "expected binary_little_endian"),
        (b"end_header", b"end_heavens", "no end"),
        (b"element vertex ", b"element vertex 99999999999", "truncated"),
        (b"element vertex ", b"element vertex -", "not understood"),
        (b"property float nx", b"property list uchar int nx", "not understood"),
        (b"property float nx", b"property float x", "twice"),
        (b"property float x\n", b"property float q\n", "no x, y and z"),
        (b"vertex_indices", b"corners", "no list of vertex indices"),
        (b'"absolute"', b'"lukewarm"', "output mode"),
        (b'output_mode "absolute"', b'output_mode "absolute', "damaged"),
    ],
)
def test_ply_faults_are_named(tmp_path, old, new, cause):
    path = write_ply(tmp_path / "m.ply", result(sphere(6, 8)))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(ScanError, match=cause):
        read_ply(path)


def test_reads_a_foreign_ply(tmp_path):
    """A file of trimesh's: no scalars, no normals, no comments of ours."""
    trimesh = pytest.importorskip("trimesh")
    surface = sphere()
    data = trimesh.Trimesh(surface.vertices_m, surface.triangles, process=False).export(file_type="ply")
    (tmp_path / "foreign.ply").write_bytes(data)
    mesh = read_ply(tmp_path / "foreign.ply")
    assert not mesh.measured.any()
    np.testing.assert_array_equal(mesh.surface.triangles, surface.triangles)
    assert np.einsum("ij,ij->i", mesh.surface.normals, surface.normals).min() > 0.99


# ---------------------------------------------------------------- foreign readers


def test_open3d_reads_ply(tmp_path):
    from thermofusion.geometry._open3d import o3d

    mesh = result()
    read = o3d.t.io.read_triangle_mesh(str(write_ply(tmp_path / "m.ply", mesh)))
    np.testing.assert_array_equal(read.vertex.positions.numpy(), mesh.surface.vertices_m)
    np.testing.assert_array_equal(read.triangle.indices.numpy(), mesh.surface.triangles)
    np.testing.assert_array_equal(np.round(read.vertex.colors.numpy() * 255), colors(mesh))


def test_trimesh_reads_ply_and_glb(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = result()
    export(mesh, tmp_path, ("ply", "glb"))
    ply = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(ply.vertices.astype(np.float32), mesh.surface.vertices_m)
    np.testing.assert_array_equal(ply.faces, mesh.surface.triangles)
    raw = ply.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(raw["scalar_temperature"], mesh.temperature_degC)
    np.testing.assert_array_equal(ply.visual.vertex_colors[:, :3], colors(mesh))
    scene = trimesh.load(tmp_path / "mesh.glb", process=False)
    skin = scene.geometry["skin"]
    np.testing.assert_allclose(
        np.sort(skin.vertex_attributes["_TEMPERATURE"].ravel()), np.sort(mesh.temperature_degC[mesh.measured])
    )
    assert len(skin.faces) + len(scene.geometry["unmeasured"].faces) == len(mesh.surface.triangles)
    np.testing.assert_allclose(scene.bounds[:, 1], [-0.1, 0.1], atol=1e-6)  # up is glTF's y
    assert skin.is_winding_consistent


def test_meshlab_reads_quality(tmp_path):
    pymeshlab = pytest.importorskip("pymeshlab")
    mesh = result()
    scene = pymeshlab.MeshSet()
    scene.load_new_mesh(str(write_ply(tmp_path / "m.ply", mesh)))
    read = scene.current_mesh()
    np.testing.assert_array_equal(read.vertex_scalar_array().astype(np.float32), mesh.temperature_degC)
    np.testing.assert_array_equal(np.round(read.vertex_color_matrix()[:, :3] * 255), colors(mesh))
    np.testing.assert_array_equal(read.face_matrix(), mesh.surface.triangles)


def test_vtk_reads_vtp(tmp_path):
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    mesh = result()
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(write_vtp(tmp_path / "m.vtp", mesh)))
    reader.Update()
    data = reader.GetOutput()
    np.testing.assert_array_equal(vtk_to_numpy(data.GetPoints().GetData()), mesh.surface.vertices_m)
    cells = vtk_to_numpy(data.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    np.testing.assert_array_equal(cells, mesh.surface.triangles)
    for name in PER_VERTEX:
        np.testing.assert_array_equal(vtk_to_numpy(data.GetPointData().GetArray(name)), getattr(mesh, name))
    assert data.GetPointData().GetScalars().GetName() == "temperature_degC"
    np.testing.assert_array_equal(vtk_to_numpy(data.GetPointData().GetNormals()), mesh.surface.normals)
    description = json.loads(data.GetFieldData().GetAbstractArray("thermofusion").GetValue(0))
    assert description["metadata"] == mesh.metadata


def node(script: str, path: Path) -> dict:
    """What a script of tests/js prints; the test is skipped where node or its packages are absent."""
    program = shutil.which("node")
    if program is None:
        pytest.skip("node is not installed")
    if not (JS / "node_modules" / "three").is_dir():
        pytest.skip("packages are absent: run `npm ci --prefix tests/js`")
    done = subprocess.run(
        [program, script, str(path)], cwd=JS, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("case", ["all", "some", "none", "bare", "degenerate-normals"])
def test_khronos_validator_finds_nothing(tmp_path, case):
    mesh = result(unmeasured_below_m={"all": -9.0, "none": 9.0}.get(case, 0.0))
    if case == "bare":
        mesh = ThermalMesh.from_temperature(mesh.surface, mesh.temperature_degC)
    if case == "degenerate-normals":
        mesh = replace(mesh, surface=replace(mesh.surface, normals=mesh.surface.normals * np.float32(0)))
    issues = node("validate.mjs", write_glb(tmp_path / "m.glb", mesh))
    assert issues["messages"] == []


def test_three_reads_temperature_and_colour(tmp_path):
    mesh = result()
    got = node("read_three.mjs", write_glb(tmp_path / "m.glb", mesh, "inferno", (28, 33)))
    assert got["extras"]["range_degC"] == [28, 33]
    assert got["extras"]["units"]["_TEMPERATURE"] == "degC"
    assert got["extras"]["level"] == "relative"
    skin, rest = got["meshes"]["skin"], got["meshes"]["unmeasured"]
    assert skin["material"] == "MeshBasicMaterial"  # unlit
    assert skin["doubleSided"]
    assert rest["attributes"] == ["normal", "position"]
    assert skin["triangles"] + rest["triangles"] == len(mesh.surface.triangles)
    temperature, seen = np.array(skin["temperature"], np.float32), np.array(skin["vertices"])
    # glTF: y up, z toward the viewer of the front: world z, and world -y.
    np.testing.assert_allclose(temperature, 30 + 30 * seen[:, 1], atol=1e-4)
    assert {tuple(np.round(p, 6)) for p in seen} <= {
        tuple(np.round(p, 6)) for p in (mesh.surface.vertices_m[:, [0, 2, 1]] * [1, 1, -1]).astype(np.float64) + 0.0
    }
    linear = np.array(skin["linear"])
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    assert np.abs(srgb * 255 - apply(temperature, "inferno", 28, 33)).max() < 1  # PLY's colours


def test_glb_leaves_incomplete_columns_out(tmp_path):
    mesh = result()
    holes = mesh.uncertainty_K.copy()
    holes[np.flatnonzero(mesh.measured)[7]] = np.nan
    back = read_glb(write_glb(tmp_path / "m.glb", replace(mesh, uncertainty_K=holes)))
    assert np.isnan(back.uncertainty_K).all()
    assert not np.isnan(back.view_angle_deg[back.measured]).any()
    assert b'"omitted":["_UNCERTAINTY"]' in (tmp_path / "m.glb").read_bytes()


def colors(mesh: ThermalMesh) -> np.ndarray:
    return apply(mesh.temperature_degC, "inferno", *color_range(mesh.temperature_degC))


def test_linear_light_is_the_standards():
    # IEC 61966-2-1, independent values: 0.5 -> 0.21404, 10/255 in the linear toe.
    np.testing.assert_allclose(
        srgb_to_linear(np.array([0, 10, 128, 255], np.uint8)), [0, 0.0030353, 0.2158605, 1], atol=1e-6
    )


# ---------------------------------------------------------------- axes


@pytest.mark.parametrize("pitch_deg", [-25.0, 0.0, 20.0])
def test_up_and_front_from_a_walk_round(pitch_deg):
    """Cameras on a circle, pitched and trembling in roll, in a world that lies anyhow."""
    rng = np.random.default_rng(1)
    tilt = Rotation.from_euler("xyz", [70, -20, 130], degrees=True).as_matrix()
    poses = []
    for turn in np.radians(np.linspace(0, 300, 60)):
        eye = np.array([np.sin(turn), -np.cos(turn), 0.3])
        forward = np.array([-np.sin(turn), np.cos(turn), np.tan(np.radians(pitch_deg))])
        z = forward / np.linalg.norm(forward)
        x = np.cross(z, [0, 0, 1])
        x /= np.linalg.norm(x)
        level = np.stack([x, np.cross(z, x), z], axis=1)
        roll = Rotation.from_euler("z", rng.normal(0, 2), degrees=True).as_matrix()
        poses.append(pose(tilt @ level @ roll, tilt @ eye))
    R = axes_of(view_axes(np.stack(poses), [0, 0, 0]))
    np.testing.assert_allclose(np.linalg.det(R), 1)
    angle = lambda a, b: np.degrees(np.arccos(np.clip(a @ b, -1, 1)))  # noqa: E731
    assert angle(R[1], tilt @ [0, 0, 1]) < 1.0
    assert angle(R[2], tilt @ [0, -1, 0]) < 1.5


def test_axes_without_a_walk():
    one = np.eye(4)[None]
    np.testing.assert_allclose(axes_of(view_axes(one, [0, 0, 1.5])), [[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    np.testing.assert_allclose(axes_of({}), axes_of({"up": "0 -1 0", "front": "nonsense"}))
    floor = view_axes(one, [0, 0.2, 1.5], floor_normal=[0, 0.99, 0.1])  # given upside down
    assert axes_of(floor)[1] @ [0, -1, 0] > 0.99
    assert np.isfinite(axes_of({"up": "0 0 -1"})).all()  # front along up


# ---------------------------------------------------------------- speed, documentation


def test_speed_at_full_size(tmp_path):
    surface = sphere(400, 500)
    mesh = result(surface)
    for write, bound_s in ((write_ply, 0.3), (write_glb, 0.5), (write_vtp, 0.3)):
        took = []
        for _ in range(2):
            start = time.process_time()
            write(tmp_path / "m", mesh)
            took.append(time.process_time() - start)
        assert min(took) < bound_s, f"{write.__name__}: {took} s for {len(surface)} vertices"


def test_documented_names_are_the_writers():
    text = DOCS.read_text(encoding="utf-8")
    rows = [re.findall(r"`([^`]+)`", line) for line in text.splitlines() if line.startswith("| `")]
    documented = {tuple(row[:3]) for row in rows if len(row) >= 3 and row[1].startswith("scalar_")}
    assert documented == {(c.field, c.ply, c.glb) for c in KNOWN}
    for c in KNOWN:
        line = next(line for line in text.splitlines() if line.startswith(f"| `{c.field}`"))
        assert f"| {c.unit} |" in line
    for flag in VertexFlag:
        assert f"| {flag.value} | `{flag.name}` |" in text
    for word in ("quality", "vertex_indices", "_TEMPERATURE", "COLOR_0", "KHR_materials_unlit", "extras.thermofusion"):
        assert f"{word}" in text


def test_no_warning_is_raised_by_writing(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        empty = SurfaceMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
        mesh = ThermalMesh.from_temperature(empty, np.zeros(0))
        for write, read in ((write_ply, read_ply), (write_vtp, read_vtp)):
            assert len(read(write(tmp_path / "m", mesh))) == 0
