"""rig.json: the `cameras` and `extrinsics` of scan.json, with how sure they are and what they rest on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ScanError
from ..files.reading import read_json
from ..files.strict import validated
from ..files.whole import write_text
from ..scans.common import make_rig
from ..scans.native.schema import STREAMS, RigDoc, RigExtrinsicsDoc, camera_of, matrix_of
from ..scans.native.write import scatter_document
from ..types import Camera, Float, LensScatter, Rig, SignalCurve
from .fit.cameras import INTRINSIC_NAMES
from .fit.depth_model import DisparityDepth
from .fit.rig import Calibration
from .thermal.blackbody import signal_document

SCHEMA = "thermofusion-rig/1"
EXTRINSIC_ORDER = ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")


@dataclass(frozen=True, eq=False)
class RigFile:
    """cameras and transforms (4, 4) by name; covariances (6, 6) of (rotation vector [rad], translation [m]) by
    transform and (9, 9) of the intrinsics by camera; `document` the whole file."""

    cameras: dict[str, Camera]
    extrinsics: dict[str, Float]
    covariances: dict[str, Float]
    document: dict[str, Any]

    def rig(self) -> Rig:
        """As the method takes it. Raises ScanError if the calibration had no depth camera."""
        if "depth" not in self.cameras:
            raise ScanError("the rig was calibrated without a depth camera", hint="calibrate with depth images")
        color, T_color_depth = self.cameras.get("color"), self.extrinsics.get("T_color_depth")
        if color is None or T_color_depth is None:
            return Rig(self.cameras["depth"])
        return make_rig(self.cameras["depth"], color, T_color_depth, place="extrinsics.T_color_depth")


def rig_document(
    calibration: Calibration,
    *,
    date: str | None = None,
    curve: SignalCurve | None = None,
    time_offset_s: float | None = None,
    scatter: LensScatter | None = None,
    advice: Sequence[str] = (),
) -> dict[str, Any]:
    """The JSON document. date : ISO 8601, the caller's. curve, time_offset_s, scatter : of the thermal camera, if
    known."""
    fit = calibration.fit
    cameras = {name: _camera_doc(c) for name, c in sorted(calibration.cameras.items())}
    if curve is not None and "thermal" in cameras:
        cameras["thermal"]["signal"] = signal_document(curve)
    if time_offset_s is not None and "thermal" in cameras:
        cameras["thermal"]["time_offset_s"] = time_offset_s
    if scatter is not None and "thermal" in cameras:
        cameras["thermal"]["scatter"] = scatter_document(scatter)
    covariances = {k: v.tolist() for k, v in calibration.extrinsic_covariance.items()}
    covariances |= {c: fit.block_covariance(c).tolist() for c in cameras}
    return {
        "schema": SCHEMA,
        "date": date,
        "cameras": cameras,
        "extrinsics": {k: v.tolist() for k, v in calibration.extrinsics.items()},
        "covariances": covariances,
        "covariance_order": {"intrinsics": list(INTRINSIC_NAMES), "extrinsics": list(EXTRINSIC_ORDER)},
        "board": {
            "kind": calibration.data.board.kind,
            "columns": calibration.data.board.columns,
            "rows": calibration.data.board.rows,
            "spacing_m": calibration.spacing_m,
            "spacing_sigma_m": calibration.spacing_sigma_m,
        },
        "depth_correction": _depth_doc(calibration),
        "figures": figures(calibration),
        "notes": list(calibration.notes),
        "advice": list(advice),
    }


def figures(calibration: Calibration) -> dict[str, Any]:
    """The numbers a person judges a calibration by; px rms are distances."""
    fit, problem = calibration.fit, calibration.fit.problem
    out: dict[str, Any] = {
        "converged": fit.converged,
        "views": len(problem.views),
        "alone_rms_px": {c: s.rms_px for c, s in calibration.single.items()},
        "joint_rms_px": {c: fit.rms_px(c) for c in problem.cameras},
        "views_rms_px": {
            v.name: {c: fit.rms_px(c, {v.name}) for c in problem.cameras if c in v.points} for v in problem.views
        },
    }
    if calibration.grouping is not None:
        g = calibration.grouping
        out["groups"] = [g.names(k) for k in range(g.count)]
        out["group_reported"] = calibration.chosen_group
        out["group_rms_px"] = [fit.rms_px("thermal", set(g.names(k))) for k in range(g.count)]
        out["outliers_px"] = g.outliers
    if problem.depth is not None:
        r, _ = fit.residuals()["depth_plane"]
        out["depth_plane_median_mm"] = float(np.median(np.abs(r * problem.depth.sigma)) * 1e3)
    return out


def write_rig(path: Path, document: dict[str, Any]) -> None:
    """Write rig.json whole or not at all. Raises ResourceError."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def read_rig(path: Path) -> RigFile:
    """Read rig.json. Raises ScanError naming the key."""
    tree = read_json(path, "rig")
    if not isinstance(tree, dict) or tree.get("schema") != SCHEMA:
        raise ScanError(
            f"key 'schema': expected '{SCHEMA}'", place=path, hint="`thermofusion calibrate PICTURES` writes one"
        )
    doc = validated(RigDoc, tree, path)
    if "extrinsics" not in doc.model_fields_set:
        raise ScanError("key 'extrinsics': field required", place=path)
    groups = {str(n): getattr(doc.cameras, n) for n in STREAMS}
    cameras = {n: camera_of(c, f"cameras.{n}", path) for n, c in groups.items() if c is not None}
    rows = {k: getattr(doc.extrinsics, k) for k in RigExtrinsicsDoc.model_fields}
    extrinsics = {k: matrix_of(r, f"extrinsics.{k}", path) for k, r in rows.items() if r is not None}
    covariances = {name: _square(r, f"covariances.{name}", path) for name, r in doc.covariances.items()}
    return RigFile(cameras, extrinsics, covariances, tree)


def add_scatter(path: Path, scatter: LensScatter) -> None:
    """Write the lens's scatter into a rig.json, all else as it is. Raises ScanError: no rig, no thermal camera."""
    read_rig(path)
    tree = read_json(path, "rig")
    if tree["cameras"].get("thermal") is None:
        raise ScanError("the rig has no thermal camera", place=path, hint="give the rig.json of the camera's own rig")
    tree["cameras"]["thermal"]["scatter"] = scatter_document(scatter)
    write_rig(path, tree)


def _square(rows: list[list[float]], key: str, path: Path) -> Float:
    if not 0 < len(rows) <= 12 or any(len(r) != len(rows) for r in rows):
        raise ScanError(f"key '{key}': expected a square matrix", place=path)
    return np.array(rows, np.float64)


def _camera_doc(c: Camera) -> dict[str, Any]:
    return {"width_px": c.width_px, "height_px": c.height_px, "K": c.K.tolist(), "distortion": c.distortion.tolist()}


def _depth_doc(calibration: Calibration) -> dict[str, Any] | None:
    model = calibration.depth_model
    if model is None:
        return None
    values = calibration.fit.block("depth_model")
    sigma = np.sqrt(np.diag(calibration.fit.block_covariance("depth_model")))
    return {
        "model": "disparity" if isinstance(model, DisparityDepth) else "metric",
        "parameters": {n: float(v) for n, v in zip(model.names, values, strict=True)},
        "sigma": {n: float(s) for n, s in zip(model.names, sigma, strict=True)},
    }
