"""The voxel grid: a truncated signed distance field (TSDF) that depth frames are averaged into.

Open3D's `VoxelBlockGrid` on the CPU, averaged by `average`. How many blocks a scan needs is estimated beforehand from
a sample of frames, so memory is known and bounded before it is taken; it still grows if the sample missed something.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ResourceError, ScanError
from ..geometry.rigid import invert
from ..progress import Progress, silent
from ..recipe import InputSection, SurfaceSection
from ..robust import SIGMA_PER_MAD
from ..types import Camera, Float, Float32, Scan
from .average import EDGE, VOXELS, Limits, Look, average_frame, pinhole_of

BYTES_PER_BLOCK = VOXELS * (8 + 16)  # tsdf and weight, plus the table that mesh extraction builds
SURVEY_FRAMES, SURVEY_SHARE = 16, 1 / 12  # enough for ranges, noise and extent
NOISE_M_AT_1M = 1.425e-3  # Kinect v1 depth noise is about this times z² (Khoshelham & Elberink 2012)
NOISE_BOUNDS = (0.4e-3, 6e-3)  # of the coefficient estimated from the data
VOXEL_PER_NOISE, VOXEL_PER_FOOTPRINT = 1.8, 0.8  # finer voxels than this hold noise, or what no thermal pixel resolves
VOXEL_BOUNDS_M = (2e-3, 5e-3)  # many frames average noise that one frame drowns in: fingers and toes stay
TRUNCATION_PER_NOISE = 3.5  # noise is averaged, not cut; what is thinner than the truncation (a finger) swells
FAR_NOISE_PER_TRUNCATION = 0.5  # depth noisier than this share of the truncation would only blur
FAR_PER_MEDIAN = 1.3  # but nothing nearer than this share of the median range is given up
MIN_TRUNCATION_VOXELS, MIN_TRUNCATION_M = 2.5, 8e-3  # poses are rarely better than 2 mm
MAX_VOXEL_M = 0.1  # larger ones hold no body: then the memory allowed is refused
ESTIMATE_MARGIN = 1.1  # of the estimated blocks: the table should not have to grow
TOUCH_STRIDE_PX, TOUCHES_PER_BLOCK = 4, 3  # Open3D looks along every fourth ray; three through a block find it
GROWTH = 1.3  # of the block table, each time it is full


class Frames(Protocol):
    """Where depth images come from: `DepthFrames`, or one that also masks the background."""

    camera: Camera

    def read_ahead(self, frames: Sequence[int]) -> Iterator[tuple[int, Float32]]:
        """(i, depth (H, W) m of frame i) in the order given."""


@dataclass(frozen=True, eq=False)
class FramePoses:
    """Depth frames that have a pose. frame : (N,) position in the depth stream; T_world_depth : (N, 4, 4)."""

    frame: NDArray[np.int64]
    T_world_depth: Float


# ---------------------------------------------------------------- survey and plan


@dataclass(frozen=True, eq=False)
class Survey:
    """What a sample of frames tells beforehand."""

    camera: Camera
    depth: tuple[Float32, ...]
    T_world_depth: Float
    median_range_m: float
    noise_m_at_1m: float


@dataclass(frozen=True, eq=False)
class GridPlan:
    """The grid to be made."""

    voxel_m: float
    truncation_m: float
    max_range_m: float
    blocks: int
    max_blocks: int
    messages: tuple[str, ...]


def survey_depth(scan: Scan, frames: Frames, poses: FramePoses) -> Survey:
    """Look at a few frames, evenly spread. Raises ScanError if none holds depth within the recipe's range."""
    count = int(np.clip(SURVEY_SHARE * len(poses.frame), SURVEY_FRAMES, 4 * SURVEY_FRAMES))
    pick = np.unique(np.linspace(0, len(poses.frame) - 1, count).astype(int))
    depth = tuple(d for _, d in frames.read_ahead(poses.frame[pick].tolist()))
    ranges = np.concatenate([d[::4, ::4].ravel() for d in depth])
    ranges = ranges[np.isfinite(ranges)]
    if len(ranges) == 0:
        raw = scan.depth.load(int(poses.frame[pick[len(pick) // 2]]))
        seen = f"it lies at {np.nanmin(raw):.3g} to {np.nanmax(raw):.3g} m" if np.isfinite(raw).any() else "it is empty"
        raise ScanError(
            f"no depth is left within input.min_depth_m and input.max_depth_m: {seen}",
            place=scan.depth.places[int(poses.frame[pick[len(pick) // 2]])],
            hint="check depth_unit_m",
        )
    return Survey(frames.camera, depth, poses.T_world_depth[pick], float(np.median(ranges)), depth_noise(depth))


def depth_noise(images: tuple[Float32, ...] | list[Float32]) -> float:
    """Depth noise of images (H, W) m, one sigma in metres at 1 m, growing with range² as a triangulating camera's does.

    From third differences over 3 px, in which neither slope nor curvature of the surface is left, and noise that is
    correlated over a pixel or two is whole: -z(u) + 3 z(u+3) - 3 z(u+6) + z(u+9) has variance 20 σ². Median absolute
    deviation, so edges do not count.
    """
    r = []
    for d in images:
        z = d[::2]
        q = (z[:, 9:] - z[:, :-9] + 3 * (z[:, 3:-6] - z[:, 6:-3])) / z[:, 3:-6] ** 2
        r.append(q[np.isfinite(q)])
    values = np.concatenate(r)
    if len(values) < 1000:
        return NOISE_M_AT_1M
    return float(np.clip(SIGMA_PER_MAD * np.median(np.abs(values)) / np.sqrt(20), *NOISE_BOUNDS))


def plan_grid(scan: Scan, survey: Survey, *, input: InputSection, surface: SurfaceSection) -> GridPlan:
    """Voxel, truncation and blocks within the memory allowed: the voxel grows until it fits."""
    wanted = voxel = _voxel(scan, survey, surface)
    max_blocks = int(surface.max_memory_gib * 2**30 / BYTES_PER_BLOCK)
    while True:
        plan = _with_truncation(voxel, survey, input, surface, max_blocks)
        blocks = _estimate_blocks(survey, plan)
        if blocks <= max_blocks:
            break
        if voxel > MAX_VOXEL_M:
            raise ResourceError(
                f"even voxels of {1e3 * voxel:.0f} mm need more than {surface.max_memory_gib:g} GiB",
                place="fusion.max_memory_gib",
                hint="allow more memory, or check that poses and depth are in metres",
            )
        voxel *= 1.1
    messages = () if voxel == wanted else (_coarsened(wanted, voxel, surface),)
    return replace(plan, blocks=blocks, messages=messages)


def _coarsened(wanted_m: float, voxel_m: float, surface: SurfaceSection) -> str:
    return (
        f"voxels of {1e3 * wanted_m:.1f} mm would need more than fusion.max_memory_gib = "
        f"{surface.max_memory_gib:g}; {1e3 * voxel_m:.1f} mm were used"
    )


def _voxel(scan: Scan, survey: Survey, surface: SurfaceSection) -> float:
    """Edge of a voxel [m]: the recipe's, or no finer than depth noise and the thermal camera's footprint support."""
    if surface.voxel_mm != "auto":
        return surface.voxel_mm / 1e3
    z = survey.median_range_m
    footprint = 0.0 if scan.thermal is None else z / scan.thermal.camera.lens.focal_px
    return float(
        np.clip(max(VOXEL_PER_NOISE * survey.noise_m_at_1m * z**2, VOXEL_PER_FOOTPRINT * footprint), *VOXEL_BOUNDS_M)
    )


def _with_truncation(
    voxel: float, survey: Survey, input: InputSection, surface: SurfaceSection, max_blocks: int
) -> GridPlan:
    """Truncation and far limit that go with a voxel and the noise at the subject's distance."""
    z, noise = survey.median_range_m, survey.noise_m_at_1m
    if surface.truncation_voxels == "auto":
        truncation = max(MIN_TRUNCATION_VOXELS * voxel, MIN_TRUNCATION_M, TRUNCATION_PER_NOISE * noise * z**2)
    else:
        truncation = surface.truncation_voxels * voxel
    far = max(float(np.sqrt(FAR_NOISE_PER_TRUNCATION * truncation / noise)), FAR_PER_MEDIAN * z)
    return GridPlan(voxel, truncation, min(far, input.max_depth_m), 0, max_blocks, ())


def _estimate_blocks(survey: Survey, plan: GridPlan) -> int:
    """Blocks the whole scan will touch, from those that the sampled frames touch.

    If doubling the sample from half to whole added g blocks, doubling it again and again adds g/2 + g/4 + ... = g.
    """
    grid = VoxelGrid(survey, plan, 1)
    touched = [grid.touch(d, T) for d, T in zip(survey.depth, survey.T_world_depth, strict=True)]
    half, whole = _count_unique(touched[::2]), _count_unique(touched)
    return int(ESTIMATE_MARGIN * (2 * whole - half))


def _count_unique(blocks: list[NDArray[np.int32]]) -> int:
    xyz = np.concatenate(blocks).astype(np.int64) + 2**20
    return len(np.unique((xyz[:, 0] << 42) | (xyz[:, 1] << 21) | xyz[:, 2]))


# ---------------------------------------------------------------- the grid


class VoxelGrid:
    """A truncated signed distance field in blocks of 8³ voxels, each holding distance and weight as float32."""

    def __init__(self, survey: Survey, plan: GridPlan, capacity: int) -> None:
        from ..geometry._open3d import o3d

        self._o3d, self._plan = o3d, plan
        one = ((1,), (1,))
        float32 = (o3d.core.float32, o3d.core.float32)
        cpu = o3d.core.Device("CPU:0")
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"), float32, one, plan.voxel_m, EDGE, max(capacity, 1), cpu
        )
        # Open3D takes the pixel whose index is floor(u), which puts the first pixel's centre at (0.5, 0.5). Ours is at
        # (0, 0). Without the shift surfaces lie half a pixel aside: 0.43 instead of 0.23 mm mean error at 1.1 m.
        K = survey.camera.K.copy()
        K[:2, 2] += 0.5
        self._pinhole = pinhole_of(K)
        self._multiplier = plan.truncation_m / plan.voxel_m
        voxel_m = np.float32(plan.voxel_m)
        self._limits = Limits(voxel_m, voxel_m * np.float32(self._multiplier), np.float32(plan.max_range_m))
        # Open3D looks for blocks along every fourth pixel's ray. A coarse image is enlarged for that: else the corner
        # of a block slips through between rays in most frames, and is a hole in the end.
        stride_m = TOUCH_STRIDE_PX * survey.median_range_m / survey.camera.focal_px
        self._enlarge = max(1, int(np.ceil(TOUCHES_PER_BLOCK * stride_m / (EDGE * plan.voxel_m))))
        K_touch = K.copy()
        K_touch[:2] *= self._enlarge
        self._K_touch = o3d.core.Tensor(K_touch)

    @property
    def blocks(self) -> int:
        """Blocks in use."""
        return int(self._grid.hashmap().size())

    def touch(self, depth_m: Float32, T_world_depth: Float) -> NDArray[np.int32]:
        """(N, 3) coordinates, in blocks, of what is within the truncation of a frame's surface.

        depth_m : (H, W), NaN = none. T_world_depth : (4, 4).
        """
        depth = self._depth(depth_m)
        return self._blocks(depth, self._o3d.core.Tensor(invert(T_world_depth))).numpy()

    def integrate(self, depth_m: Float32, T_world_depth: Float) -> bool:
        """Average a frame, depth_m (H, W) at T_world_depth (4, 4), into the field. A depth below 0 is a look past the
        subject: it empties what is nearer and asks for no surface where it ends.

        False, with the field unchanged, if that needs more blocks than allowed. The table is enlarged before the blocks
        go in: one that overflows while they do loses blocks, and the surface gets holes.
        """
        T_depth_world = invert(T_world_depth)
        whole, extrinsic = self._depth(depth_m), self._o3d.core.Tensor(T_depth_world)
        depth = whole
        if whole.min() < 0:
            depth, whole = np.maximum(whole, np.float32(0)), np.abs(whole)
        blocks, table = self._blocks(depth, extrinsic), self._grid.hashmap()
        if len(blocks) == 0:
            return True
        if table.size() + len(blocks) > table.capacity():
            needed = table.size() + int((~table.find(blocks)[1].numpy()).sum())
            if needed > self._plan.max_blocks:
                return False
            if needed > 0.95 * table.capacity():
                table.reserve(int(max(needed, table.capacity()) * GROWTH) + 8)
        table.activate(blocks)
        distance, weight = (self._grid.attribute(name).numpy().reshape(-1, VOXELS) for name in ("tsdf", "weight"))
        look = Look(whole, T_depth_world.astype(np.float32), self._pinhole)
        average_frame(look, self._limits, blocks.numpy(), table.find(blocks)[0].numpy(), distance, weight)
        return True

    def extract(self, min_weight: float) -> tuple[Float32, NDArray[np.int32]]:
        """Vertices (V, 3) m and triangles (F, 3) of the zero level where it was seen at least `min_weight` times."""
        if self.blocks == 0:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
        try:  # Open3D wants weights *above* its threshold; they are whole numbers here.
            mesh = self._grid.extract_triangle_mesh(weight_threshold=min_weight - 0.5)
        except RuntimeError as e:
            if "has shape {0}" not in str(e):  # how it says that there is no surface
                raise
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
        if "indices" not in mesh.triangle or "positions" not in mesh.vertex:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
        return mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()

    def _depth(self, depth_m: Float32) -> Float32:
        return np.where(depth_m <= self._plan.max_range_m, depth_m, np.float32(0))  # Open3D's "none" is 0

    def _blocks(self, depth: Float32, extrinsic: Any) -> Any:
        """Coordinates (N, 3) of the blocks near the surface, looked for a voxel farther than will be filled."""
        core = self._o3d.core
        if not depth.any():
            return core.Tensor(np.zeros((0, 3), np.int32))
        fine: NDArray[Any] = depth
        if self._enlarge > 1:
            fine = cv2.resize(depth, None, fx=self._enlarge, fy=self._enlarge, interpolation=cv2.INTER_NEAREST)
        image = self._o3d.t.geometry.Image(core.Tensor(fine))
        try:
            return self._grid.compute_unique_block_coordinates(
                image, self._K_touch, extrinsic, 1.0, self._plan.max_range_m, self._multiplier + 1
            )
        except RuntimeError as e:
            if "No block is touched" not in str(e):
                raise
            return core.Tensor(np.zeros((0, 3), np.int32))  # depth too scattered for Open3D's sparse look at it


def integrate_frames(
    survey: Survey,
    frames: Frames,
    poses: FramePoses,
    plan: GridPlan,
    *,
    input: InputSection,
    surface: SurfaceSection,
    progress: Progress = silent,
) -> tuple[VoxelGrid, GridPlan]:
    """All frames into a grid. Should the estimate have been far too low, once more with coarser voxels."""
    while True:
        grid, full = VoxelGrid(survey, plan, min(plan.blocks, plan.max_blocks)), False
        for n, (_, depth) in enumerate(frames.read_ahead(poses.frame.tolist())):
            if not grid.integrate(depth, poses.T_world_depth[n]):
                full = True
                break
            progress("surface", n + 1, len(poses.frame))
        if not full:
            return grid, plan
        coarser = _with_truncation(1.25 * plan.voxel_m, survey, input, surface, plan.max_blocks)
        message = _coarsened(plan.voxel_m, coarser.voxel_m, surface)
        plan = replace(coarser, blocks=plan.max_blocks, messages=(*plan.messages, message))
