"""A made scan for tests: a bumpy warm body walked round by a cheap, distorted thermal camera with point spread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from thermofusion.geometry._open3d import o3d
from thermofusion.geometry.camera import pixel_rays
from thermofusion.geometry.rigid import interpolate_trajectory, invert, pose, se3_exp
from thermofusion.types import Camera, Rig, Scan, Stream, SurfaceMesh, ThermalCamera, ThermalStream, Trajectory

ROOM_DEGC, SKIN_DEGC, NETD_K = 22.0, 33.0, 0.06
THERMAL = Camera(
    320, 240, np.array([[300.0, 0, 161], [0, 305, 121], [0, 0, 1]]), np.array([-0.2, 0.08, 1e-3, -5e-4, 0])
)
DEPTH = Camera(640, 480, np.array([[590.0, 0, 319.5], [0, 590, 239.5], [0, 0, 1]]))
FINE_RAYS = pixel_rays(
    THERMAL, *np.meshgrid(np.arange(-0.25, 319.5, 0.5), np.arange(-0.25, 239.5, 0.5))
)  # 2 x 2 a pixel
T_THERMAL_DEPTH = se3_exp(np.array([0.05, 0.02, -0.01, 0.02, -0.1, 0.01]))


def ellipsoid(n: int = 140) -> SurfaceMesh:
    """A body-sized ellipsoid with bumps of a centimetre; normals of the mesh."""
    polar, azimuth = np.meshgrid(np.linspace(0.01, np.pi - 0.01, n), np.linspace(0, 2 * np.pi, 2 * n), indexing="ij")
    d = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    radius = 1 + 0.06 * np.sin(5 * azimuth) * np.sin(polar) ** 2 + 0.05 * np.sin(7 * polar)
    p = (d * radius[..., None] * [0.22, 0.15, 0.38]).reshape(-1, 3).astype(np.float32)
    i = np.arange(n * 2 * n).reshape(n, 2 * n)
    a, b, c, e = (x.ravel() for x in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, e], 1)]).astype(np.int32)
    mesh = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(p), o3d.core.Tensor(triangles))
    mesh.compute_vertex_normals()
    return SurfaceMesh(p, triangles, mesh.vertex.normals.numpy())


def walk(duration_s: float = 8.0, tremor: float = 1.0) -> Trajectory:
    """Once round at 1.1 m, looking at the middle, with the unsteadiness of a hand (1 cm, 1°)."""
    t = np.arange(0, duration_s, 1 / 15)
    phase = 2 * np.pi * t / duration_s
    eye = 1.1 * np.stack([np.cos(phase), np.sin(phase), 0.1 * np.sin(2 * phase)], -1)
    z = -eye / np.linalg.norm(eye, axis=1, keepdims=True)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], 2)
    rate = np.array([1.1, 1.7, 0.9, 1.3, 0.7, 1.9]) * 2 * np.pi
    shake = tremor * np.sin(rate * t[:, None] + np.arange(6)) * ([0.01] * 3 + [0.008] * 3)
    return Trajectory(t, np.stack([pose(r, e) for r, e in zip(R, eye, strict=True)]) @ se3_exp(shake))


def render(mesh: SurfaceMesh, T_world_thermal: np.ndarray, seed: int) -> np.ndarray:
    """What the camera reports, °C: 2 x 2 rays a pixel, emissivity falling at the limb, point spread, noise, offset.

    T_world_thermal : (4, 4), or (480, 4, 4) of rows of rays that are taken one after another.
    """
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices_m), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    rays = FINE_RAYS @ np.swapaxes(T_world_thermal[..., :3, :3], -1, -2)
    eye = np.broadcast_to(T_world_thermal[..., None, :3, 3], rays.shape)
    answer = scene.cast_rays(o3d.core.Tensor(np.concatenate([eye, rays], -1).astype(np.float32)))
    t = answer["t_hit"].numpy()
    hit = np.isfinite(t)
    p = eye + np.where(hit, t, 0)[..., None] * rays
    cos = np.abs((answer["primitive_normals"].numpy() * rays).sum(-1))
    pattern = SKIN_DEGC + np.sin(12 * p[..., 0] + 3) * np.cos(15 * p[..., 2])
    emissivity = 0.98 * (1 - (1 - cos) ** 5)
    image = np.where(hit, ROOM_DEGC + emissivity * (pattern - ROOM_DEGC), ROOM_DEGC)
    image = image.reshape(240, 2, 320, 2).mean((1, 3))
    noise = np.random.default_rng(seed).normal(0, NETD_K, image.shape)
    return (cv2.GaussianBlur(image, (0, 0), 0.8) + noise + 0.5 * np.sin(seed)).astype(np.float32)


def make_scan(
    mesh: SurfaceMesh,
    trajectory: Trajectory,
    *,
    sway: np.ndarray | None = None,
    readout_s: float = 0.0,
    knocked: np.ndarray | None = None,
) -> Scan:
    """24 thermal frames. sway : (24, 6) twist in the world frame by which the body has moved in each, or None.

    knocked : (24, 6) twist of the thermal camera on its rig, from the left of T_thermal_depth.
    readout_s : from the first row to the last, about the frame's time.
    """
    taken = np.linspace(0.3, trajectory.times_s[-1] - 0.3, 24)
    T_world_depth, _ = interpolate_trajectory(trajectory, taken)
    # A body moved by D looks as it does at rest to a camera moved by its inverse.
    still = np.zeros((24, 6))
    T_thermal_depth = se3_exp(still if knocked is None else knocked) @ T_THERMAL_DEPTH
    T_world_thermal = invert(se3_exp(still if sway is None else sway)) @ T_world_depth @ invert(T_thermal_depth)
    if readout_s:
        rows_s = readout_s * ((np.arange(480) + 0.5) / 480 - 0.5)
        T_rows, _ = interpolate_trajectory(trajectory, (taken[:, None] + rows_s).ravel())
        T_world_thermal = (T_rows @ invert(T_THERMAL_DEPTH)).reshape(24, 480, 4, 4)
    images = [render(mesh, T, i) for i, T in enumerate(T_world_thermal)]
    places, index = tuple(f"thermal {i}" for i in range(24)), np.arange(24)
    camera = ThermalCamera(THERMAL, T_THERMAL_DEPTH, netd_K=NETD_K)
    thermal = ThermalStream(taken, lambda i: images[i], places, index, np.ones(24, bool), camera)
    depth = Stream(np.zeros(0), lambda i: np.zeros(0), (), np.zeros(0, np.int64), np.zeros(0, bool))
    return Scan("ellipsoid", Path(), "made", Rig(DEPTH), depth, thermal=thermal)


def repainted(scan: Scan, paint: Callable[[np.ndarray], np.ndarray]) -> Scan:
    """The same scan with every thermal image changed by `paint`."""
    stream = scan.thermal
    return replace(scan, thermal=replace(stream, load=lambda i: paint(stream.load(i)).astype(np.float32)))


def blank(scan: Scan) -> Scan:
    """The same scan of a body as warm as the room: noise alone."""
    rng = np.random.default_rng(0)
    images = ROOM_DEGC + rng.normal(0, NETD_K, (len(scan.thermal), *THERMAL.shape)).astype(np.float32)
    return replace(scan, thermal=replace(scan.thermal, load=lambda i: images[i]))
