"""Which depth is believed: range, grazing incidence, flying pixels; and depth images freed of lens distortion.

No Open3D, no files. Tracking and fusion both look at depth through `DepthFrames`.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import distort
from ..recipe import InputSection
from ..types import Bool, Camera, Float32, Scan
from .loops import blot_out, cell_means, from_steps, in_steps, near_enough

MIN_NEIGHBOURS = 3  # of 8: what the corner of a surface still has, and a one-pixel veil between two surfaces has not
CELL_PX = 4  # slopes are taken between means over squares of this size: single pixels carry only noise
MIN_CELL_SHARE = 0.25  # of a cell's pixels that must hold depth
READERS = 2  # threads that decode frames ahead
KEPT_BYTES = 128 << 20  # of images that are not decoded twice


def filter_depth(depth_m: Float32, camera: Camera, section: InputSection) -> Float32:
    """Depth with everything dropped that a structured-light or time-of-flight camera does not measure well.

    depth_m : (H, W) float32, metres along z, NaN = none. Returns a new array of the same kind.

    - range: outside `min_depth_m` .. `max_depth_m`;
    - flying pixels: fewer than 3 of the 8 neighbours lie within `flying_pixel_mm` (at 1 m; scales with range², as a
      triangulating camera's depth step does), so veils between surfaces and speckles go and edges stay;
    - grazing: the surface, a plane fitted to the surroundings, is seen at more than `max_grazing_deg`.

    The camera's lens distortion is neglected in the angle (a degree at most); see `DepthUndistorter` for the pixels.
    """
    limits = section.min_depth_m, section.max_depth_m, section.flying_pixel_mm * 1e-3, MIN_NEIGHBOURS
    depth: Float32
    depth, top, bottom, left, right = near_enough(depth_m, *limits)
    if bottom > top and section.max_grazing_deg < 90:
        box = slice(top, bottom), slice(left, right)
        oblique = _oblique(depth[box], camera, box, float(np.cos(np.radians(section.max_grazing_deg))))
        blot_out(depth[box], oblique, CELL_PX)
    return depth


def bounding_box(depth: Float32) -> tuple[slice, slice] | None:
    """The rows and columns that hold any depth: a person fills a third of the image, so most work is saved."""
    valid = depth == depth  # False where NaN
    rows, cols = np.flatnonzero(valid.any(1)), np.flatnonzero(valid.any(0))
    if len(rows) == 0:
        return None
    return slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)


def _oblique(depth: Float32, camera: Camera, box: tuple[slice, slice], min_cos: float) -> Bool:
    """Cells of pixels whose surface is turned away by more than arccos(min_cos) from their rays.

    On a plane A X + B Y + C Z = 1 the inverse depth is linear over the image, 1/z = A x + B y + C, so two slopes of the
    inverse depth, averaged over cells, give the normal (A, B, C), and cosθ = (1/z) / (|n| |(x, y, 1)|).
    """
    mean: Float32 = cell_means(depth, CELL_PX, MIN_CELL_SHARE)
    rows, columns = mean.shape
    K = camera.K.astype(np.float32)
    middle = CELL_PX * np.arange(max(mean.shape), dtype=np.float32) + np.float32((CELL_PX - 1) / 2)
    x = ((middle[None, :columns] + box[1].start) - K[0, 2]) / K[0, 0]
    y = ((middle[:rows, None] + box[0].start) - K[1, 2]) / K[1, 1]
    A, B = _slope(mean) * K[0, 0], _slope(mean.T).T * K[1, 1]
    C = mean - A * x - B * y
    return np.asarray(mean**2 < min_cos**2 * (A**2 + B**2 + C**2) * (1 + x**2 + y**2))  # no slope (NaN) = no verdict


def _slope(cell: Float32) -> Float32:
    """Change per pixel along the rows of cell means: of the two one-sided slopes their mean, or the gentler at an edge.

    Beside a depth step one side looks across it: the gentler side is the surface itself. On a smooth surface the mean
    of both halves the noise. NaN where neither side has a neighbour.
    """
    step = np.diff(cell, axis=1) / np.float32(CELL_PX)
    none = np.full((len(cell), 1), np.nan, np.float32)
    before, after = np.hstack([none, step]), np.hstack([step, none])
    mean = np.float32(0.5) * (before + after)
    gentle = np.where(~(np.abs(after) >= np.abs(before)), after, before)  # also where `before` is empty
    gentle = np.where(np.isnan(gentle), before, gentle)
    return np.where(np.abs(mean) <= 2 * np.abs(gentle), mean, gentle)


class DepthUndistorter:
    """Depth images of a distorted camera as a pinhole camera with the same K would have taken them.

    The nearest pixel's depth is taken (interpolation would invent flying pixels between surfaces). Depth is measured
    along z, which distortion does not change. The table is built once; for a camera without distortion images pass
    through untouched.

    Attributes
    ----------
    camera : the pinhole camera of the images returned.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = Camera(camera.width_px, camera.height_px, camera.K)
        self._source: NDArray[np.intp] | None = None
        if not camera.is_distorted:
            return
        K, (h, w) = camera.K, camera.shape
        x, y = (np.arange(w) - K[0, 2]) / K[0, 0], (np.arange(h) - K[1, 2]) / K[1, 1]
        x_grid, y_grid = np.meshgrid(x, y)
        x_d, y_d = distort(x_grid, y_grid, camera.distortion)
        u, v = np.rint(K[0, 0] * x_d + K[0, 2]), np.rint(K[1, 1] * y_d + K[1, 2])
        self._outside = ~((u >= 0) & (u < w) & (v >= 0) & (v < h))
        u[self._outside] = v[self._outside] = 0
        self._source = v.astype(np.intp) * w + u.astype(np.intp)

    def __call__(self, depth_m: Float32) -> Float32:
        """(H, W) depth of the distorted camera -> (H, W) of the pinhole camera, NaN where it saw nothing."""
        if self._source is None:
            return depth_m
        out: Float32 = depth_m.ravel()[self._source]
        out[self._outside] = np.nan
        return out


class DepthFrames:
    """The depth stream as processing sees it: undistorted, filtered by the recipe.

    Attributes
    ----------
    camera : the pinhole camera of the images (no distortion).
    """

    def __init__(self, scan: Scan, section: InputSection, *, keep_bytes: int = 0) -> None:
        """keep_bytes : of images that stay in memory once they were loaded, for who looks at them again."""
        self._stream, self._section = scan.depth, section
        self._recorded_by, self._unit_m = scan.rig.depth, scan.depth_unit_m
        self._undistort = DepthUndistorter(scan.rig.depth)
        self.camera = self._undistort.camera
        self._room_bytes = keep_bytes
        self._kept: dict[int, tuple[tuple[slice, slice], NDArray]] = {}  # the part of each that holds depth

    def __len__(self) -> int:
        return len(self._stream)

    def continued_by(self, scan: Scan, section: InputSection) -> bool:
        """Whether these are the first frames of that scan, looked at in the same way: it may have more."""
        n, camera, own = len(self), scan.rig.depth, self._recorded_by
        same = camera.shape == own.shape and np.array_equal(camera.K, own.K)
        same = same and np.array_equal(camera.distortion, own.distortion) and scan.depth_unit_m == self._unit_m
        return same and section == self._section and np.array_equal(scan.depth.index[:n], self._stream.index)

    def grown(self, scan: Scan) -> DepthFrames:
        """The frames of a scan that continues this one (`continued_by`); what was kept stays."""
        more = copy.copy(self)
        more._stream = scan.depth
        return more

    def load(self, i: int) -> Float32:
        """Frame i: (H, W) float32 metres, NaN = none. Raises ScanError naming the file if it cannot be read."""
        if i in self._kept:
            box, kept = self._kept[i]
            depth: Float32 = np.full(self.camera.shape, np.nan, np.float32)
            if kept.dtype == np.float32:
                depth[box] = kept
            else:
                from_steps(kept, self._unit_m, depth[box])
            return depth
        depth = filter_depth(self._undistort(self._stream.load(i)), self.camera, self._section)
        if self._room_bytes > 0 and (found := bounding_box(depth)) is not None:
            steps = np.empty(depth[found].shape, np.uint16)  # as images are recorded: half the memory
            part: NDArray = steps if in_steps(depth[found], self._unit_m, steps) else depth[found].copy()
            self._kept[i] = found, part
            self._room_bytes -= part.nbytes
        return depth

    def read_ahead(self, frames: Sequence[int]) -> Iterator[tuple[int, Float32]]:
        """(i, depth (H, W) m of frame i) in the order given, a few frames decoded ahead on threads."""
        return zip(frames, read_ahead(self.load, frames), strict=True)


T = TypeVar("T")


def read_ahead(load: Callable[[int], T], indices: Iterable[int]) -> Iterator[T]:
    """load(i) for each index, in order, a few ahead on threads; never more in memory than that."""
    with ThreadPoolExecutor(READERS) as pool:
        todo = iter(indices)
        pending = deque(pool.submit(load, i) for i in islice(todo, 2 * READERS))
        while pending:
            result = pending.popleft()
            pending.extend(pool.submit(load, i) for i in islice(todo, 1))
            yield result.result()
