"""Record3D recordings (.r3d): a zip of metadata, rgbd/N.jpg, N.depth and N.conf (LZFSE; float metres, bytes).

Layout as nerfstudio's record3d_utils reads it: K by columns for the colour size, poses `qx qy qz qw x y z` of ARKit's
camera. LZFSE is decoded by `liblzfse` where it is installed; blocks that are stored as they are need nothing.
"""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....errors import ScanError
from ....files.reading import COPY_AGAIN, MAX_FILE_BYTES, decode_image, parse_json
from ....files.tum import poses_of, poses_to_trajectory
from ....types import Scan
from ...common import as_loaded, make_camera, make_rig, make_stream
from ...stated import NOTHING, Stated
from ..images import FLOAT_UNIT_M, DepthLayout, resized
from . import from_opengl, trusted


def recognise(path: Path) -> bool:
    """A file named .r3d that is a zip."""
    return path.suffix.lower() == ".r3d" and path.is_file() and zipfile.is_zipfile(path)


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a file as a scan. Raises ScanError."""
    meta = _metadata(path)
    try:
        color = make_camera(int(meta["w"]), int(meta["h"]), np.array(meta["K"], float).reshape(3, 3).T, place=path)
        size = (int(meta["dw"]), int(meta["dh"]))
        rows = np.array(meta["poses"], np.float64).reshape(-1, 7)
        times = meta.get("frameTimestamps")
        times = np.arange(len(rows)) / float(meta["fps"]) if times is None else np.array(times, np.float64)[: len(rows)]
    except (KeyError, TypeError, ValueError):
        raise ScanError("'metadata' lacks w, h, dw, dh, K or poses", place=path) from None
    n, layout = len(times), DepthLayout(stated.unit_m(1.0))
    camera = stated.camera("depth") or resized(color, size, path)
    T = poses_of(np.roll(rows, 3, axis=1))  # the position first
    places = [f"{path}, frame {i}" for i in range(n)]

    def depth(i: int) -> NDArray:
        z = np.frombuffer(_block(path, f"rgbd/{i}.depth", 4 * size[0] * size[1]), "<f4").reshape(size[1], size[0])
        sure = _block(path, f"rgbd/{i}.conf", size[0] * size[1], needed=False)
        confidence = np.frombuffer(sure, np.uint8).reshape(size[1], size[0]) if sure else None
        return layout.metres(trusted(z, confidence), places[i])

    def picture(i: int) -> NDArray:
        image = decode_image(_member(path, f"rgbd/{i}.jpg"), shape=color.shape, kind="color", place=places[i])
        return as_loaded("color", image, places[i], 1.0)

    return Scan(
        name=path.stem,
        root=path,
        format="record3d",
        rig=make_rig(camera, color, place=path),
        depth=make_stream(times, depth, places, place=path, kind="depth"),
        color=make_stream(times, picture, places, place=path, kind="color"),
        trajectory=poses_to_trajectory(times, from_opengl(T), place=path),
        depth_unit_m=FLOAT_UNIT_M,
        notes=("depth that the phone does not trust at all is left out",),
    )


def _metadata(path: Path) -> Any:
    return parse_json(_member(path, "metadata").decode("utf-8", "replace"), f"{path}: metadata")


def _member(path: Path, name: str, *, needed: bool = True) -> bytes:
    try:
        with zipfile.ZipFile(path) as z:
            if z.getinfo(name).file_size > MAX_FILE_BYTES:
                raise ScanError(f"'{name}' is too large", place=path)
            return z.read(name)
    except KeyError:
        if not needed:
            return b""
        raise ScanError(f"there is no '{name}' in it", place=path, hint=COPY_AGAIN) from None
    except (zipfile.BadZipFile, OSError, EOFError, RuntimeError) as e:
        raise ScanError(f"'{name}' cannot be read ({e})", place=path, hint=COPY_AGAIN) from None


def _block(path: Path, name: str, size: int, *, needed: bool = True) -> bytes:
    """A member that is LZFSE, decoded to `size` bytes."""
    packed = _member(path, name, needed=needed)
    data = _unpacked(packed, f"{path}: {name}") if packed else b""
    if len(data) != size and (needed or data):
        raise ScanError(f"'{name}' holds {len(data)} bytes, expected {size}", place=path, hint=COPY_AGAIN)
    return data


def _unpacked(data: bytes, place: object) -> bytes:
    if data[:4] == b"bvx-":  # stored as it is
        (n,) = struct.unpack_from("<I", data, 4)
        return data[8 : 8 + n]
    try:
        import liblzfse
    except ImportError:
        hint = "pip install 'thermofusion[record3d]'"
        raise ScanError("depth is LZFSE, and `liblzfse` is not installed", place=place, hint=hint) from None
    try:
        return bytes(liblzfse.decompress(data))
    except Exception as e:  # the library's own error, whatever the bytes
        raise ScanError(f"LZFSE cannot be decoded ({type(e).__name__})", place=place, hint=COPY_AGAIN) from None
