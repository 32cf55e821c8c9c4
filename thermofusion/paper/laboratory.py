"""The authors' own recordings as they left them: the heated cylinder's frames, and the face with its calibration.

Cylinder: Merlin camera, 3-5 µm, 240 bytes of header, then 256 x 320 big-endian counts. Beside each frame lies the
authors' mean temperature image; it gives the curve counts -> °C, which nobody recorded. Face: one Kinect and one
thermal picture, and a polynomial per pixel that evens the thermal camera's field.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from ..errors import ScanError
from ..physics.band import ZERO_DEGC_K
from ..physics.signal import SignalConverter
from ..scans import open_scan
from ..types import Float, Float32, Scan, SignalCurve

SHAPE, HEADER_BYTES = (256, 320), 240  # px, rows and columns; the Merlin's raw format
CURVE_DEGREE = 4  # of counts -> °C, as in the paper's Eq. 1
COUNTS_MIDDLE, COUNTS_SPAN = 45_000, 10_000  # make the abscissa of the curve of order 1
WALL_PX = (slice(0, 140), np.r_[0:190, 450:632])  # rows, columns of the thermal picture that show the wall alone
FACE_ROOM_DEGC = 23.0  # the paper's T_a
BILATERAL = (13, 0.010, 3.5)  # window [px], depth [m], width [px] of the smoothing of a single depth frame


@dataclass(frozen=True, eq=False)
class Frame:
    """One temperature of the cylinder.

    water_degC : of the water inside. counts : (256, 320). authors_degC : their mean image. degC : (256, 320) from the
    counts through the fitted curve. curve_rms_K : how well the curve reproduces the authors' image.
    """

    water_degC: int
    counts: NDArray[np.uint16]
    authors_degC: Float
    degC: Float
    curve_rms_K: float


def read_frame(folder: Path, water_degC: int) -> Frame:
    """`TT.raw` with `Aver_ImT_TT.mat`. Raises ScanError if one is missing or has another size."""
    raw, mat = folder / f"{water_degC}.raw", folder / f"Aver_ImT_{water_degC}.mat"
    try:
        data, variables = raw.read_bytes(), loadmat(mat)
    except (OSError, ValueError) as e:
        raise ScanError(f"a frame of the phantom cannot be read ({e})", place=raw) from None
    pixels = SHAPE[0] * SHAPE[1]
    if len(data) < HEADER_BYTES + 2 * pixels:
        raise ScanError(f"expected {HEADER_BYTES} bytes and {pixels} counts, got {len(data)} bytes", place=raw)
    counts = np.frombuffer(data, ">u2", pixels, HEADER_BYTES).reshape(SHAPE).astype(np.uint16)
    images = [np.asarray(v, np.float64) for k, v in variables.items() if not k.startswith("_")]
    if len(images) != 1 or images[0].shape != SHAPE:
        raise ScanError(f"expected one image of {SHAPE[1]} x {SHAPE[0]}", place=mat)
    x = (counts.astype(np.float64) - COUNTS_MIDDLE) / COUNTS_SPAN
    degC = np.asarray(np.polyval(np.polyfit(x.ravel(), images[0].ravel(), CURVE_DEGREE), x), np.float64)
    return Frame(water_degC, counts, images[0], degC, float(np.sqrt(((degC - images[0]) ** 2).mean())))


def open_face(folder: Path, radiometry: Path) -> tuple[Scan, float]:
    """The face, its field evened and its depth smoothed; and the thermal picture's shift, K. Raises ScanError."""
    flat, shift_K = _evened(open_scan(folder), radiometry)
    return _smoothed(flat), shift_K


def first_picture_degC(scan: Scan) -> Float:
    """(H, W) apparent temperature of a scan's first thermal frame, °C. Raises ScanError."""
    assert scan.thermal is not None
    converter = SignalConverter(scan.thermal.camera)
    return converter.band.temperature_K(converter.radiance(scan.thermal.load(0)).astype(np.float64)) - ZERO_DEGC_K


def _evened(scan: Scan, radiometry: Path) -> tuple[Scan, float]:
    """With the authors' per-pixel field added and the room's level set; and that level's shift, K.

    The field z1 + z2 T + z3 T² + z4 T³ (their calibration of 1 March) is *added*: subtracted, it makes the wall behind
    the person less even instead of more. The camera's own level drifts; the wall is at room temperature, so the
    picture is shifted until it reads that.
    """
    assert scan.thermal is not None
    z = [np.asarray(loadmat(radiometry / f"0301_z{i}.mat")[f"z{i}"], np.float64) for i in (1, 2, 3, 4)]
    T = first_picture_degC(scan)
    flat = T + z[0] + T * (z[1] + T * (z[2] + T * z[3]))
    shift_K = FACE_ROOM_DEGC - float(np.nanmedian(flat[WALL_PX]))
    image = (flat + shift_K).astype(np.float32)
    camera = replace(scan.thermal.camera, signal=SignalCurve())
    return replace(scan, thermal=replace(scan.thermal, load=lambda i: image, camera=camera)), shift_K


def _smoothed(scan: Scan) -> Scan:
    """With each depth frame smoothed twice by a bilateral filter.

    A single Kinect frame has steps of 3.5 mm at 1.1 m, which make normals worthless; the paper's ReconstructMe averaged
    many frames. Steps between surfaces (1 cm) stay.
    """

    def load(i: int) -> Float32:
        depth = scan.depth.load(i)
        measured = np.isfinite(depth)
        z = np.where(measured, depth, 0).astype(np.float32)
        for _ in range(2):
            z = np.where(measured, cv2.bilateralFilter(z, *BILATERAL), 0).astype(np.float32)
        return np.where(measured, z, np.float32(np.nan))

    return replace(scan, depth=replace(scan.depth, load=load))
