"""tCam's recordings of a FLIR Lepton (.tjsn, .tmjsn): JSON with base64 of 16-bit kelvin x 100, or x 10 by telemetry."""

from __future__ import annotations

import base64
import binascii
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import ScanError
from ...files.reading import parse_json, read_text
from .frames import ThermalFrames, joined, one_frame
from .infiray import kelvin_steps

SIZES = {2 * 160 * 120: (120, 160), 2 * 80 * 60: (60, 80)}  # bytes -> (H, W)
SUFFIXES = (".tjsn", ".tmjsn")
END = "\x03"  # between the frames of a .tmjsn
LOW_BELOW = 10_000  # a median below cannot be kelvin x 100 of a room: the camera's low resolution, kelvin x 10


def recognise(path: Path) -> bool:
    """By its name."""
    return path.suffix.lower() in SUFFIXES


def read(path: Path) -> ThermalFrames:
    """The frames of a file. Raises ScanError."""
    texts = [t for t in read_text(path, "thermal").split(END) if t.strip()]
    return joined([f for t in texts if (f := _frame(parse_json(t, path), path)) is not None])


def _frame(tree: Any, path: Path) -> ThermalFrames | None:
    if not isinstance(tree, dict) or ("radiometric" not in tree and "video_info" in tree):
        return None  # the last part of a .tmjsn says how long it is
    try:
        data = base64.b64decode(tree["radiometric"], validate=True)
        shape = SIZES[len(data)]
    except (KeyError, TypeError, ValueError, binascii.Error):
        raise ScanError(
            "expected 'radiometric': base64 of 160 x 120 or 80 x 60 numbers of 16 bits", place=path
        ) from None
    image = np.frombuffer(data, "<u2").reshape(shape).astype(np.uint16)
    per_K = 10 if np.median(image) < LOW_BELOW else 100
    return one_frame(image, path, kelvin_steps(per_K), time_s=_time(tree.get("metadata")))


def _time(meta: Any) -> float:
    """Unix seconds of 'Date' (month/day/year) and 'Time'; NaN where they are not stated."""
    try:
        stamp = datetime.strptime(f"{meta['Date']} {meta['Time']}", "%m/%d/%y %H:%M:%S.%f")
    except (KeyError, TypeError, ValueError):
        return np.nan
    return stamp.replace(tzinfo=UTC).timestamp()
