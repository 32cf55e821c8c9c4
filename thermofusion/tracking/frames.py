"""Depth frames as tracking uses them: coarser, the subject alone, with the colour camera's texture where it helps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..depth.filter import DepthFrames, read_ahead
from ..depth.loops import coarser
from ..depth.subject import SubjectFrames
from ..geometry.camera import project
from ..geometry.rigid import transform_points
from ..recipe import InputSection, SubjectSection, TrackingSection
from ..scans.pairing import pair_color
from ..types import Float, Float32, Int, Scan
from .maps import DepthMap, Intrinsics

WIDTH_PX = 320  # images are brought down to about this width
SAMPLES = 3000  # points of a frame that are registered
MIN_VALID_SHARE = 0.01  # a frame with fewer valid pixels shows nothing
CELL_SPREAD = 0.03  # relative: pixels of one cell that differ more see two surfaces
TEXTURE_WINDOW_PX = 15  # of the coarse colour image: intensity is what differs from the mean over this
CONTRAST_FLOOR = 3.0  # grey levels of local contrast below which texture fades to nothing
PROBES = 5  # frames that tell distance and shape beforehand
NEAR_M = 0.7  # nearer subjects are zoomed to 1 m: they are small, and so must every distance be that matters
SLIDES_BELOW = 0.1  # `stiffness_of` cylinders, spheres and bowls is 0.06 (what noise pretends), of bodies 0.13 to 0.35


@dataclass(frozen=True, eq=False)
class TrackingFrame:
    """A depth frame as tracking uses it: coarse, subject only.

    index : position in the depth stream. depth_m : (H, W) float32, NaN = none. map : its points, normals, texture.
    floor : (4,) `[n, d]` in the frame's camera, n·p + d = height in m, or None where none was seen.
    """

    index: int
    time_s: float
    depth_m: Float32
    map: DepthMap
    floor: Float | None

    @property
    def empty(self) -> bool:
        return bool(np.isfinite(self.depth_m).mean() < MIN_VALID_SHARE)


@dataclass(frozen=True, eq=False)
class TrackingFrames:
    """Loads frames, ahead on threads.

    scan, subject : the recording, and its full frames. step : edge of a cell of full pixels that becomes one coarse
    pixel. intrinsics : (fx, fy, cx, cy) of the coarse images.
    slides : the shape alone leaves some motion free, as a cylinder's turn about its axis. color_of : (N,) position in
    the colour stream of every depth frame's picture, -1 = none, where texture has to help and there is some; or None.
    zoom : depth is multiplied by it, so that a limit means the same for a toy at 30 cm as for a person at 1 m.
    """

    scan: Scan
    subject: SubjectFrames
    step: int
    intrinsics: Intrinsics
    slides: bool = False
    color_of: Int | None = None
    zoom: float = 1.0

    @classmethod
    def of(
        cls,
        scan: Scan,
        *,
        input: InputSection,
        subject: SubjectSection,
        tracking: TrackingSection,
        depth: DepthFrames | None = None,
    ) -> TrackingFrames:
        """Of a recording; a few probes tell its distance and whether its shape slides."""
        full = SubjectFrames(scan, input=input, subject=subject, depth=depth)
        s = max(1, round(full.camera.width_px / WIDTH_PX))
        K = full.camera.K
        # the centre of a cell of s x s pixels lies (s - 1)/2 from its first pixel's centre
        cx, cy = (K[0, 2] - (s - 1) / 2) / s, (K[1, 2] - (s - 1) / 2) / s
        frames = cls(scan, full, s, (K[0, 0] / s, K[1, 1] / s, cx, cy))
        probes = [frames.load(i) for i in _probes(scan)]
        near = [float(np.nanmedian(f.depth_m)) for f in probes if not f.empty]
        zoom = 1 / float(np.median(near)) if near and np.median(near) < NEAR_M else 1.0
        stiffness = [k for f in probes if np.isfinite(k := stiffness_of(f.map))]
        slides = bool(stiffness and np.median(stiffness) < SLIDES_BELOW)
        helped = slides and tracking.color and scan.color is not None
        color_of = pair_color(scan, input.pair_tolerance_ms).color_index if helped else None
        return replace(frames, slides=slides, color_of=color_of, zoom=zoom)

    def load(self, i: int) -> TrackingFrame:
        """Frame i of the depth stream."""
        full, floor = self.subject.load(i)
        depth = coarse_depth(full, self.step) * np.float32(self.zoom)
        depth_map = DepthMap.of(depth, self.intrinsics, SAMPLES, self._intensity(i, depth))
        return TrackingFrame(i, float(self.scan.depth.times_s[i]), depth, depth_map, floor)

    def read_ahead(self, indices: NDArray[np.intp]) -> Iterator[TrackingFrame]:
        """The frames at positions (N,) of the depth stream, in that order, a few prepared ahead."""
        return read_ahead(self.load, indices.tolist())

    def _intensity(self, i: int, depth: Float32) -> Float32 | None:
        """Local contrast of the colour image at every depth pixel, about 1 in spread; NaN where there is none."""
        rig, stream = self.scan.rig, self.scan.color
        if self.color_of is None or stream is None or rig.color is None or rig.T_color_depth is None:
            return None
        if (color := int(self.color_of[i])) < 0:
            return None
        grey = cv2.cvtColor(stream.load(color), cv2.COLOR_RGB2GRAY).astype(np.float32)
        step = max(1, round(grey.shape[1] / WIDTH_PX))
        contrast = local_contrast(grey, step)
        fx, fy, cx, cy = self.intrinsics
        v, u = np.nonzero(np.isfinite(depth))
        z = depth[v, u] / np.float32(self.zoom)
        points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1).astype(np.float32)
        uv, _ = project(rig.color, transform_points(rig.T_color_depth, points))
        uv = ((uv - (step - 1) / 2) / step).astype(np.float32)
        out = np.full(depth.shape, np.nan, np.float32)
        on_image = np.full((2, *depth.shape), -10, np.float32)
        on_image[:, v, u] = np.nan_to_num(uv.T, nan=-10)
        cv2.remap(contrast, on_image[0], on_image[1], cv2.INTER_LINEAR, out, cv2.BORDER_CONSTANT, float("nan"))
        return out


def _probes(scan: Scan) -> list[int]:
    """A few usable frames, spread through the recording."""
    usable = np.flatnonzero(scan.depth.usable)
    return usable[np.linspace(0, len(usable) - 1, min(PROBES, len(usable))).astype(int)].tolist()


def coarse_depth(depth_m: Float32, step: int) -> Float32:
    """Mean of depth_m (H, W) over cells of `step` x `step` pixels: (H // step, W // step) m.

    NaN where less than half of a cell is valid or two surfaces meet.
    """
    return depth_m if step == 1 else np.asarray(coarser(depth_m, step, CELL_SPREAD))


def local_contrast(grey: Float32, step: int) -> Float32:
    """(I - local mean) / local spread of `grey` (H, W) reduced by `step`: what light and exposure leave unchanged."""
    size = (grey.shape[1] // step, grey.shape[0] // step)
    image = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    window = (TEXTURE_WINDOW_PX, TEXTURE_WINDOW_PX)
    mean = cv2.blur(image, window)
    spread = np.sqrt(np.maximum(cv2.blur(image * image, window) - mean * mean, 0))
    return np.asarray((image - mean) / (spread + np.float32(CONTRAST_FLOOR)))


def stiffness_of(depth_map: DepthMap) -> float:
    """How well a shape holds itself in place: root of the smallest eigenvalue of the normal equations per point, with
    turns measured at the shape's own radius. 0 for a sphere, a cylinder, a plane; NaN for nothing.
    """
    p, n = depth_map.sample, depth_map.sample_normals
    if len(p) < 100:
        return float("nan")
    p = p - p.mean(0)
    radius = np.sqrt((p**2).sum(1).mean())
    J = np.concatenate([np.cross(p / radius, n), n], axis=1)
    return float(np.sqrt(max(np.linalg.eigvalsh(J.T @ J / len(J))[0], 0)))
