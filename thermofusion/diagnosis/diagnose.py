"""Evidence of all steps into named faults, worst first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..mapping.observe import Mapped
from ..temperature.crosscal import Calibration
from ..temperature.sensor.pattern import Pattern
from ..temperature.solve import Temperature
from ..types import VertexFlag
from .radiation import of_lens, of_room
from .words import Diagnosis

OUTLINE_PX = 0.4  # clean scans leave 0.15-0.3 px between the outlines of model and image
GAIN_SIGMAS, LEAST_GAIN = 3.5, 0.005  # by which references must contradict the gain, and a share that is worth a word
GRID = 24  # points along each side of the image at which a pattern's size is taken


def diagnose(mapped: Mapped, temperature: Temperature, image_px: tuple[int, int]) -> tuple[Diagnosis, ...]:
    """What is wrong with a scan, as its own data say; empty for a clean one. image_px : width and height."""
    found: list[Diagnosis] = []
    calibration = temperature.calibration
    if calibration is not None:
        found += _patterns(calibration)
        found += _references(calibration)
    found += _skin(temperature)
    found += of_room(temperature.room)
    found += of_lens(mapped.scatter)
    found += _outlines(mapped)
    if len(mapped.bad_pixels):
        share = len(mapped.bad_pixels) / (image_px[0] * image_px[1])
        evidence = f"{len(mapped.bad_pixels)} pixels ({share:.2%}) stand outside their neighbours in frame after frame"
        found.append(Diagnosis("dead pixels", evidence, None, "single pixels", "left out"))
    found.sort(key=lambda d: -(d.size_K or 0.0))
    return tuple(found)


def _skin(temperature: Temperature) -> list[Diagnosis]:
    other = (temperature.mesh.flags & VertexFlag.NOT_SKIN) > 0
    if not other.any():
        return []
    T = temperature.mesh.temperature_degC
    size = abs(float(np.nanmedian(T[other]) - np.nanmedian(T[~other])))
    text = f"readings of {other.mean():.1%} of the surface change with the angle as skin's do not"
    done = "flagged NOT_SKIN, kept out of calibration and statistics"
    return [Diagnosis("surface that is not skin", text, size, "where the flag stands", done)]


def _outlines(m: Mapped) -> list[Diagnosis]:
    """Clock, scale, and what is left."""
    found = []
    if m.jitter_s > 0:
        text = f"outlines of single views stand where they belong {1e3 * m.jitter_s:.0f} ms earlier or later"
        done = "each frame's time was solved for from its outline"
        found.append(
            Diagnosis("time stamps jitter", text, None, "thermal frames", done, size=1e3 * m.jitter_s, unit="ms")
        )
    if m.readout is not None:
        ms, sigma_ms = 1e3 * abs(m.readout.readout_s), 1e3 * m.readout.sigma_s
        order = "first to last" if m.readout.readout_s > 0 else "last to first"
        text = f"outlines lean with their motion as if rows were read from the {order} in {ms:.0f} ± {sigma_ms:.0f} ms"
        done = f"left as it is: it moves outlines by {m.readout.shift_px:.2f} px, and sigma contains what outlines miss"
        what = "rows are read one after another"
        found.append(Diagnosis(what, text, None, "while the camera moves", done, size=ms, unit="ms"))
    if m.depth_scale:
        side = "far" if m.depth_scale > 0 else "near"
        percent = 100 * abs(m.depth_scale)
        text = f"outlines fit as if depth were {percent:.1f} % too {side}, or the spacing of the cameras as wrong"
        done = "views were set onto the surface as they fit; the surface's size is left, and sigma grew by it"
        found.append(Diagnosis("depth scale is off", text, None, "everywhere", done, size=percent, unit="%"))
    if m.outline_px > OUTLINE_PX:
        text = f"{m.outline_px:.2f} px between the outlines of model and image (clean scans: below {OUTLINE_PX})"
        done = "the uncertainty of places on a slope of temperature grew with it"
        found.append(Diagnosis("outlines do not fit", text, None, "at the body's outline", done))
    return found


def _patterns(c: Calibration) -> list[Diagnosis]:
    found = []
    better, before = c.criticism.get("left_out_views_better", {}), c.criticism.get("before", {})

    def evidence(names: tuple[str, ...], kind: str) -> str:
        size = max((before[n][0] for n in names if n in before), default=0.0)
        return f"residuals by {names[0]} agree by {1e3 * size:.0f} mK; left-out views {better[kind]:.0%} better with it"

    if c.sensor is not None and "drift" in better:
        size = _drift_rms(c.sensor) / c.slope_L
        text, done = evidence(("place and time",), "drift"), "solved for; its uncertainty is in sigma"
        where = "mostly towards the image's border"
        found.append(Diagnosis("pattern drifts between shutters", text, size, where, done))
    if c.sensor is not None and "fixed" in better:
        size = _fixed_rms(c.sensor) / c.slope_L
        columns = c.sensor.column_K > c.sensor.place_K
        where = "columns of the image" if columns else "places of the image"
        text, done = evidence(("place", "column", "row"), "fixed"), "solved for; its uncertainty is in sigma"
        found.append(Diagnosis("fixed pattern", text, size, where, done))
    if c.pattern_sigma_K > 0:
        text = f"{c.pattern_sigma_K:.3f} K is left that no term explains"
        done = "sigma grew by it"
        found.append(Diagnosis("readings agree by place in the image", text, c.pattern_sigma_K, "in the image", done))
    return found


def _references(c: Calibration) -> list[Diagnosis]:
    """A gain that two references contradict; else their scatter."""
    gain, sigma = c.criticism.get("gain") or (0.0, 1.0)
    if abs(gain) > max(GAIN_SIGMAS * sigma, LEAST_GAIN):
        side = "large" if gain > 0 else "small"
        text = f"references at unlike temperatures read as if the gain were {abs(gain):.1%} ± {sigma:.1%} too {side}"
        solved = c.gain != 1
        done = "solved for" if solved else "left as it is; sigma holds the recipe's temperature.sigma_gain"
        size = 100 * abs(gain)
        return [Diagnosis("gain is off", text, None, "everywhere, away from the level", done, size=size, unit="%")]
    scatter = c.criticism.get("references_K")
    if not scatter:
        return []
    text = f"readings of references scatter by {scatter:.2f} K about the solution, more than their noise"
    return [Diagnosis("references contradict each other", text, scatter, "at the references", "the level's sigma grew")]


def _grid(sensor: Pattern) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[0:GRID, 0:GRID].reshape(2, -1) / (GRID - 1)
    return u * (sensor.width_px - 1), v * (sensor.height_px - 1)


def _drift_rms(sensor: Pattern) -> float:
    """What a drift grows to until the next shutter: its rms over the image, mean of the stretches, W m-2 sr-1."""
    drift = replace(sensor, place_K=0.0, column_K=0.0, row_K=0.0)
    n = len(drift.precision())
    drift = replace(drift, coefficients=sensor.coefficients[:n])
    u, v = _grid(sensor)
    last = np.append(np.flatnonzero(np.diff(sensor.stretch)), len(sensor.stretch) - 1)
    return float(np.mean([np.std(drift(u, v, np.full(len(u), k))) for k in last]))


def _fixed_rms(sensor: Pattern) -> float:
    """Rms over the image of what stands still, W m-2 sr-1."""
    fixed = replace(sensor, drift_K=0.0)
    n = len(fixed.precision())
    fixed = replace(fixed, coefficients=sensor.coefficients[len(sensor.coefficients) - n :])
    v, u = np.mgrid[0 : sensor.height_px : 6, 0 : sensor.width_px].reshape(2, -1).astype(float)
    return float(np.std(fixed(u, v, np.zeros(len(u), np.intp))))
