"""Folders of depth and colour images, whatever made them: PNG, PGM, TIFF, NPY, raw; integers, shifted bits, floats."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import MAX_PIXELS, claimed_size, decode_image, read_bytes
from ...types import Camera, Float, Float32, Scan, Stream, Trajectory
from ..common import NO_TIMES, ImageFiles, image_stream, make_camera, make_rig, make_stream
from ..naming import Named
from ..stated import Stated

DEPTH_SUFFIXES = (".png", ".pgm", ".tif", ".tiff", ".npy", ".raw", ".bin")
COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp", ".tif", ".tiff")
HEADERLESS = (".raw", ".bin")
NO_DEPTH = (0, 65535)  # what programs store where they measured nothing
FLOAT_UNIT_M = 0.00025  # float depth is written as 16-bit steps of this: below any camera's noise, and reaches 16 m
MAX_METRES = 100.0  # a float image whose median is above holds millimetres
SHIFT_BITS = 3  # of the Kinect SDK's player index, and of SUN3D's rotation
SIZE_HINT = "give --size WIDTHxHEIGHT, or put a rig.json with cameras.depth beside it"


@dataclass(frozen=True)
class DepthLayout:
    """What a stored depth pixel is.

    unit_m : metres a step. shifted : the low three bits hold a player index; rotated : they are depth's own high bits
    (SUN3D). stored_unit_m : what it is written in, should the scan be written. notes : what was found.
    """

    unit_m: float
    shifted: bool = False
    rotated: bool = False
    stored_unit_m: float = 0.001
    notes: tuple[str, ...] = ()

    def metres(self, raw: NDArray, place: object) -> Float32:
        """A stored image (H, W) in metres, NaN = none. Raises ScanError for pixels that are no depth."""
        if raw.ndim != 2 or (raw.dtype != np.uint16 and raw.dtype.kind != "f"):
            raise ScanError(
                f"depth is {raw.dtype} with {raw.ndim} axes, expected 16-bit grey or float",
                place=place,
                hint="a coloured or 8-bit picture of depth has lost its distances: export 16-bit depth",
            )
        if raw.dtype.kind == "f":
            with np.errstate(over="ignore", invalid="ignore"):  # damaged numbers are no depth
                z = raw.astype(np.float32) * np.float32(self.unit_m)
            return np.where(np.isfinite(z) & (z > 0), z, np.float32(np.nan))
        none = np.isin(raw, NO_DEPTH)
        value = raw >> SHIFT_BITS if self.shifted or self.rotated else raw
        if self.rotated:
            value = value | (raw << (16 - SHIFT_BITS))
        z = value.astype(np.float32) * np.float32(self.unit_m)
        z[none | (value == 0)] = np.nan
        return z


def depth_layout(
    samples: Sequence[NDArray], stated: Stated, own_unit_m: float | None, *, rotates: bool = False
) -> DepthLayout:
    """What the depth images are, from some of them (H, W), from what was said, and from the recording's own unit.

    own_unit_m : metres a step by a file of the recording or by its format; None = nobody says: millimetres, float
    metres. A step of depth that was stated is obeyed; shifted bits are recognised only where none is. rotates : the
    layout is one whose shifted bits are rotated.
    """
    values = np.concatenate([s[np.isfinite(s) & (s > 0)].ravel() for s in samples])
    if samples[0].dtype.kind == "f":
        median = float(np.median(values)) if values.size else 0.0
        unit = stated.unit_m(own_unit_m or (0.001 if median > MAX_METRES else 1.0))
        note = f"float depth is taken as {'metres' if unit == 1 else 'millimetres' if unit == 0.001 else f'{unit:g} m'}"
        return DepthLayout(unit, stored_unit_m=FLOAT_UNIT_M, notes=(note,))
    if own_unit_m is not None and stated.names_unit and stated.depth_unit_m is None:
        _check_unit(own_unit_m, stated)
    if own_unit_m is not None or stated.names_unit:
        unit = stated.unit_m(own_unit_m or 0.001)
        return DepthLayout(unit, stored_unit_m=unit)
    if all(_shifted(s) for s in samples):
        note = "the low three bits of depth hold no depth (Kinect SDK's player index, or rotated bits): shifted back"
        return DepthLayout(0.001, shifted=not rotates, rotated=rotates, notes=(note,))
    return DepthLayout(0.001, notes=("depth is taken as millimetres",))


def _check_unit(own_unit_m: float, stated: Stated) -> None:
    """ScanError where the rig's step of depth is not the one that the recording itself states."""
    said = stated.unit_m(own_unit_m)
    if abs(said / own_unit_m - 1) > 0.01:
        text = f"key 'cameras.depth.depth_unit_m': {said:g} m a step, but the recording says {own_unit_m:g}"
        raise ScanError(text, place=stated.rig_path, hint="give --depth-unit, or leave the key out")


def _shifted(raw: NDArray) -> bool:
    """Low three bits without noise, under a range of many values: an honest sensor's low bits change all over."""
    if raw.dtype != np.uint16 or raw.ndim != 2:
        return False
    good = ~np.isin(raw, NO_DEPTH)
    low, both = raw & 7, good[:, 1:] & good[:, :-1]
    if both.sum() < 100 or len(np.unique(raw[good] >> 3)) < 32 or len(np.unique(low[good])) > 3:
        return False
    return bool((low[:, 1:] == low[:, :-1])[both].mean() > 0.95)


def read_depth(path: Path, size: tuple[int, int] | None = None) -> NDArray:
    """A depth image as stored, (H, W) uint16 or float; size : (width, height) px of a file without a header.

    Raises ScanError.
    """
    data = read_bytes(path, "depth")
    if path.suffix.lower() in HEADERLESS:
        return _headerless(data, size, path)
    if data[:6] == b"\x93NUMPY":
        return read_npy(data, path)
    return decode_image(data, shape=None, kind="depth", place=path)


def read_npy(data: bytes, place: object) -> NDArray:
    """An array of a .npy file, native byte order; objects are refused. Raises ScanError."""
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as e:  # whatever NumPy makes of a damaged header
        raise ScanError(f"it cannot be read as NPY ({type(e).__name__})", place=place) from None
    if array.dtype.kind not in "fiu" or not 2 <= array.ndim <= 3 or array.size == 0:
        raise ScanError(f"it holds {array.dtype} with {array.ndim} axes, expected numbers (H, W)", place=place)
    if array.dtype.kind in "iu" and array.dtype != np.uint16 and array.min() >= 0 and array.max() <= 65535:
        array = array.astype(np.uint16)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _headerless(data: bytes, size: tuple[int, int] | None, place: object) -> NDArray:
    """Pixels without a header: uint16 or float32 by their number of bytes, little-endian."""
    if size is None:
        raise ScanError(f"raw depth of {len(data)} bytes does not say its size", place=place, hint=SIZE_HINT)
    w, h = size
    kind = {2 * w * h: "<u2", 4 * w * h: "<f4"}.get(len(data))
    if kind is None or w * h > MAX_PIXELS:
        text = f"{len(data)} bytes are no {w} x {h} px of 16-bit or float depth"
        raise ScanError(text, place=place, hint=SIZE_HINT)
    return np.frombuffer(data, kind).reshape(h, w).astype(kind[1:])


def sample_depth(named: Named, size: tuple[int, int] | None) -> list[NDArray]:
    """First, middle and last depth image (H, W) as stored."""
    files = named.files
    return [read_depth(files[i], size) for i in sorted({0, len(files) // 2, len(files) - 1})]


def depth_stream(named: Named, camera: Camera, layout: DepthLayout, size: tuple[int, int] | None = None) -> Stream:
    """The depth images of a folder, decoded when asked for."""

    def load(i: int) -> Float32:
        raw = read_depth(named.files[i], size)
        if raw.shape[:2] != camera.shape:
            text = f"the depth is {raw.shape[1]} x {raw.shape[0]} px, expected {camera.width_px} x {camera.height_px}"
            raise ScanError(text, place=named.files[i])
        return layout.metres(raw, named.files[i])

    places = [str(f) for f in named.files]
    return make_stream(named.stamps, load, places, place=named.files[0].parent, kind="depth", index=named.index)


def color_stream(named: Named, camera: Camera, times_s: Float | None = None) -> Stream:
    """The colour images of a folder; times_s : (N,) where they are not those of the names."""
    times = named.stamps if times_s is None else times_s
    files = ImageFiles("color", named.files, times, named.files[0].parent, named.index)
    return image_stream(files, camera)


def color_camera(
    named: Named, depth: Camera, stated: Stated, scaled: bool = False
) -> tuple[Camera | None, tuple[str, ...]]:
    """The camera of a folder's colour images, and notes: the rig's, or depth's where the images are as large.

    scaled : the images are known to show what depth shows, at another size. None: nobody knows the camera.
    """
    size = claimed_size(read_bytes(named.files[0], "color"), named.files[0])
    if size is None:
        raise ScanError("the color file is no image of a known kind", place=named.files[0])
    own = stated.camera("color")
    if own is not None:
        if (own.width_px, own.height_px) != size:
            text = (
                f"key 'cameras.color': {own.width_px} x {own.height_px} px, but the images have {size[0]} x {size[1]}"
            )
            raise ScanError(text, place=stated.rig_path)
        return own, ()
    if size == (depth.width_px, depth.height_px):
        return depth, ("depth is taken as registered to colour (T_color_depth = identity)",)
    if scaled:
        return resized(depth, size, named.files[0]), ()
    text = f"colour ({size[0]} x {size[1]} px) is left out: its camera is not known; a rig.json with cameras.color"
    return None, (f"{text} and extrinsics.T_color_depth brings it in",)


@dataclass(frozen=True, eq=False)
class Folder:
    """Depth and colour images of a recording, and what was said of it.

    format : the reader's name. size : (width, height) px of depth files without a header.
    """

    path: Path
    format: str
    stated: Stated
    depth: Named
    color: Named
    size: tuple[int, int] | None = None

    def scan(
        self, camera: Camera, layout: DepthLayout, *, trajectory: Trajectory | None = None, notes: Sequence[str] = ()
    ) -> Scan:
        """All of it as a scan, its colour where that camera is known. camera : depth's. Raises ScanError."""
        seen, more = color_camera(self.color, camera, self.stated) if self.color.files else (None, ())
        untimed = self.depth.times_s is None
        return Scan(
            name=self.path.resolve().name,
            root=self.path,
            format=self.format,
            rig=make_rig(camera, seen, place=self.path),
            depth=depth_stream(self.depth, camera, layout, self.size),
            color=None if seen is None else color_stream(self.color, seen),
            trajectory=trajectory,
            depth_unit_m=layout.stored_unit_m,
            notes=(*([NO_TIMES] if untimed else []), *layout.notes, *notes, *more),
            times_assumed=untimed,
        )


def resized(camera: Camera, size: tuple[int, int], place: object) -> Camera:
    """The same view at another size (width, height) px, scaled as the programs do whose formats need it: plainly."""
    sx, sy = size[0] / camera.width_px, size[1] / camera.height_px
    K = camera.K.copy()
    K[0, 0], K[1, 1] = K[0, 0] * sx, K[1, 1] * sy
    K[0, 2], K[1, 2] = K[0, 2] * sx, K[1, 2] * sy
    return make_camera(size[0], size[1], K, camera.distortion, place=place)
