"""A rig with known truth, seen by noisy cameras: what every claim of the calibration is measured against."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thermofusion.calibration.board.board import Board
from thermofusion.calibration.board.views import BoardPoints, BoardView, CalibrationSet
from thermofusion.calibration.fit.cameras import rotations
from thermofusion.geometry.camera import distort, project
from thermofusion.geometry.rigid import pose, se3_exp
from thermofusion.types import Camera, Float

TRIES = 2000  # of a stand at one distance; nearer than some the board fits into no picture


def _camera(w: int, h: int, f: float, center: tuple[float, float], distortion: tuple[float, ...]) -> Camera:
    K = np.array([[f, 0, (w - 1) / 2 + center[0]], [0, f, (h - 1) / 2 + center[1]], [0, 0, 1.0]])
    return Camera(w, h, K, np.array(distortion))


@dataclass(frozen=True, eq=False)
class SimulatedRig:
    """Truth: three cameras and how they sit (`T_color_depth`, `T_thermal_depth`), and the board."""

    board: Board = field(default_factory=lambda: Board("pins", 9, 9, 0.05))
    color: Camera = field(default_factory=lambda: _camera(1280, 960, 1052.0, (8, -11), (0.05, -0.1, 0.001, -0.001, 0)))
    thermal: Camera = field(default_factory=lambda: _camera(640, 480, 800.0, (-6, 9), (-0.25, 0.2, 0.0, 0.001, 0)))
    depth: Camera = field(default_factory=lambda: _camera(640, 480, 585.0, (2, -1), (0, 0, 0, 0, 0)))
    T_color_depth: Float = field(
        default_factory=lambda: se3_exp(np.array([0.004, -0.006, 0.002, -0.025, 0.001, -0.003]))
    )
    T_thermal_depth: Float = field(default_factory=lambda: se3_exp(np.array([0.05, 0.02, -0.01, 0.01, -0.09, -0.02])))

    def camera(self, name: str) -> Camera:
        return {"color": self.color, "thermal": self.thermal, "depth": self.depth}[name]

    def T_camera_depth(self, name: str) -> Float:
        return {"color": self.T_color_depth, "thermal": self.T_thermal_depth, "depth": np.eye(4)}[name]


@dataclass(frozen=True)
class Noise:
    """px: one sigma of a picked point by camera. missing: share of pins not found. depth: m at 1 m, growing as range².
    wild: share of picks that are wrong by up to 20 px."""

    color_px: float = 0.25
    thermal_px: float = 0.35
    missing: float = 0.1
    wild: float = 0.0
    depth_m: float = 1.5e-3


def board_poses(rig: SimulatedRig, count: int, rng: np.random.Generator) -> list[Float]:
    """T_depth_board of stands as docs/calibration.md asks for: tilted by 20 to 45 deg to the left, right, up and down
    in turn, all over the pictures, at 0.9 to 1.8 m; the whole board in every picture."""
    w, h = rig.board.extent_m
    center = pose(np.eye(3), np.array([-w / 2, -h / 2, 0]))
    poses: list[Float] = []
    for i in range(count):
        for attempt in itertools.count():
            if attempt % TRIES == 0:
                z = rng.uniform(0.9, 1.8)
            side, tilt = np.radians(90 * i + rng.uniform(-30, 30)), np.radians(rng.uniform(20, 45))
            turn = rotations(np.array([[0, 0, np.radians(rng.uniform(-15, 15))]]))[0]
            R = rotations(np.array([[np.cos(side), np.sin(side), 0]]) * tilt)[0] @ turn
            T = pose(R, np.array([rng.uniform(-0.45, 0.45) * z, rng.uniform(-0.35, 0.35) * z, z])) @ center
            if all(_inside(rig, name, T) for name in ("thermal", "color", "depth")):
                poses.append(T)
                break
    return poses


def _inside(rig: SimulatedRig, name: str, T_depth_board: Float, margin_px: float = 6.0) -> bool:
    camera, T = rig.camera(name), rig.T_camera_depth(name) @ T_depth_board
    x, y, z = T[:3, :3] @ rig.board.outline_m(0.5).T + T[:3, 3:]
    if (z < 0.1).any() or (x**2 + y**2 > z**2).any():  # no camera here sees 45 deg off its axis
        return False
    x, y = distort(x / z, y / z, camera.distortion)
    uv = camera.K[:2, :2] @ np.stack([x, y]) + camera.K[:2, 2:]
    limit = np.array([[camera.width_px], [camera.height_px]]) - 1 - margin_px
    return bool((uv > margin_px).all() and (uv < limit).all())


def true_pixels(rig: SimulatedRig, name: str, T_depth_board: Float) -> Float:
    """(N, 2) exact pixels of all board points in one camera."""
    T, X = rig.T_camera_depth(name) @ T_depth_board, rig.board.points_m
    return project(rig.camera(name), X @ T[:3, :3].T + T[:3, 3])[0]


def simulate_set(
    rig: SimulatedRig, seed: int, *, views: int = 24, noise: Noise | None = None, with_depth: bool = True
) -> tuple[CalibrationSet, dict[str, Callable[[], NDArray]], list[Float]]:
    """What detectors would hand over: the views, depth image loaders by view name, and the true T_depth_board."""
    noise, rng = noise or Noise(), np.random.default_rng(seed)
    poses = board_poses(rig, views, rng)
    out, depth = [], {}
    for i, T in enumerate(poses):
        name, points = f"{i:04d}", {}
        for camera, sigma in (("color", noise.color_px), ("thermal", noise.thermal_px)):
            px = true_pixels(rig, camera, T) + rng.normal(0, sigma, (len(rig.board), 2))
            wild = rng.random(len(px)) < noise.wild
            px[wild] += rng.uniform(-20, 20, (wild.sum(), 2))
            kept = rng.random(len(px)) >= (noise.missing if camera == "thermal" else 0)
            points[camera] = BoardPoints(np.flatnonzero(kept), px[kept])
        out.append(BoardView(name, points))
        if with_depth:
            depth[name] = _depth_loader(rig, T, noise.depth_m, int(rng.integers(2**31)))
    sizes = {n: (rig.camera(n).width_px, rig.camera(n).height_px) for n in ("color", "thermal")}
    return CalibrationSet(rig.board, sizes, tuple(out)), depth, poses


def _depth_loader(rig: SimulatedRig, T: Float, noise_m: float, seed: int) -> Callable[[], NDArray]:
    return lambda: plane_depth(rig, T, noise_m, seed)


def plane_depth(rig: SimulatedRig, T_depth_board: Float, noise_m: float, seed: int) -> NDArray[np.float32]:
    """(H, W) metres: the board (0.7 spacings beyond its points) before a wall at 3 m, with range² noise; NaN never."""
    K = rig.depth.K.astype(np.float32)
    x = (np.arange(rig.depth.width_px, dtype=np.float32) - K[0, 2]) / K[0, 0]
    y = ((np.arange(rig.depth.height_px, dtype=np.float32) - K[1, 2]) / K[1, 1])[:, None]
    R, p = T_depth_board[:3, :3], T_depth_board[:3, 3]
    n = R[:, 2]
    z = np.float32(n @ p) / (np.float32(n[0]) * x + np.float32(n[1]) * y + np.float32(n[2]))
    across, down = ((R[0, k] * x + R[1, k] * y + R[2, k]) * z - R[:, k] @ p for k in (0, 1))
    w, h = rig.board.extent_m
    m = 0.7 * rig.board.spacing_m
    on = (across > -m) & (across < w + m) & (down > -m) & (down < h + m) & (z > 0)
    z = np.where(on, z, np.float32(3.0)).astype(np.float32)
    return z + np.random.default_rng(seed).standard_normal(z.shape, np.float32) * np.float32(noise_m) * z**2


def mirrored(data: CalibrationSet, camera: str) -> CalibrationSet:
    """The same set with one camera's pictures flipped left to right."""
    width = data.image_size[camera][0]
    views = []
    for v in data.views:
        p = v.points[camera]
        views.append(v.with_points(camera, BoardPoints(p.index, p.px * [-1, 1] + [width - 1, 0])))
    return replace(data, views=tuple(views))


def picks_csv(data: CalibrationSet) -> str:
    """The text of a picks file with all points of a set, to 4 decimals of a pixel."""
    rows = ["view,camera,point,u_px,v_px"]
    for view in data.views:
        for camera, p in view.points.items():
            rows += [f"{view.name},{camera},{i},{u:.4f},{v:.4f}" for i, (u, v) in zip(p.index, p.px, strict=True)]
    return "\n".join(rows) + "\n"
