"""Thermal cameras: presets, and the way from radiance at the lens to 16-bit counts.

Fields of view, bands and noise after the makers' data sheets: a 640 x 480 uncooled LWIR of 31.5 mK (the paper's); the
same at 320 x 240, 60 mK; FLIR Lepton 3.5 (160 x 120, 57°, 50 mK, TLinear 0.01 K); Thermal Master P3 (256 x 192, 40 mK,
1/64 K).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Bool, Camera, Float, Float32
from .depth_cameras import scaled_camera
from .physics import Band
from .scene import BlackbodyConfig, DriftConfig, ThermalConfig

LWIR_DISTORTION = (-0.24, 0.11, 0.0011, -0.0006, -0.02)  # k1 k2 p1 p2 k3: a wide lens's barrel
REFERENCE_DEGC = 30.0  # NETD, drift and vignetting are given in kelvin at this temperature (the makers' convention)
BLACKBODY_MARGIN = 1.5  # the source is this much larger than the polygon, so that blur does not reach into it
SHUTTER_DEGC = 28.0  # a shutter has about the housing's temperature


@dataclass(frozen=True, eq=False)
class ThermalCamera:
    """A thermal camera. `curve`: the scan format's, counts -> °C; the rest as in the scan format."""

    name: str
    camera: Camera
    band_um: tuple[float, float]
    netd_K: float
    psf_sigma_px: float
    curve: dict[str, object]
    vignetting_K: float
    supersample: int
    band: Band


def thermal_camera(config: ThermalConfig) -> ThermalCamera:
    """The camera of a scene."""
    polynomial: dict[str, object] = {"type": "polynomial", "coefficients_degC": [-30.0, 0.0026, 1.1e-08]}
    presets: dict[str, tuple[tuple[int, int, float, float, float, float], float, dict[str, object], str]] = {
        "lwir-640": ((640, 480, 589.4, 609.3, 322.4, 243.9), 0.0315, polynomial, "simulated LWIR 640 x 480"),
        "lwir-320": ((320, 240, 294.7, 304.6, 162.4, 123.9), 0.060, polynomial, "simulated LWIR 320 x 240"),
        "lepton-3.5": (
            (160, 120, 147.3, 147.3, 80.1, 59.2),
            0.050,
            {"type": "linear_kelvin", "gain_K": 0.01, "offset_K": 0.0},
            "simulated FLIR Lepton 3.5",
        ),
        "p3": (
            (256, 192, 351.0, 351.0, 127.0, 96.5),
            0.040,
            {"type": "linear_kelvin", "gain_K": 1 / 64, "offset_K": 0.0},
            "simulated Thermal Master P3",
        ),
    }
    size, netd_K, curve, name = presets[config.preset]
    band_um = (8.0, 14.0) if config.preset in ("lepton-3.5", "p3") else (7.5, 13.5)
    return ThermalCamera(
        name,
        scaled_camera(*size, config.scale, LWIR_DISTORTION),
        band_um,
        netd_K if config.netd_K is None else config.netd_K,
        0.7 if config.psf_sigma_px is None else config.psf_sigma_px,
        curve,
        config.vignetting_K,
        config.supersample,
        Band.of(band_um),
    )


def expose(model: ThermalCamera, scene: Float32, offset_K: float, rng: np.random.Generator) -> NDArray[np.uint16]:
    """One frame (H, W) of counts: blur, pixel binning, vignetting, offset, noise, curve.

    scene : (S·H, S·W) radiance at the lens on the supersampled grid, W m-2 sr-1.
    """
    s = model.supersample
    h, w = model.camera.shape
    image = blur(scene, model.psf_sigma_px * s).reshape(h, s, w, s).mean((1, 3), dtype=np.float64)
    per_K = model.band.slope(REFERENCE_DEGC)
    error_K = offset_K + vignetting_field(model) + rng.normal(0, model.netd_K, (h, w))
    return to_counts(model, model.band.invert(image + per_K * error_K))


def blur(image: NDArray, sigma: float) -> NDArray:
    """The lens: an image (H, W) under a Gaussian of `sigma` samples (px of that image), edges continued."""
    if sigma <= 0:
        return image
    r = int(np.ceil(4 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-r, r + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    return cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)


def vignetting_field(model: ThermalCamera) -> Float:
    """What every pixel shows too much, (H, W) K: 0 in the middle, -vignetting_K on the mean corner, lopsided."""
    h, w = model.camera.shape
    x, y = np.meshgrid(np.linspace(-1, 1, w), np.linspace(-1, 1, h))
    r2 = (x**2 + (h / w * y) ** 2) / (1 + (h / w) ** 2)
    return -model.vignetting_K * (0.7 * r2 + 0.3 * r2**2 + 0.15 * x - 0.08 * y)


def to_counts(model: ThermalCamera, degC: Float) -> NDArray[np.uint16]:
    """Invert the curve: degC of any shape to whole counts, clipped to 16 bits."""
    g = np.arange(65536.0)
    return np.clip(np.rint(np.interp(degC, counts_to_degC(model, g), g)), 0, 65535).astype(np.uint16)


def counts_to_degC(model: ThermalCamera, counts: NDArray) -> Float:
    """The written curve: counts of any shape to °C."""
    curve, g = model.curve, np.asarray(counts, np.float64)
    if curve["type"] == "polynomial":
        coefficients = np.array(curve["coefficients_degC"], np.float64)
        return np.asarray(np.polynomial.polynomial.polyval(g, coefficients), np.float64)
    return np.array(curve["gain_K"], np.float64) * g + np.array(curve["offset_K"], np.float64) - 273.15


def draw_drift(config: DriftConfig, times_s: Float, rng: np.random.Generator) -> tuple[Float, Bool]:
    """Offset of every frame in K, and which frames show the shutter. (N,) -> (N,), (N,)."""
    shutter = np.zeros(len(times_s), bool)
    last = np.full(len(times_s), -1)
    events = np.zeros(0)
    if config.shutter_every_s is not None:
        events = np.arange(rng.uniform(0.3, 0.9) * config.shutter_every_s, times_s[-1], config.shutter_every_s)
        shutter[np.abs(times_s[:, None] - events[None]).argmin(0)] = True
        last = np.searchsorted(events, times_s, side="right") - 1
    level = rng.normal(0, config.level_K, len(events) + 1)[last + 1]
    since = times_s - np.concatenate([times_s[:1], events])[last + 1]
    ramp = config.ramp_K_per_min / 60 * since * rng.choice([-1, 1], len(events) + 1)[last + 1]
    phase, period = rng.uniform(0, 2 * np.pi, 4), rng.uniform(3, 20, 4)
    wander = np.sin(2 * np.pi * times_s[:, None] / period + phase).sum(1) * config.wander_K / np.sqrt(2)
    return level + ramp + wander, shutter


def blackbody_polygon(config: BlackbodyConfig, camera: Camera) -> Float:
    """(4, 2) whole pixels, kept inside the image with room for the source's rim."""
    half = max(round(config.size * camera.height_px / 2), 2)
    reach = int(np.ceil(BLACKBODY_MARGIN * half)) + 1
    u = int(np.clip(round(config.center[0] * camera.width_px), reach, camera.width_px - 1 - reach))
    v = int(np.clip(round(config.center[1] * camera.height_px), reach, camera.height_px - 1 - reach))
    return np.array([[u - half, v - half], [u + half, v - half], [u + half, v + half], [u - half, v + half]], float)


def paint_blackbody(model: ThermalCamera, config: BlackbodyConfig, scene: Float32, room: float) -> None:
    """Put the source into the supersampled scene (S·H, S·W), in place. room : radiance it reflects. W m-2 sr-1."""
    polygon = blackbody_polygon(config, model.camera)
    center, half = polygon.mean(0), BLACKBODY_MARGIN * np.ptp(polygon[:, 0]) / 2
    s = model.supersample
    lo = np.maximum(np.rint((center - half) * s), 0).astype(int)
    hi = np.rint((center + half) * s).astype(int)
    source = float(model.band.emit(np.array(config.degC)))
    scene[lo[1] : hi[1], lo[0] : hi[0]] = config.emissivity * source + (1 - config.emissivity) * room


def shutter_image(model: ThermalCamera, rng: np.random.Generator) -> NDArray[np.uint16]:
    """What a frame shows while the shutter is closed, (H, W) counts: an even surface."""
    return to_counts(model, SHUTTER_DEGC + rng.normal(0, model.netd_K, model.camera.shape))
