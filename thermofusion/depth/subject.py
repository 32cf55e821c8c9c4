"""What in a depth image is subject, and what is room: floor plane, background behind the subject, what does not move.

A floor looks the same from everywhere and a wall nearly so: left in view they hold point-to-plane odometry in place
while the camera walks (820 mm adrift on a whole-body scan, 4 mm without them). They go before tracking.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import pixel_rays
from ..geometry.plane import floor_in_view
from ..recipe import InputSection, SubjectSection
from ..types import Bool, Camera, Float, Float32, Scan
from .filter import DepthFrames, read_ahead

GRID = 80  # planes are looked for on about this many pixels of a row, and as densely along columns
TRACKING_CLEARANCE_M = 0.03  # at 1 m and beyond: tracking is better off without what is this near to the floor
JUMP_AT_1M = 0.05  # depth step between neighbours (times range) that separates two things
BEHIND_M = 0.30  # at 1 m and beyond: clear air between subject and background
BEHIND_SHARE = 0.9  # of a piece's pixels: the rest may be flying ones
PIECES_PX = 160  # pieces are looked for on about this many pixels of a row
STATIC_FRAMES = 24  # spread through the recording: enough for a quantile of each pixel's depths
STATIC_SPREAD_AT_1M = 0.01  # a pixel whose depth stays within this (times range²) shows something that does not move
STATIC_QUANTILE = 0.85  # of a pixel's depths: its far end, without the farthest outliers
ALWAYS_SHARE, ALWAYS_AREA = 0.8, 0.2  # a piece of room: a fifth of its pixels show it in four of five frames
STATIC_SHARE = 0.3  # of frames in which a pixel must see the room at its far end


class SubjectFrames:
    """Depth frames in which only the subject is left.

    Attributes
    ----------
    camera : pinhole camera of the images.
    """

    def __init__(
        self, scan: Scan, *, input: InputSection, subject: SubjectSection, depth: DepthFrames | None = None
    ) -> None:
        """depth : the scan's frames, if they are at hand."""
        self._frames, self._subject = DepthFrames(scan, input) if depth is None else depth, subject
        self.camera: Camera = self._frames.camera
        rays = pixel_rays(self.camera)
        self._rays: Float32 = (rays / rays[..., 2:]).astype(np.float32)
        self._static = static_scene(self._frames) if subject.motion == "subject" else None

    def grown(self, scan: Scan) -> SubjectFrames:
        """The frames of a scan that continues this one; where the subject turns, the room of before."""
        more = copy.copy(self)
        more._frames = self._frames.grown(scan)
        return more

    @property
    def depth(self) -> DepthFrames:
        """All depth that is believed."""
        return self._frames

    def load(self, i: int) -> tuple[Float32, Float | None]:
        """Frame i: depth (H, W) float32 m, NaN = not the subject; and the floor (4,) found in it and taken away."""
        depth = self._frames.load(i)
        floor = None if self._subject.floor == "keep" else find_floor(depth, self._rays)
        if floor is not None:
            height = (self._rays @ floor[:3].astype(np.float32)) * depth + np.float32(floor[3])
            depth = np.where(height > TRACKING_CLEARANCE_M * np.minimum(1, depth), depth, np.float32(np.nan))
        if self._static is not None:
            room = depth > self._static - static_tolerance(self._static)
            depth = np.where(room, np.float32(np.nan), depth)
        if self._subject.background == "remove":
            depth[behind_subject(depth)] = np.nan
        return depth, floor

    def read_ahead(self, frames: Sequence[int]) -> Iterator[tuple[int, Float32]]:
        """(i, depth (H, W) m of frame i) in the order given, a few frames ahead on threads."""
        return ((i, depth) for i, (depth, _) in zip(frames, read_ahead(self.load, frames), strict=True))


def find_floor(depth_m: Float32, rays: Float32) -> Float | None:
    """The floor (4,) `[n, d]` in depth_m (H, W), or None: n·p + d is the height in m of a point of the camera's
    frame above it. rays : (H, W, 3) directions with z = 1. Looked for on a grid of pixels (see `floor_in_view`).
    """
    step = max(1, round(depth_m.shape[1] / GRID))
    z = depth_m[::step, ::step].ravel()
    valid = np.isfinite(z)
    return floor_in_view(rays[::step, ::step].reshape(-1, 3)[valid] * z[valid, None])


def behind_subject(depth_m: Float32) -> Bool:
    """Pixels (H, W) of things that stand clear behind the subject.

    The image falls into pieces at depth steps; the subject is the piece that is largest, nearness and centrality
    weighed in; pieces that begin `BEHIND_M` behind its end are background.
    """
    step = max(1, round(depth_m.shape[1] / PIECES_PX))
    small = depth_m[::step, ::step]
    labels, n = _pieces(small)
    if n <= 1:
        return np.zeros(depth_m.shape, bool)
    v, u = np.nonzero(labels)
    label, z = labels[v, u], small[v, u]
    h, w = small.shape
    weight = np.exp(-(((u - w / 2) / (w / 2)) ** 2) - 0.25 * ((v - h / 2) / (h / 2)) ** 2) / z**2
    subject = int(np.argmax(np.bincount(label, weight * z**2, n + 1) * _nearness(label, z, n)))
    far = float(np.percentile(z[label == subject], 98))
    behind = far + BEHIND_M * min(1.0, far)
    count = np.maximum(np.bincount(label, minlength=n + 1), 1)
    background = np.bincount(label, z > behind, n + 1) > BEHIND_SHARE * count
    mask = background[labels].astype(np.uint8)
    if not mask.any():
        return np.zeros(depth_m.shape, bool)
    big = cv2.resize(mask, (step * w, step * h), interpolation=cv2.INTER_NEAREST)[
        : depth_m.shape[0], : depth_m.shape[1]
    ]
    grown = cv2.dilate(big, np.ones((step + 3, step + 3), np.uint8)).astype(bool)
    return np.asarray(grown & (depth_m > behind))


def _nearness(label: NDArray, z: Float32, n: int) -> Float:
    """Factor per piece that prefers near ones: 1/z² of its mean depth."""
    count = np.maximum(np.bincount(label, minlength=n + 1), 1)
    mean = np.bincount(label, z, n + 1) / count
    return 1 / np.maximum(mean, 0.1) ** 2


def _pieces(depth_m: Float32) -> tuple[NDArray, int]:
    """Connected pieces of a depth image, cut at depth steps: labels (H, W), 0 = none; and their number."""
    z = np.nan_to_num(depth_m)
    step = np.float32(JUMP_AT_1M) * np.maximum(z, 0.3)
    cut = np.zeros(z.shape, bool)
    cut[:, 1:] |= np.abs(np.diff(z, axis=1)) > step[:, 1:]
    cut[1:] |= np.abs(np.diff(z, axis=0)) > step[1:]
    n, labels = cv2.connectedComponents(((z > 0) & ~cut).astype(np.uint8), connectivity=4)
    return labels, n - 1


def static_scene(frames: DepthFrames) -> Float32:
    """Depth (H, W) of what does not move while the subject turns before a standing camera; NaN = not known.

    Of a pixel's depths over frames spread through the recording, the far end is the room behind the subject where the
    pixel came back to it often enough. A pixel that always saw the turning subject comes back to no depth.
    """
    picked: Sequence[int] = np.unique(np.linspace(0, len(frames) - 1, STATIC_FRAMES).astype(int)).tolist()
    stack = np.sort(np.stack([d[::2, ::2] for _, d in frames.read_ahead(picked)]), axis=0)  # NaN comes last
    seen = np.isfinite(stack).sum(0)
    far = np.take_along_axis(
        stack, np.maximum((STATIC_QUANTILE * seen).astype(int), 0)[None].clip(max=len(stack) - 1), 0
    )[0]
    returns = (np.abs(stack - far) < static_tolerance(far)).sum(0)
    needed = max(2, int(np.ceil(STATIC_SHARE * len(stack))))
    often = (seen >= 2) & (returns >= np.minimum(needed, seen))
    # The subject's own pixels come back by chance here and there; the room hangs together with what was always seen.
    labels, n = _pieces(np.where(often, far, np.float32(np.nan)))
    size = np.maximum(np.bincount(labels.ravel(), minlength=n + 1), 1)
    always = np.bincount(labels.ravel(), (returns >= ALWAYS_SHARE * len(stack)).ravel(), n + 1) / size
    room = np.where(often & (always > ALWAYS_AREA)[labels], far, np.float32(np.nan))
    h, w = frames.camera.shape
    return np.asarray(cv2.resize(room, (w, h), interpolation=cv2.INTER_NEAREST))


def static_tolerance(depth_m: Float32) -> Float32:
    """(H, W) m: within this of the standing room, `depth_m` (H, W) m, a pixel shows the room."""
    return np.float32(STATIC_SPREAD_AT_1M) * np.maximum(depth_m, np.float32(0.5)) ** 2
