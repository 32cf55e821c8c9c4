"""Depth edges drawn over the other cameras' images, and where they would fit best: the rig made visible."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project
from ..geometry.rigid import interpolate_trajectory, invert, transform_points
from ..robust import evenly
from ..types import Bool, Camera, Float, Scan, Stream, UInt8
from .pairing import nearest_in_time

OVERLAY_FRAMES = 3  # spread through the recording
EDGE_STEP = 0.03  # a neighbour farther away by this share of the range makes an edge
REACH_PX = 12  # shifts tried
MIRROR_FRAMES, MOST, FEW = 7, 0.6, 0.3  # frames looked at; share that must fit turned round, may fit as they stand
FITS_PX, FITS_CONTRAST = 4.0, 1.25  # an overlay that fits: its best shift, its contrast
_GREEN = (0, 255, 0)  # sRGB: no grey, no skin


@dataclass(frozen=True, eq=False)
class Overlay:
    """One picture.

    name : for a file. camera : `thermal` or `color`. picture : (H, W, 3) uint8 R, G, B. shift_px : (du, dv) that would
    bring the depth edges best onto the image's own. contrast : image gradient along the edges at that shift over its
    mean of all shifts tried; near 1 the shift says nothing.
    """

    name: str
    camera: str
    picture: UInt8
    shift_px: tuple[float, float]
    contrast: float


def edge_overlays(scan: Scan, count: int = OVERLAY_FRAMES) -> list[Overlay]:
    """Depth edges over thermal and colour at `count` moments from first to last. Raises ScanError for a bad frame.

    The depth frame nearest in time is used; where the scan has a trajectory, the motion between the two is applied.
    """
    found = []
    for name, stream, camera, T, times_s in _others(scan):
        rows = np.flatnonzero(stream.usable)
        picks = rows[evenly(len(rows), count)]
        for i in picks.tolist():
            t = times_s[i]
            k = int(nearest_in_time(np.array([t]), scan.depth.times_s)[0][0])
            T_other_depth = T @ _motion(scan, t, scan.depth.times_s[k])
            grey = to_grey(stream.load(i))
            edges = _project_edges(scan.rig.depth, scan.depth.load(k), camera, T_other_depth)
            shift, contrast = best_shift(grey, edges)
            picture = _upright(_draw(grey if name == "thermal" else stream.load(i), edges), T[:3, :3] @ scan.depth_up)
            found.append(Overlay(f"overlay-{name}-{int(stream.index[i]):06d}", name, picture, shift, contrast))
    return found


def looks_mirrored(scan: Scan) -> bool:
    """Whether depth edges fit the other cameras' images only once depth and colour are turned round, left to right.

    Raises ScanError for a bad frame.
    """
    from .stated import unmirrored

    as_is, turned = edge_overlays(scan, MIRROR_FRAMES), edge_overlays(unmirrored(scan), MIRROR_FRAMES)
    for camera in {o.camera for o in as_is}:
        fit, other = (np.mean([_fits(o) for o in found if o.camera == camera]) for found in (as_is, turned))
        if other >= MOST and fit <= FEW and sum(o.camera == camera for o in turned) >= 3:
            return True
    return False


def _fits(overlay: Overlay) -> bool:
    return bool(np.abs(overlay.shift_px).max() <= FITS_PX and overlay.contrast >= FITS_CONTRAST)


def _others(scan: Scan) -> Iterator[tuple[str, Stream, Camera, Float, Float]]:
    """The cameras beside depth: name, images, lens, T_other_depth, and the images' times on the depth clock."""
    if scan.thermal is not None and scan.thermal.camera.mount == "rig":
        camera = scan.thermal.camera
        yield "thermal", scan.thermal, camera.lens, camera.T_thermal_depth, scan.thermal.depth_times_s
    if scan.color is not None and scan.rig.color is not None and scan.rig.T_color_depth is not None:
        yield "color", scan.color, scan.rig.color, scan.rig.T_color_depth, scan.color.times_s


def depth_edges(depth_m: NDArray) -> Bool:
    """(H, W) pixels whose neighbour is farther by more than `EDGE_STEP` of the range, or unmeasured."""
    z = np.where(np.isfinite(depth_m), depth_m, np.inf).astype(np.float32)
    farthest = cv2.dilate(z, np.ones((3, 3), np.uint8))
    edge = np.isfinite(z) & (farthest > z * (1 + EDGE_STEP))
    edge[[0, -1], :] = edge[:, [0, -1]] = False
    return edge


def to_grey(image: NDArray) -> UInt8:
    """Any image (H, W) or (H, W, 3) as 8-bit grey (H, W), stretched from its 1st to its 99th percentile.

    For looking at, never for measuring.
    """
    if image.ndim == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    x = image.astype(np.float32)
    finite = x[np.isfinite(x)]
    lo, hi = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    return np.clip(np.nan_to_num((x - lo) / max(hi - lo, 1e-6) * 255), 0, 255).astype(np.uint8)


def best_shift(grey: UInt8, edges_px: Float, reach_px: int = REACH_PX) -> tuple[tuple[float, float], float]:
    """Shift (du, dv) px of edge points with the strongest image gradient under them, and its contrast.

    grey : (H, W). edges_px : (N, 2).
    """
    g = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.5)
    gradient = np.hypot(cv2.Sobel(g, cv2.CV_32F, 1, 0), cv2.Sobel(g, cv2.CV_32F, 0, 1))
    gradient = np.minimum(gradient, np.percentile(gradient, 97))  # one strong edge must not outvote the outline
    h, w = grey.shape
    u, v = np.rint(edges_px).astype(int).T
    inside = (u >= reach_px) & (u < w - reach_px) & (v >= reach_px) & (v < h - reach_px)
    u, v = u[inside], v[inside]
    if len(u) < 50 or gradient.max() == 0:
        return (0.0, 0.0), 1.0
    span = np.arange(-reach_px, reach_px + 1)
    score = np.array([[gradient[v + dv, u + du].mean() for du in span] for dv in span])
    score = cv2.GaussianBlur(score, (0, 0), 1.0)
    j, i = np.unravel_index(int(score.argmax()), score.shape)
    return (float(span[i]), float(span[j])), float(score.max() / score.mean())


def _motion(scan: Scan, to_s: float, from_s: float) -> Float:
    """T_depth(to)_depth(from) by the recorded trajectory; identity where there is none."""
    if scan.trajectory is None or to_s == from_s:
        return np.eye(4)
    T, valid = interpolate_trajectory(scan.trajectory, np.array([to_s, from_s]))
    return invert(T[0]) @ T[1] if valid.all() else np.eye(4)


def _project_edges(depth_camera: Camera, depth_m: NDArray, camera: Camera, T_other_depth: Float) -> Float:
    """(N, 2) pixels of the depth edges in another camera's image (those that fall inside it)."""
    v, u = np.nonzero(depth_edges(depth_m))
    z = depth_m[v, u].astype(np.float64)
    K = depth_camera.K
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=1)
    uv, _ = project(camera, transform_points(T_other_depth, points))
    uv = uv[np.isfinite(uv).all(1)]
    inside = (uv >= 0).all(1) & (uv[:, 0] <= camera.width_px - 1) & (uv[:, 1] <= camera.height_px - 1)
    return uv[inside]


def _draw(image: NDArray, edges_px: Float) -> UInt8:
    picture = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image.copy()
    u, v = np.rint(edges_px).astype(int).T
    picture[v, u] = _GREEN
    return picture


def _upright(picture: UInt8, up: Float) -> UInt8:
    """A picture (H, W, 3) turned by quarters, so that a direction `up` (3,) of its camera points upward."""
    turns = int(np.argmax([-up[1], up[0], up[1], -up[0]]))
    return np.ascontiguousarray(np.rot90(picture, turns))
