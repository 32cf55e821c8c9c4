"""A simulated recording as a native scan folder with its truth. A folder appears whole or not at all."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import ScanError
from ..types import Camera, Float


@contextmanager
def whole_folder(out: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A folder to write into, beside `out`; renamed to `out` at the end, removed on failure.

    Raises ScanError if `out` holds something, unless that is a scan and may be overwritten.
    """
    taken = out.exists() and (not out.is_dir() or any(out.iterdir()))
    if taken and not (overwrite and (out / "scan.json").is_file()):
        raise ScanError("there is something here already", place=out, hint="name a new folder, or remove this one")
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(f".{out.name}.part")
    if part.exists():
        shutil.rmtree(part)
    part.mkdir()
    try:
        yield part
        if out.exists():
            shutil.rmtree(out)
        part.replace(out)
    finally:
        if part.exists():
            shutil.rmtree(part)


def write_image(path: Path, image: NDArray, *, jpeg_quality: int | None = None) -> None:
    """PNG of an image (H, W) or (H, W, 3) as it is, or JPEG of R, G, B uint8."""
    if jpeg_quality is not None:
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    else:
        ok, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not ok:
        raise ScanError("the image could not be encoded", place=path)
    path.write_bytes(data.tobytes())


def write_trajectory(path: Path, times_s: Float, T_world_depth: Float) -> None:
    """TUM rows `time_s tx ty tz qx qy qz qw` [s, m] of times_s (N,) and T_world_depth (N, 4, 4)."""
    q = Rotation.from_matrix(T_world_depth[:, :3, :3]).as_quat()
    rows = [
        f"{t:.6f} " + " ".join(f"{x:.9f}" for x in (*T[:3, 3], *quat))
        for t, T, quat in zip(times_s, T_world_depth, q, strict=True)
    ]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_frames(path: Path, rows: list[tuple[str, int, float, str, bool]]) -> None:
    """frames.csv from (stream, index, time_s, path, shutter), sorted by time."""
    with path.open("w", newline="", encoding="utf-8") as f:
        writer = csv.writer(f, lineterminator="\n")
        writer.writerow(["stream", "index", "time_s", "path", "shutter"])
        for stream, index, time_s, name, shutter in sorted(rows, key=lambda r: (r[2], r[0])):
            writer.writerow([stream, index, f"{time_s:.6f}", name, "1" if shutter else ""])


def camera_json(camera: Camera, model: str) -> dict[str, Any]:
    """A camera as scan.json has it."""
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "K": camera.K.tolist(),
        "distortion": camera.distortion.tolist(),
        "model": model,
    }


def write_json(path: Path, document: dict[str, Any]) -> None:
    """A document as indented JSON."""
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
