"""A calibration folder: pictures of the board by camera, and calibration.json that says what they are.

```json
{"board": {"kind": "pins", "columns": 9, "rows": 9, "spacing_m": 0.0762},
 "files": {"color": "color/*.png", "thermal": "thermal/*.png", "depth": "depth/*.png",
           "infrared": "infrared/*.png"},
 "depth": {"unit_m": 0.001, "invalid": [0], "kind": "metric",
           "camera": {"width_px": 640, "height_px": 480, "K": [[...]]}, "lens_known": false},
 "thermal_raw": {"width_px": 632, "height_px": 476, "big_endian": true, "header_bytes": 0},
 "picks": "picks.csv", "free_spacing": false, "mirrored": []}
```
`infrared` are pictures of the depth camera itself, pixel for pixel with its depth. The star in a pattern is the view's
name: the same name in two patterns is the same moment. Only `board` is required.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..errors import ScanError
from ..files.reading import MAX_NAME, depth_from_raw, inside, is_named, read_image, read_json
from ..files.strict import ClosedBorder, validated
from ..scans.native.schema import CameraDoc, camera_of, matrix_of
from ..types import Camera, Float, check_rigid
from .board.board import Board
from .detect.depth_samples import NO_DISPARITY
from .thermal.source import RawLayout

FILE = "calibration.json"
PICTURE_SUFFIXES = ("png", "jpg", "tiff", "tif", "pgm", "raw")


class _BoardDoc(ClosedBorder):
    kind: str = "checkerboard"
    columns: int = Field(ge=2, le=1000)
    rows: int = Field(ge=2, le=1000)
    spacing_m: float = Field(ge=0.0001, le=10)
    mark_ratio: float = Field(0.5, ge=0.05, le=0.95)


class _DepthDoc(ClosedBorder):
    unit_m: float = Field(0.001, gt=1e-6, le=0.1)
    invalid: list[Annotated[int, Field(ge=0, le=65535)]] = Field(default_factory=lambda: [0], max_length=1000)
    kind: Literal["metric", "disparity"] = "metric"
    camera: CameraDoc | None = None
    lens_known: bool = False
    T_depth_color: list[list[float]] | None = None


class _RawDoc(ClosedBorder):
    width_px: int = Field(gt=0, le=32767)
    height_px: int = Field(gt=0, le=32767)
    big_endian: bool = False
    header_bytes: int = Field(0, ge=0, le=1_000_000)


class _Config(ClosedBorder):
    board: _BoardDoc
    files: dict[Literal["color", "thermal", "depth", "infrared"], Annotated[str, Field(max_length=MAX_NAME)]] = Field(
        default_factory=dict
    )
    depth: _DepthDoc = _DepthDoc()
    thermal_raw: _RawDoc | None = None
    picks: str | None = Field(None, max_length=MAX_NAME)
    free_spacing: bool = False
    mirrored: list[Literal["color", "thermal", "depth"]] = Field(default_factory=list)


@dataclass(frozen=True, eq=False)
class CalibrationFolder:
    """An opened folder. files : camera -> view name -> path. Pictures are decoded when asked for."""

    root: Path
    board: Board
    files: dict[str, dict[str, Path]]
    picks: Path | None
    free_spacing: bool
    mirrored: frozenset[str]
    depth_kind: str
    depth_camera: Camera | None
    depth_lens_known: bool
    T_depth_color: Float | None
    _config: _Config

    @property
    def names(self) -> list[str]:
        """All view names, sorted: the order of recording."""
        return sorted(set().union(*self.files.values()))

    def color(self, name: str) -> NDArray[np.uint8]:
        """(H, W) 8-bit grey of a colour picture."""
        image = read_image(self.files["color"][name], kind="colour")
        if image.dtype != np.uint8:
            image = (image / 257).astype(np.uint8) if image.dtype == np.uint16 else image.astype(np.uint8)
        grey = image if image.ndim == 2 else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
        return self._turned(np.asarray(grey, np.uint8), "color")

    def thermal(self, name: str) -> NDArray:
        """(H, W) counts or degC of a thermal picture."""
        path = self.files["thermal"][name]
        if path.suffix == ".raw":
            return self._turned(self._raw(path), "thermal")
        image = read_image(path, kind="thermal")
        return self._turned(image if image.ndim == 2 else image[..., 0], "thermal")

    def depth(self, name: str) -> NDArray[np.float32]:
        """(H, W) metres, NaN none; for `disparity` counts as float, NaN where `invalid` or eleven bits of 1."""
        path, d = self.files["depth"][name], self._config.depth
        raw = read_image(path, kind="depth")
        if d.kind == "disparity":
            if raw.dtype != np.uint16 or raw.ndim != 2:
                raise ScanError(f"disparity is {raw.dtype} with {raw.ndim} axes, expected 16-bit grey", place=path)
            none = np.isin(raw, [0, *d.invalid]) | (raw >= NO_DISPARITY)
            return self._turned(np.where(none, np.float32(np.nan), raw.astype(np.float32)), "depth")
        return self._turned(depth_from_raw(raw, d.unit_m, place=path, invalid=tuple(d.invalid)), "depth")

    def infrared(self, name: str) -> NDArray[np.uint8]:
        """(H, W) 8-bit grey of the depth camera's own infrared picture, its contrast stretched."""
        image = read_image(self.files["infrared"][name], kind="infrared")
        grey = (image if image.ndim == 2 else image[..., 0]).astype(np.float32)
        lo, hi = np.percentile(grey, [0.5, 99.5])
        stretched = np.clip((grey - lo) * (255 / max(hi - lo, 1e-6)), 0, 255)
        return self._turned(np.round(stretched).astype(np.uint8), "depth")

    def _turned(self, image: NDArray, camera: str) -> NDArray:
        return image[:, ::-1] if camera in self.mirrored else image

    def _raw(self, path: Path) -> NDArray[np.uint16]:
        r = self._config.thermal_raw
        if r is None:
            raise ScanError("a .raw picture needs its size", place=path, hint=f"give `thermal_raw` in {FILE}")
        return RawLayout(r.width_px, r.height_px, r.big_endian, r.header_bytes).read(path)

    @property
    def newest(self) -> date:
        """The day (UTC) on which the newest picture was written, by its file."""
        times = [p.stat().st_mtime for files in self.files.values() for p in files.values()]
        return datetime.fromtimestamp(max(times), UTC).date()


def open_folder(
    root: Path, *, config: Mapping[str, Any] | None = None, board: Board | None = None
) -> CalibrationFolder:
    """Open a calibration folder; `config` replaces its calibration.json, `board` the board in it.

    Raises ScanError naming the file, the key and what was expected.
    """
    if not root.is_dir():
        raise ScanError("there is no such calibration folder", place=root)
    c = _load(root, config, board)
    patterns = dict(c.files) or {k: f"{k}/*" for k in ("color", "thermal", "depth", "infrared")}
    files = {str(k): _matching(root, p) for k, p in patterns.items()}
    files = {k: f for k, f in files.items() if f}
    if not files:
        raise ScanError(
            "no pictures are here", place=root, hint=f"put them in color/, thermal/, depth/ or name `files` in {FILE}"
        )
    T = None
    if c.depth.T_depth_color is not None:
        try:
            T = check_rigid(matrix_of(c.depth.T_depth_color, "depth.T_depth_color", root / FILE), "T_depth_color")
        except ValueError as e:
            raise ScanError(f"key 'depth': {e}", place=root / FILE) from None
    camera = None if c.depth.camera is None else camera_of(c.depth.camera, "depth.camera", root / FILE)
    return CalibrationFolder(
        root=root,
        board=board or Board(**c.board.model_dump()),
        files=files,
        picks=None if c.picks is None else inside(root, c.picks, place=root / FILE),
        free_spacing=c.free_spacing,
        mirrored=frozenset(c.mirrored),
        depth_kind=c.depth.kind,
        depth_camera=camera,
        depth_lens_known=c.depth.lens_known and camera is not None,
        T_depth_color=T,
        _config=c,
    )


def _load(root: Path, config: Mapping[str, Any] | None, board: Board | None) -> _Config:
    path = root / FILE
    tree: dict[str, Any]
    if config is not None:
        tree = dict(config)
    else:
        tree = read_json(path) if is_named(path) else {}
    if not isinstance(tree, dict):
        raise ScanError("expected a table of keys", place=path)
    if board is not None:
        tree["board"] = {"kind": board.kind, "columns": board.columns, "rows": board.rows, "spacing_m": board.spacing_m}
    if "board" not in tree:
        raise ScanError(
            "the board is not described",
            place=path,
            hint='write into it, say, "board": {"kind": "checkerboard", "columns": 9, "rows": 6, "spacing_m": 0.03}',
        )
    return validated(_Config, tree, path)


def _matching(root: Path, pattern: str) -> dict[str, Path]:
    """BoardView name (what the star stands for) -> file."""
    if pattern.count("*") != 1 or ".." in Path(pattern).parts or Path(pattern).is_absolute():
        raise ScanError(f"the pattern '{pattern}' must lie in the folder and hold one star", place=root / FILE)
    head, tail = Path(pattern).name.split("*")
    out = {}
    for path in sorted((root / pattern).parent.glob(Path(pattern).name)):
        if path.is_file() and path.suffix.lstrip(".").lower() in PICTURE_SUFFIXES:
            name = path.name[len(head) : len(path.name) - len(tail)]
            out[name if tail else Path(name).stem] = path
    return out
