"""What an earlier result of the same camera knows for the next scan: the field over its image."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

from ..errors import ScanError
from ..recipe import Recipe
from ..report.metadata import stated
from ..temperature.sensor.earlier import SAME_CAMERA, handed_on, refuse_another_image
from ..types import Scan
from .claim import REPORT, report_in
from .folder import load_temperature

DAY_S = 86_400.0


def with_field(recipe: Recipe, scan: Scan, folder: Path) -> Recipe:
    """The recipe for `scan` with the camera's field as the result in `folder` found it, and its age.

    Raises ScanError where there is no such field, or another camera's.
    """
    calibration = load_temperature(folder).calibration
    if calibration is None or not calibration.field.coefficients.any():
        hint = "a result of several thermal views has one (temperature.method = joint)"
        raise ScanError("this result found no field of the camera", place=folder, hint=hint)
    report = report_in(folder)
    if report is None:
        hint = "`thermofusion run SCAN -o RESULT` writes it again"
        raise ScanError("it is not what thermofusion wrote", place=folder / REPORT, hint=hint)
    serials = _serial(report.get("metadata", [])), _serial(stated(scan))
    if None not in serials and serials[0] != serials[1]:
        raise ScanError(
            "the earlier field is of another thermal camera (serial number)", place=folder, hint=SAME_CAMERA
        )
    c = calibration
    found = handed_on(c.field, c.sensor, c.covariance[c.layout.field, c.layout.field], c.slope_L)
    if scan.thermal is not None:
        lens = scan.thermal.camera.lens
        refuse_another_image(found, lens.width_px, lens.height_px)
    found = found.model_copy(update={"age_days": _days(report.get("scan", {}).get("recorded_at"), scan.recorded_at)})
    crosscal = recipe.temperature.crosscal.model_copy(update={"field": found})
    return recipe.model_copy(update={"temperature": recipe.temperature.model_copy(update={"crosscal": crosscal})})


def _serial(rows: list[dict[str, Any]]) -> str | None:
    return next((row["value"] for row in rows if row["key"] == "camera.serial"), None)


def _days(then: str | None, now: str | None) -> float | None:
    """Days between two times of day as scans state them; None where one is missing, or in another time zone's words."""
    try:
        span = datetime.fromisoformat(now or "") - datetime.fromisoformat(then or "")
    except (ValueError, TypeError):
        return None
    return round(span.total_seconds() / DAY_S, 3)
