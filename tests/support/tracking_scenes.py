"""Small depth scans with known truth: a body of a few ellipsoids cast by rays, seen by a camera that walks round it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from thermofusion.geometry._open3d import o3d
from thermofusion.geometry.rigid import invert, pose, rigid_alignment
from thermofusion.types import Camera, Float, Rig, Scan, Stream, Trajectory

CAMERA = Camera(160, 120, np.array([[147.0, 0, 79.5], [0, 147.0, 59.5], [0, 0, 1]]))
FLOOR_Y_M = 0.42  # below the body's middle (y points down)
FRAME_S = 1 / 15


@dataclass(frozen=True, eq=False)
class Walk:
    """depth_m : (N, H, W) float32, NaN = none. T_body_depth : (N, 4, 4) truth."""

    depth_m: np.ndarray
    T_body_depth: Float

    def scan(self, *, recorded: Float | None = None) -> Scan:
        """As a reader would present it. recorded : poses of a recorded trajectory."""
        n = len(self.depth_m)
        times = FRAME_S * np.arange(n)
        stream = Stream(
            times,
            lambda i: self.depth_m[i].copy(),
            tuple(f"depth/{i:06d}.png" for i in range(n)),
            np.arange(n, dtype=np.int64),
            np.ones(n, bool),
        )
        trajectory = None if recorded is None else Trajectory(times, recorded)
        return Scan("walk", Path("walk"), "synthetic", Rig(CAMERA), stream, trajectory=trajectory)

    def blanked(self, start: int, stop: int) -> Walk:
        """Frames start..stop-1 hold no depth, as when somebody steps before the camera."""
        depth = self.depth_m.copy()
        depth[start:stop] = np.nan
        return replace(self, depth_m=depth)

    def without(self, start: int, stop: int) -> Walk:
        """Frames start..stop-1 are missing from the recording: the camera jumps."""
        keep = np.r_[0:start, stop : len(self.depth_m)]
        return Walk(self.depth_m[keep], self.T_body_depth[keep])

    def ate_mm(self, trajectory: Trajectory) -> float:
        """RMS distance of camera positions after rigid alignment, over the frames of the trajectory."""
        i = np.rint(trajectory.times_s / FRAME_S).astype(int)
        p, q = trajectory.T_world_depth[:, :3, 3], self.T_body_depth[i, :3, 3]
        T = rigid_alignment(p, q)
        return float(1e3 * np.sqrt((((p @ T[:3, :3].T + T[:3, 3]) - q) ** 2).sum(1).mean()))


def body() -> list[o3d.t.geometry.TriangleMesh]:
    """Trunk, head, one arm forward and one to the side: as far from symmetric as a person."""
    return [
        ellipsoid([0, 0, 0], [0.17, 0.33, 0.11], 0),
        ellipsoid([0.01, -0.37, -0.03], [0.075, 0.11, 0.095], 0),
        ellipsoid([-0.22, -0.02, -0.07], [0.045, 0.26, 0.05], 25),
        ellipsoid([0.24, -0.05, 0.03], [0.05, 0.25, 0.045], -35),
        ellipsoid([0.07, -0.12, -0.09], [0.06, 0.06, 0.05], 0),
        ellipsoid([-0.05, 0.14, -0.08], [0.09, 0.07, 0.06], 0),
    ]


def ellipsoid(centre: list[float], radii: list[float], tilt_deg: float) -> o3d.t.geometry.TriangleMesh:
    """An ellipsoid, tilted about the viewing axis of the first pose and, half as much, about the horizontal."""
    mesh = o3d.geometry.TriangleMesh.create_sphere(1.0, 40)
    R = Rotation.from_euler("zx", [tilt_deg, tilt_deg / 2], degrees=True).as_matrix()
    v = np.asarray(mesh.vertices) * radii
    mesh.vertices = o3d.utility.Vector3dVector(v @ R.T + centre)
    return o3d.t.geometry.TriangleMesh.from_legacy(mesh)


def box(low: list[float], high: list[float]) -> o3d.t.geometry.TriangleMesh:
    """An axis-parallel box between two corners, metres."""
    size = np.subtract(high, low)
    return o3d.t.geometry.TriangleMesh.create_box(*size).translate(o3d.core.Tensor(np.array(low, np.float32)))


def floor() -> o3d.t.geometry.TriangleMesh:
    """Four square metres under the body."""
    return box([-1, FLOOR_Y_M, -1], [1, FLOOR_Y_M + 0.02, 1])


def orbit(frames: int, turn_deg: float, *, distance_m: float = 1.0, seed: int = 5, down_m: float = 0.0) -> Float:
    """T_body_depth (N, 4, 4) of a hand-held walk round the body, looking at its middle, from `down_m` above it."""
    rng = np.random.default_rng(seed)
    angle = np.radians(np.linspace(0, turn_deg, frames))
    sway = np.cumsum(rng.normal(0, 1.5e-3, (frames, 3)), axis=0)
    poses = []
    for a, s in zip(angle, sway, strict=True):
        eye = np.array([distance_m * np.sin(a), -down_m + 0.05 * np.sin(3 * a), -distance_m * np.cos(a)]) + s
        z = np.array([0.0, 0.0, 0.0]) - eye
        z /= np.linalg.norm(z)
        x = np.cross([0, 1.0, 0], z)
        x /= np.linalg.norm(x)
        poses.append(pose(np.stack([x, np.cross(z, x), z], axis=1), eye))
    return np.array(poses)


def scaled(T: Float, factor: float) -> Float:
    """Poses in a world of another size."""
    out = T.copy()
    out[:, :3, 3] *= factor
    return out


def walk(
    T_body_depth: Float,
    *,
    shape: list | None = None,
    room: tuple = (),
    standing: tuple = (),
    noise: float = 1.2e-3,
    seed: int = 1,
) -> Walk:
    """Depth of the body (or another `shape`), of a `room` that moves with it, and of things `standing` in the camera's
    own frame.

    noise : standard deviation at 1 m, grows with range²; depth is rounded to millimetres, as sensors do.
    """
    rng = np.random.default_rng(seed)
    scene, fixed = o3d.t.geometry.RaycastingScene(), o3d.t.geometry.RaycastingScene()
    for mesh in (*(shape or body()), *room):
        scene.add_triangles(mesh)
    for mesh in standing:
        fixed.add_triangles(mesh)
    frames = []
    for T in T_body_depth:
        z = _cast(scene, T)
        if standing:
            z = np.minimum(z, _cast(fixed, np.eye(4)))
        z = z + rng.normal(0, noise, z.shape) * np.where(np.isfinite(z), z, 1) ** 2
        frames.append(np.where(z < 4, np.round(z, 3), np.nan).astype(np.float32))
    return Walk(np.array(frames), T_body_depth)


def _cast(scene: o3d.t.geometry.RaycastingScene, T_scene_depth: Float) -> np.ndarray:
    rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
        o3d.core.Tensor(CAMERA.K), o3d.core.Tensor(invert(T_scene_depth)), CAMERA.width_px, CAMERA.height_px
    )
    return scene.cast_rays(rays)["t_hit"].numpy().astype(np.float64)  # directions have z = 1: t is depth


def painted_cylinder(frames: int, turn_deg: float) -> tuple[Walk, np.ndarray]:
    """A walk round a cylinder of 30 cm, and what a colour camera in the depth camera's place saw of its paint."""
    mesh = o3d.geometry.TriangleMesh.create_cylinder(0.15, 2.4, 200)
    mesh.rotate(Rotation.from_euler("x", 90, degrees=True).as_matrix())
    poses = orbit(frames, turn_deg, distance_m=0.9)
    seen = walk(poses, shape=[o3d.t.geometry.TriangleMesh.from_legacy(mesh)])
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    rays = np.stack(
        [(u - CAMERA.K[0, 2]) / CAMERA.K[0, 0], (v - CAMERA.K[1, 2]) / CAMERA.K[1, 1], np.ones(u.shape)], -1
    )
    images = []
    for depth, T in zip(seen.depth_m, poses, strict=True):
        p = (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3]
        angle, height = np.arctan2(p[..., 0], p[..., 2]), p[..., 1]
        paint = np.sin(9 * angle + 3 * np.sin(14 * height)) + np.sin(31 * height + 2 * np.cos(5 * angle))
        images.append(np.nan_to_num(128 + 45 * paint).astype(np.uint8)[..., None].repeat(3, axis=-1))
    return seen, np.array(images)
