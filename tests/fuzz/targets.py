"""What is fuzzed: small valid inputs, made here, and for each what reads it."""

from __future__ import annotations

import base64
import io
import json
import shutil
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
from support import foreign, result_maker
from support import scan_maker as make
from support.fake_device import Steady

from thermofusion.calibration.board.board import Board
from thermofusion.calibration.board.picks import read_picks_csv, read_picks_mat
from thermofusion.calibration.folder import open_folder
from thermofusion.calibration.rig_file import read_rig
from thermofusion.calibration.thermal.blackbody import read_curve, read_field, read_readings
from thermofusion.cli import main
from thermofusion.errors import visible
from thermofusion.export.csv import read_csv, write_csv
from thermofusion.export.glb import write_glb
from thermofusion.export.ply import write_ply
from thermofusion.export.vtp import write_vtp
from thermofusion.files.pnm import read_pnm
from thermofusion.files.reading import decode_image
from thermofusion.files.tum import read_trajectory
from thermofusion.judge.compare import load_temperatures
from thermofusion.judge.contacts import read_contacts
from thermofusion.recipe import load_recipe
from thermofusion.recording.record import Beside, Until, record
from thermofusion.results.artifacts import load_artifact, load_note, save_artifact
from thermofusion.scans import open_scan, with_rig
from thermofusion.scans.check import verify
from thermofusion.scans.native.write import write_scan
from thermofusion.scans.thermal import flir, read_thermal

RNG = np.random.default_rng(3)
K = [[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]
T = [[1.0, 0, 0, 0.02], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@dataclass(frozen=True)
class Target:
    """A reader. seeds : valid inputs by file name. attempt : reads (name, bytes). weight : its share of the tries."""

    name: str
    seeds: dict[str, bytes]
    attempt: Callable[[str, bytes], object]
    weight: float = 1


def targets(scratch: Path) -> Iterator[Target]:
    """All of them; scratch : an empty folder for the files."""
    yield Target("image", _images(), lambda name, data: _decode(data), 4)
    yield Target("flir", _flir(), _in_file(scratch / "flir", _read_flir), 3)
    yield _folder("native", scratch, _native, _open_native, 8)
    for name, build in (("tum", _tum), ("redwood", _redwood), ("7-scenes", _seven_scenes), ("apc", _shelf)):
        yield _folder(name, scratch, build, _open_foreign, 2)
    for name in ("record3d", "stray", "polycam", "rtabmap", "sens", "bop", "rs-convert", "ros"):
        yield _folder(name, scratch, partial(_makers, name), _open_maker)
    yield Target("frames", _frames(), _in_file(scratch / "frames", _read_frames), 3)
    yield _folder("fakenect", scratch, _fakenect, _open_foreign)
    yield _folder("recording", scratch, _recording, _open_foreign, 2)
    yield Target("mkv", {"take.mkv": _mkv()}, _in_file(scratch / "mkv", _open_mkv), 2)
    yield Target("trajectory", {"t.txt": b"# time\n0 0 0 0 0 0 0 1\n0.5 0.1 0 0 0 0 0 1\n"},
                 _in_file(scratch / "poses", read_trajectory), 2)  # fmt: skip
    yield Target("mesh", _meshes(scratch / "meshes"), _in_file(scratch / "mesh", _read_mesh), 5)
    yield Target("artifact", _artifacts(scratch / "artifacts"), _in_file(scratch / "artifact", _read_artifact), 4)
    yield Target("recipe", {"r.toml": _recipe()}, _in_file(scratch / "recipe", load_recipe), 3)
    yield Target("override", {"set": b"surface.voxel_mm=4.5"}, lambda name, data: _override(data))
    yield Target("truth", {"truth.npz": _truth(scratch)}, _in_file(scratch / "truth", load_temperatures), 3)
    yield Target("contacts", _contacts(), _in_file(scratch / "contacts", read_contacts), 3)
    yield Target("picks", _picks(scratch), _in_file(scratch / "picks", _read_picks), 3)
    yield _folder("calibration", scratch, _calibration, lambda root, name: open_folder(root), 2)
    yield _folder("rig", scratch, _rig, _open_rig, 3)
    yield Target("thermal", _thermal(scratch), _in_file(scratch / "thermal", _read_thermal), 2)
    yield _folder("verb-check", scratch, _native, lambda root, name: _verb("check", str(root)), 0.3)
    yield Target("verb-compare", _meshes(scratch / "compared"), _in_file(scratch / "verb", _compare(scratch)), 0.3)
    yield Target("names", {"name": "Müller 01".encode()}, _Named(scratch / "names"))


# ---------------------------------------------------------------- how an input reaches its reader


def _in_file(folder: Path, read: Callable[[Path], object]) -> Callable[[str, bytes], object]:
    folder.mkdir()

    def attempt(name: str, data: bytes) -> object:
        path = folder / name
        path.write_bytes(data)
        return read(path)

    return attempt


def _folder(
    name: str, scratch: Path, build: Callable[[Path], object], read: Callable[[Path, str], object], weight: float = 1
) -> Target:
    """A folder of which one file at a time is changed, and put back afterwards."""
    root = scratch / name
    root.mkdir()
    build(root)
    seeds = {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}

    def attempt(file: str, data: bytes) -> object:
        try:
            (root / file).write_bytes(data)
            return read(root, file)
        finally:
            (root / file).write_bytes(seeds[file])

    return Target(name, seeds, attempt, weight)


class _Named:
    """A recording whose folder, or whose own name, is anything."""

    def __init__(self, scratch: Path) -> None:
        self._scratch = scratch
        scratch.mkdir()
        _tum(scratch / "rgbd")
        write_scan(make.tiny_scan(), scratch / "native")

    def __call__(self, name: str, data: bytes) -> object:
        tree = json.loads((self._scratch / "native" / "scan.json").read_text())
        tree["name"] = data.decode("utf-8", "surrogateescape")
        (self._scratch / "native" / "scan.json").write_text(json.dumps(tree))
        link = bytes(self._scratch) + b"/" + (data.replace(b"/", b"_").replace(b"\0", b"_")[:200] or b"x") + b"~"
        path = Path(link.decode("utf-8", "surrogateescape"))
        shutil.copytree(self._scratch / "rgbd", path)
        try:
            scans = open_scan(path), open_scan(self._scratch / "native")
        finally:
            shutil.rmtree(path)
        assert all(visible(s.name) == s.name for s in scans)
        return scans


# ---------------------------------------------------------------- images and containers


def _images() -> dict[str, bytes]:
    grey = RNG.integers(900, 1100, (12, 16)).astype(np.uint16)
    color = RNG.integers(0, 255, (12, 16, 3)).astype(np.uint8)
    pictures = {"a.png": grey, "b.png": color, "c.jpg": color, "d.tiff": grey, "e.tiff": grey.astype(np.float32)}
    seeds = {name: cv2.imencode(Path(name).suffix, image)[1].tobytes() for name, image in pictures.items()}
    return seeds | {"f.pgm": make.write_pnm(grey), "g.ppm": make.write_pnm(color), "h.pgm": b"P5 #a\n 2 2 255\n0000"}


def _decode(data: bytes) -> None:
    decode_image(data, shape=None, kind="depth", place="x")
    if data[:1] == b"P":
        read_pnm(data, place="x", byteorder="<")


def _flir() -> dict[str, bytes]:
    block = make.flir_block(np.full((12, 16), 15000, np.uint16))
    packed = make.flir_block(np.full((12, 16), 15000, np.uint16), png=True)
    return {"a.jpg": make.flir_jpeg(block), "b.jpg": make.flir_jpeg(packed), "c.seq": 2 * block}


def _read_flir(path: Path) -> object:
    flir.recognise(path)
    return _read_frames(path)


def _frames() -> dict[str, bytes]:
    """Thermal files of other makers, each as small as its layout allows."""
    kelvin = RNG.integers(28000, 31000, (120, 160)).astype("<u2")
    tjsn = {"metadata": {"Date": "1/1/26", "Time": "12:00:00.0"}, "radiometric": base64.b64encode(kelvin).decode()}
    irg = struct.pack("<HHIHH", 0xACCA, 128, 192, 16, 12).ljust(128, b"\0") + bytes(192) + bytes(range(192)) * 2
    table = np.linspace(280, 310, 256).astype("<f4").tobytes()
    irb = b"\xffIRB\0".ljust(25, b"\0") + struct.pack("<ii", 64, 1)
    irb = irb.ljust(64, b"\0") + struct.pack("<iiiii", 1, 0, 0, 96, 2208).ljust(32, b"\0")
    irb += struct.pack("<HHHH", 2, 0, 16, 15).ljust(60, b"\0") + table + bytes(644) + bytes(range(240)) * 2
    tiff = cv2.imencodemulti(".tiff", [np.full((6, 7), 20, np.float32)] * 2)[1].tobytes()
    np.save(npy := io.BytesIO(), np.full((2, 3, 4), 21, np.float32))
    csv = "Temperature [°C]\n21,5;22;23;24\n21;22;23,5;24\n".encode()
    return {"a.tjsn": json.dumps(tjsn).encode(), "b.irg": irg, "c.irb": irb, "d.tiff": tiff, "e.npy": npy.getvalue(),
            "f.csv": csv}  # fmt: skip


def _read_frames(path: Path) -> object:
    frames = read_thermal(path)
    return [frames.apparent_degC(i) for i in range(len(frames))]


def _makers(name: str, root: Path) -> None:
    """A recording of another maker as the import tests write it, beside nothing else."""
    shutil.rmtree(root)
    foreign.WRITERS[name][0](root)


def _open_maker(root: Path, name: str) -> None:
    inside = [f for f in root.iterdir() if f.suffix in (".r3d", ".db", ".sens")]
    _open_foreign(inside[0] if inside else root, name)


def _recording(root: Path) -> None:
    """recording.mcap with eight small frames of two streams."""
    warm = {"kind": "counts", "curve": {"type": "linear_kelvin", "gain_K": 0.01, "offset_K": 250.0}}
    heat = partial(Steady, "heat", "thermal", 500.0, 8, signal=warm)
    thermal = {"width_px": 64, "height_px": 48, "K": K}
    rig = {"cameras": {"thermal": thermal}, "extrinsics": {"T_thermal_depth": T}}
    beside = Beside({"environment": {"air_degC": 21.0}}, rig)
    record([partial(Steady, rate_hz=500.0, frames=8), heat], root, Until(), beside=beside, own_process=False)


def _mkv() -> bytes:
    depth = RNG.integers(900, 1100, (2, 288, 320)).astype(np.uint16)
    jpeg = [cv2.imencode(".jpg", np.zeros((720, 1280, 3), np.uint8))[1].tobytes()] * 2
    parameters = (0.5, 0.5, 0.5, 0.6, *[0.0] * 10)
    return make.azure_mkv(depth, jpeg, [0, 33], make.calibration_json(parameters, parameters))


def _open_mkv(path: Path) -> None:
    scan = open_scan(path, format="azure-mkv")
    scan.depth.load(len(scan.depth) - 1)


# ---------------------------------------------------------------- recordings


def _native(root: Path) -> None:
    write_scan(make.tiny_scan(), root, overwrite=True)


def _open_native(root: Path, name: str) -> None:
    scan = open_scan(root)
    kind = name.split("/")[0]
    if kind in ("depth", "color", "thermal"):
        getattr(scan, kind).load(int(Path(name).stem))
    else:
        verify(scan, 1)


def _open_foreign(root: Path, name: str) -> None:
    scan = open_scan(root)
    scan.depth.load(0)
    if scan.color is not None:
        scan.color.load(0)


def _png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


DEPTH = (np.arange(48 * 64, dtype=np.uint16) % 500 + 800).reshape(48, 64)
VGA = np.full((480, 640), 1000, np.uint16)


def _tum(root: Path) -> None:
    for i in range(2):
        _png(root / f"depth/{i}.png", VGA)
        _png(root / f"rgb/{i}.png", np.zeros((480, 640, 3), np.uint8))
    for name in ("depth", "rgb"):
        (root / f"{name}.txt").write_text(f"# {name}\n0.1 {name}/0.png\n0.2 {name}/1.png\n")
    (root / "groundtruth.txt").write_text("# t\n0.1 1 2 3 0 0 0 1\n0.2 1 2 3 0 0 0 1\n")


def _redwood(root: Path) -> None:
    for i in range(2):
        _png(root / f"depth/{i}.png", DEPTH)
        _png(root / f"color/{i}.png", np.zeros((48, 64, 3), np.uint8))
    (root / "camera_intrinsic.json").write_text(json.dumps({"intrinsic_matrix": [60, 0, 0, 0, 60, 0, 31, 23, 1]}))
    (root / "trajectory.log").write_text("".join(f"{i} {i} 2\n1 0 0 {i}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" for i in (0, 1)))


def _seven_scenes(root: Path) -> None:
    for i in range(2):
        _png(root / f"frame-{i:06d}.depth.png", DEPTH)
        (root / f"frame-{i:06d}.pose.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    (root / "camera-intrinsics.txt").write_text("60 0 31\n0 60 23\n0 0 1\n")


def _shelf(root: Path) -> None:
    matrix, pose = "60 0 31\n0 60 23\n0 0 1\n", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    titles = (("Color camera intrinsic", matrix), ("Depth camera intrinsic", matrix), ("Depth-to-color", pose))
    titles += tuple((f"frame-{i:06d}", pose) for i in range(2))
    (root / "cam.info.txt").write_text("".join(f"# {title}\n{rows}" for title, rows in titles))
    for i in range(2):
        _png(root / f"frame-{i:06d}.color.png", np.zeros((48, 64, 3), np.uint8))
        for folder in (".", "raw"):
            _png(root / folder / f"frame-{i:06d}.depth.png", DEPTH)


def _fakenect(root: Path) -> None:
    (root / "d-1300000000.0-1000.pgm").write_bytes(make.write_pnm(VGA, "<"))
    (root / "a-1300000000.0-1000.dump").write_bytes(bytes(12))
    (root / "INDEX.txt").write_text("d-1300000000.0-1000.pgm\na-1300000000.0-1000.dump\n")


# ---------------------------------------------------------------- results


def _meshes(folder: Path) -> dict[str, bytes]:
    folder.mkdir()
    mesh = result_maker.result(result_maker.sphere(5, 6))
    for name, write in (("m.ply", write_ply), ("m.glb", write_glb), ("m.vtp", write_vtp), ("m.csv", write_csv)):
        write(folder / name, mesh)
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def _read_mesh(path: Path) -> object:
    return read_csv(path) if path.suffix == ".csv" else load_temperatures(path)


def _artifacts(folder: Path) -> dict[str, bytes]:
    folder.mkdir()
    save_artifact(folder / "mesh.npz", result_maker.result(result_maker.sphere(5, 6)), {"key": "1" * 64, "parts": [1]})
    save_artifact(folder / "dict.npz", {"a": (1, 2.5, None, "x"), "T": make.tiny_scan().trajectory})
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def _read_artifact(path: Path) -> object:
    load_note(path)
    return load_artifact(path)


def _truth(scratch: Path) -> bytes:
    surface = result_maker.sphere(5, 6)
    warm = np.full(len(surface), 33, np.float32)
    np.savez(scratch / "t.npz", vertices_m=surface.vertices_m, triangles=surface.triangles, temperature_degC=warm)
    return (scratch / "t.npz").read_bytes()


def _contacts() -> dict[str, bytes]:
    rows = [{"p_world_m": [0.1, 0, -0.2], "degC": 33.1, "uncertainty_K": 0.1, "name": "knee"}] * 2
    table = b'name, x_m, y_m, z_m, degC, uncertainty_K\na, 0.1, 0, 0.2, 33.1, 0.1\n"b", 0, 0, 0, 32, 0.2\n'
    return {"c.csv": table, "c.json": json.dumps(rows).encode()}


# ---------------------------------------------------------------- through the command line


def _verb(*words: str) -> None:
    """What a user would see: a documented exit code, one sentence for an error, nothing that steers a terminal."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stopped:
        main(list(words))
    code, text = stopped.value.code, out.getvalue() + err.getvalue()
    assert code in (0, 2, 3, 4, 5)
    assert all(visible(line) == line for line in text.split("\n"))
    sentences = [line for line in err.getvalue().splitlines() if line.startswith("error: ")]
    assert words[0] == "check" or len(sentences) == (code != 0)


def _compare(scratch: Path) -> Callable[[Path], None]:
    truth = scratch / "compared.npz"
    truth.write_bytes(_truth(scratch))
    return lambda path: _verb("compare", str(path), str(truth), "--json")


# ---------------------------------------------------------------- calibration, recipes


def _recipe() -> bytes:
    text = load_recipe("torso").to_toml()
    return text.encode()


def _override(data: bytes) -> None:
    load_recipe("torso", [data.decode("utf-8", "surrogateescape")])


def _picks(scratch: Path) -> dict[str, bytes]:
    rows = "".join(f"v1,color,{i},{10 + i}.5,{20 + i}.25\n" for i in range(12))
    grid = np.array([[c * 0.03 for _ in range(3) for c in range(4)], [r * 0.03 for r in range(3) for _ in range(4)]])

    def cells(*items: object) -> np.ndarray:
        out = np.empty((1, len(items)), object)
        for i, item in enumerate(items):
            out[0, i] = item
        return out

    px = np.vstack([np.arange(12.0), np.arange(12.0)])
    content = {
        "rgb_grid_x": cells(cells(np.vstack([grid, np.zeros(12)]))),
        "rgb_grid_p": cells(cells(px), cells(px)),
        "rfiles": cells(cells("a.png")),
        "rsize": cells(np.array([480.0, 640]), np.array([240.0, 320])),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, packed in (("a.mat", False), ("b.mat", True)):
            scipy.io.savemat(scratch / name, content, do_compression=packed)
    seeds = {name: (scratch / name).read_bytes() for name in ("a.mat", "b.mat")}
    return seeds | {"p.csv": ("view,camera,point,u_px,v_px\n" + rows).encode()}


def _read_picks(path: Path) -> object:
    return read_picks_mat(path, 0.03) if path.suffix == ".mat" else read_picks_csv(path, Board("pins", 4, 3, 0.03))


def _calibration(root: Path) -> None:
    _png(root / "color" / "a.png", np.zeros((8, 8), np.uint8))
    board = {"kind": "pins", "columns": 9, "rows": 9, "spacing_m": 0.0762}
    camera = {"width_px": 64, "height_px": 48, "K": K}
    depth = {"unit_m": 0.001, "invalid": [0], "kind": "metric", "camera": camera, "T_depth_color": T}
    tree = {"board": board, "files": {"color": "color/*.png"}, "depth": depth, "picks": "picks.csv", "mirrored": []}
    tree["thermal_raw"] = {"width_px": 632, "height_px": 476, "big_endian": True, "header_bytes": 0}
    (root / "calibration.json").write_text(json.dumps(tree))


def _rig(root: Path) -> None:
    write_scan(make.tiny_scan(), root, overwrite=True)
    stated = json.loads((root / "scan.json").read_text())
    parameters = {"scale": 0.001, "offset_m": 0.002} | {f"field_{i}": 0.001 for i in range(20)}
    tree = {"schema": "thermofusion-rig/1", "cameras": stated["cameras"], "extrinsics": stated["extrinsics"]}
    tree["covariances"] = {"T_thermal_depth": (np.eye(6) * 1e-6).tolist()}
    tree["depth_correction"] = {"model": "metric", "parameters": parameters}
    for path in [p for p in root.rglob("*.json") if p.name != "scan.json"]:
        path.unlink()
    (root / "rig.json").write_text(json.dumps(tree))
    _open_rig.scan = open_scan(root)  # type: ignore[attr-defined]
    shutil.move(root / "rig.json", root.parent / "rig.json")
    for path in list(root.iterdir()):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    shutil.move(root.parent / "rig.json", root / "rig.json")


def _open_rig(root: Path, name: str) -> None:
    with_rig(_open_rig.scan, root / name)  # type: ignore[attr-defined]
    read_rig(root / name).rig()


def _thermal(scratch: Path) -> dict[str, bytes]:
    np.savez_compressed(scratch / "f.npz", z=np.zeros((2, 4, 5), np.float32))
    curve = {"schema": "thermofusion-curve/1", "signal": {"kind": "counts", "curve": {"type": "polynomial",
             "coefficients_degC": [-30, 0.0026, 1.1e-8]}}, "counts_range": [10000, 40000], "residual_K": 0.1,
             "sigma_K": 0.1}  # fmt: skip
    readings = b"counts,degC\n20000,25\n22000,30\n24000,36\n"
    return {
        "f.npz": (scratch / "f.npz").read_bytes(),
        "c.json": json.dumps(curve).encode(),
        "r.csv": readings,
    }


def _read_thermal(path: Path) -> object:
    return {".npz": read_field, ".json": read_curve, ".csv": read_readings}[path.suffix](path)
