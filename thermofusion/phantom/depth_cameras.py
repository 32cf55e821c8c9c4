"""Depth cameras: presets and noise after published measurements.

Kinect v1: Nguyen, Izadi, Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT
2012 (axial and lateral noise over range and angle); Khoshelham, Oude Elberink, "Accuracy and resolution of Kinect depth
data", Sensors 12 (2012) 1437 (1/8 px disparity steps).
Kinect v2: Fankhauser et al., "Kinect v2 for mobile robot navigation: evaluation and modeling", ICAR 2015.
Azure Kinect: Kurillo et al., "Evaluating the accuracy of the Azure Kinect and Kinect v2", Sensors 22 (2022) 2469
(random error like the v2's below 2.5 m, smaller beyond) and Tölgyessy et al., Sensors 21 (2021) 413 (σ at most 17 mm in
range). They give no closed form: the curve here is a smooth one of that size with the v2's angle term.
RealSense D435: Grunnet-Jepsen, Sweetser, Woodfill, "Tuning depth cameras for best performance", Intel: rms =
z² · subpixel / (f · baseline), subpixel 0.08 px on a well textured target; correlated over the matching window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Bool, Camera, Float32
from .scene import DepthConfig

MAX_MODEL_ANGLE = np.radians(82.0)  # the papers' θ²/(π/2 - θ)² diverges; they measured to about 80°
EDGE_M = 0.03  # a step in depth this high between neighbours is an edge


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """A depth camera's geometry and noise.

    sigma_m : (z_m, θ_rad) -> axial standard deviation in metres. lateral_px : standard deviation of where an edge is
    cut. correlation_px : Gaussian σ over which axial noise is correlated. disparity_px_m : f·b, 0 = no triangulation,
    and `disparity_step_px` its quantum. grazing_deg : no return beyond. baseline_m : of projector to camera, its shadow
    is a hole. flying : share of edge pixels that mix both sides (time of flight).
    """

    name: str
    camera: Camera
    sigma_m: Callable[[NDArray, NDArray], NDArray]
    lateral_px: float
    correlation_px: float
    range_m: tuple[float, float]
    grazing_deg: float
    disparity_px_m: float = 0.0
    disparity_step_px: float = 0.0
    baseline_m: float = 0.0
    flying: float = 0.0
    noisy: bool = True


def angle_term(theta: NDArray) -> NDArray:
    """θ²/(π/2 - θ)² of Nguyen and of Fankhauser for theta in rad, any shape, clipped; dimensionless."""
    t = np.minimum(theta, MAX_MODEL_ANGLE)
    return (t / (np.pi / 2 - t)) ** 2


def sigma_kinect_v1(z: NDArray, theta: NDArray) -> NDArray:
    """Nguyen 2012: 1.2 mm + 1.9 mm (z - 0.4)² + 0.1 mm / √z · θ²/(π/2 - θ)²; the last beyond 10° only.

    z in m and theta in rad broadcast; the result is one sigma in m.
    """
    tilt = np.where(theta > np.radians(10), 0.0001 / np.sqrt(z) * angle_term(theta), 0.0)
    return 0.0012 + 0.0019 * (z - 0.4) ** 2 + tilt


def sigma_kinect_v2(z: NDArray, theta: NDArray) -> NDArray:
    """Fankhauser 2015, indoors: 1.5 - 0.5 z + 0.3 z² + 0.1 z^1.5 θ²/(π/2 - θ)² in mm.

    z in m and theta in rad broadcast; the result is one sigma in m.
    """
    return 1e-3 * (1.5 - 0.5 * z + 0.3 * z**2 + 0.1 * z**1.5 * angle_term(theta))


def sigma_azure(z: NDArray, theta: NDArray) -> NDArray:
    """1.2 - 0.2 z + 0.12 z² mm and the v2's angle term (see the module's remark).

    z in m and theta in rad broadcast; the result is one sigma in m.
    """
    return 1e-3 * (1.2 - 0.2 * z + 0.12 * z**2 + 0.1 * z**1.5 * angle_term(theta))


def sigma_d435(z: NDArray, theta: NDArray) -> NDArray:
    """Intel: z² · 0.08 px / (f · 50 mm) at 848 x 480 (f = 424 px for 90°); oblique patches match worse, 1/cosθ.

    z in m and theta in rad broadcast; the result is one sigma in m.
    """
    return z**2 * 0.08 / (424 * 0.050) / np.cos(np.minimum(theta, MAX_MODEL_ANGLE))


def depth_camera(config: DepthConfig) -> DepthCamera:
    """The camera of a scene, its image shrunk by `scale` (field of view and noise per pixel kept)."""
    if config.preset == "kinect-v1":
        camera = scaled_camera(640, 480, 589.3, 589.8, 321.2, 237.2, config.scale)
        return DepthCamera(
            "simulated Kinect v1",
            camera,
            sigma_kinect_v1,
            0.8,
            0.8,
            (0.4, 4.0),
            75,
            43.5,
            1 / 8,
            0.075,
            0.0,
            config.noise,
        )
    if config.preset == "kinect-v2":
        camera = scaled_camera(512, 424, 365.5, 365.5, 254.9, 205.4, config.scale)
        return DepthCamera(
            "simulated Kinect v2", camera, sigma_kinect_v2, 0.4, 0.5, (0.5, 4.5), 80, flying=0.5, noisy=config.noise
        )
    if config.preset == "azure-kinect":
        camera = scaled_camera(640, 576, 504.0, 504.0, 321.0, 331.0, config.scale)
        return DepthCamera(
            "simulated Azure Kinect NFOV",
            camera,
            sigma_azure,
            0.4,
            0.5,
            (0.5, 3.86),
            80,
            flying=0.4,
            noisy=config.noise,
        )
    camera = scaled_camera(848, 480, 424.0, 424.0, 424.5, 239.5, config.scale)
    return DepthCamera(
        "simulated RealSense D435", camera, sigma_d435, 0.8, 2.0, (0.2, 5.0), 75, 21.2, 1 / 32, 0.050, 0.0, config.noise
    )


def scaled_camera(
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    scale: float,
    distortion: tuple[float, ...] = (),
) -> Camera:
    """A camera whose image is `scale` times as large; pixel centres at whole numbers."""
    K = np.array([[fx * scale, 0, (cx + 0.5) * scale - 0.5], [0, fy * scale, (cy + 0.5) * scale - 0.5], [0, 0, 1]])
    return Camera(round(width * scale), round(height * scale), K, np.array(distortion or (0,) * 5))


def measure_depth(
    model: DepthCamera, z_m: Float32, theta: Float32, shadow: Bool, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """True depth to the camera's image in mm, 0 = none.

    z_m : (H, W) true depth along the axis, NaN = nothing there. theta : (H, W) rad between ray and normal.
    shadow : (H, W) not lit by the projector.
    """
    if not model.noisy:
        return _millimetres(z_m, model.range_m)
    z, theta, shadow = _cut_edges(model, z_m, theta, shadow, rng)
    noise = _correlate(rng.standard_normal(z.shape, np.float32), model.correlation_px)
    with np.errstate(invalid="ignore"):
        z = z + model.sigma_m(z, theta) * noise
        lost = shadow | (theta > np.radians(model.grazing_deg)) | ~np.isfinite(z)
        if model.disparity_px_m:
            step = model.disparity_step_px
            z = model.disparity_px_m / (np.maximum(np.round(model.disparity_px_m / z / step), 1) * step)
    if model.flying:
        z = _fly(model, z, z_m, rng)
    z[lost] = np.nan
    return _millimetres(z, model.range_m)


def _cut_edges(
    model: DepthCamera, z: Float32, theta: Float32, shadow: Bool, rng: np.random.Generator
) -> tuple[NDArray, NDArray, NDArray]:
    """Lateral noise: near depth edges each pixel takes what lies a random step aside. Elsewhere the axial models, which
    were measured on planes, already contain its effect."""
    h, w = z.shape
    edge = cv2.dilate(depth_edges(z).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    step = np.rint(rng.normal(0, model.lateral_px, (2, h, w))).astype(np.int32)
    rows, cols = np.nonzero(edge)
    r = np.clip(rows + step[0][edge], 0, h - 1)
    c = np.clip(cols + step[1][edge], 0, w - 1)
    out = []
    for image in (z, theta, shadow):
        copy = image.copy()
        copy[rows, cols] = image[r, c]
        out.append(copy)
    return out[0], out[1], out[2]


def depth_edges(z: Float32) -> Bool:
    """Mask (H, W) of pixels with a step of depth z (H, W) m to a neighbour (nothing counts as far away)."""
    far = np.where(np.isfinite(z), z, 99.0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    return cv2.dilate(far, kernel) - cv2.erode(far, kernel) > EDGE_M


def _fly(model: DepthCamera, z: NDArray, truth: Float32, rng: np.random.Generator) -> NDArray:
    """Flying pixels: the light of both sides of an edge mixes; the range lands between, or up to 10 cm behind."""
    kernel = np.ones((3, 3), np.uint8)
    near = cv2.erode(np.where(np.isfinite(truth), truth, 99.0).astype(np.float32), kernel)
    far = cv2.dilate(np.where(np.isfinite(truth), truth, 0.0).astype(np.float32), kernel)
    share, chance = rng.random(z.shape, np.float32), rng.random(z.shape, np.float32)
    flies = depth_edges(truth) & (chance < model.flying) & (near < 90)
    gap = np.where(far - near > EDGE_M, far - near, 0.10)
    return np.where(flies, near + share**2 * gap, z)


def _correlate(noise: NDArray, sigma_px: float) -> NDArray:
    """White noise smoothed and brought back to unit variance."""
    r = int(np.ceil(4 * sigma_px))
    kernel = np.exp(-0.5 * (np.arange(-r, r + 1) / sigma_px) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    return cv2.sepFilter2D(noise, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)


def _millimetres(z_m: NDArray, range_m: tuple[float, float]) -> NDArray[np.uint16]:
    with np.errstate(invalid="ignore"):
        ok = (z_m > range_m[0]) & (z_m < range_m[1])
    return np.where(ok, np.rint(1e3 * np.where(ok, z_m, 0)), 0).astype(np.uint16)
