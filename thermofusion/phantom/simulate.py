"""A scene in, a recording with known truth out."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecipeError
from ..geometry.rigid import invert
from ..types import Bool, Camera, Float, Float32
from .depth_cameras import DepthCamera, depth_camera, measure_depth, scaled_camera
from .posture import Posture
from .render import Caster, Exchange, Subject, Texture, exchange, image_rays, render_color, render_depth, render_thermal
from .scattering import scattered, wide_camera
from .scene import SceneConfig
from .shapes import Mesh, build_shape, vertex_normals
from .skin import Covering, cover
from .surround import Surround
from .thermal_cameras import (
    ThermalCamera,
    blackbody_polygon,
    draw_drift,
    expose,
    paint_blackbody,
    shutter_image,
    thermal_camera,
    vignetting_field,
)
from .walk import ApartMotion, Motion, color_rig, held_up, thermal_rig
from .writing import camera_json, whole_folder, write_frames, write_image, write_json, write_trajectory

BREATH_LEVELS = 12  # the breathing surface is cast in so many steps: 0.4 mm apart for 5 mm
COLOR_DISTORTION = (0.045, -0.11, 0.0007, -0.0009, 0.03)  # k1 k2 p1 p2 k3

# one random stream for each purpose: adding a colour camera must not change the thermal noise
SEED_SKIN, SEED_EXCHANGE, SEED_MOTION, SEED_RIG, SEED_DRIFT = range(5)
SEED_DEPTH, SEED_THERMAL, SEED_TEXTURE, SEED_APART, SEED_POSTURE = range(5, 10)


@dataclass(frozen=True, eq=False)
class Phantom:
    """Everything a scene fixes before the first picture is taken."""

    scene: SceneConfig
    seed: int
    mesh: Mesh
    covering: Covering
    exchange: Exchange
    motion: Motion
    depth: DepthCamera
    thermal: ThermalCamera
    color: Camera | None
    T_thermal_depth: Float
    T_thermal_depth_written: Float
    depth_times_s: Float
    thermal_times_s: Float  # true exposure times, depth clock
    offsets_K: Float
    shutter: Bool
    apart: ApartMotion | None = None  # of a thermal camera that is not on the rig
    posture: Posture | None = None  # of a body that lives

    def rng(self, *stream: int) -> np.random.Generator:
        """The random numbers of one purpose (and frame)."""
        return np.random.default_rng([self.seed, *stream])

    def thermal_poses(self, times_s: Float) -> tuple[Float, Float]:
        """T_body_thermal and T_world_thermal, (N, 4, 4), at times (N,) s."""
        if self.apart is None:
            T_world_thermal = self.motion.T_world_depth(times_s) @ invert(self.T_thermal_depth)
        else:
            T_world_thermal = self.apart.T_world_thermal(times_s)
        return invert(self.motion.T_world_body(times_s)) @ T_world_thermal, T_world_thermal


def build_phantom(scene: SceneConfig, seed: int = 0) -> Phantom:
    """Surface, skin, exchange of radiation, cameras and paths of a scene."""
    stream = lambda i: np.random.default_rng([seed, i])  # noqa: E731
    mesh = build_shape(scene.shape)
    covering = cover(mesh, scene, stream(SEED_SKIN))
    thermal = thermal_camera(scene.thermal)
    true_rig, written_rig = thermal_rig(scene.rig, stream(SEED_RIG))
    walk = scene.walk
    depth_times = np.arange(walk.depth_frames) / walk.depth_hz
    apart = None if scene.thermal.apart is None else ApartMotion.of(scene.thermal.apart, stream(SEED_APART))
    thermal_times = depth_times[:: scene.thermal.every] + scene.thermal.phase_s if apart is None else apart.times_s
    offsets, shutter = draw_drift(scene.thermal.drift, thermal_times, stream(SEED_DRIFT))
    color = None
    if scene.color is not None:
        scale = scene.color.width_px / 640
        color = scaled_camera(640, round(scene.color.height_px / scale), 554.3, 558.6, 316.4, 241.4, scale)
        color = replace(color, distortion=np.array(COLOR_DISTORTION))
    return Phantom(
        scene,
        seed,
        mesh,
        covering,
        exchange(mesh, covering, _surround(scene, thermal), stream(SEED_EXCHANGE)),
        Motion.of(walk, scene.motion, stream(SEED_MOTION)),
        depth_camera(scene.depth),
        thermal,
        color,
        true_rig,
        written_rig,
        depth_times,
        thermal_times,
        offsets,
        shutter,
        apart,
        _posture(scene, mesh, depth_times, stream(SEED_POSTURE)),
    )


def _surround(scene: SceneConfig, thermal: ThermalCamera) -> Surround:
    """The room as light. Raises RecipeError for a subject that turns in an uneven room: its light is gathered once."""
    surround = Surround(scene.room, thermal.band)
    if scene.walk.subject_turns and not surround.even:
        raise RecipeError("room.side_K, floor_to_ceiling_K and things need walk.subject_turns = false")
    return surround


def _posture(scene: SceneConfig, mesh: Mesh, times_s: Float, rng: np.random.Generator) -> Posture | None:
    """How the body moves, if it does. Raises RecipeError for a subject that has no limbs."""
    if not scene.motion.alive:
        return None
    if scene.shape.kind != "body":
        raise RecipeError(f"motion.standing and motion.step_mm need shape.kind = body, not {scene.shape.kind}")
    return Posture.of(mesh, scene.shape, scene.motion, times_s, rng)


def simulate(
    scene: SceneConfig,
    out: str | Path,
    seed: int = 0,
    *,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Record a scene into the native scan folder `out`, with truth/; the same scene and seed give the same bytes.

    progress : called with (frames done, frames in all). Raises ScanError if `out` holds something already (with
    `overwrite`, a scan there is replaced).
    """
    out = Path(out)
    phantom = build_phantom(scene, seed)
    with whole_folder(out, overwrite=overwrite) as folder:
        for name in ("depth", "thermal", "truth", *(("color",) if phantom.color is not None else ())):
            (folder / name).mkdir()
        rows = _record(phantom, folder, workers or min(os.cpu_count() or 1, 4), progress)
        write_frames(folder / "frames.csv", rows)
        write_json(folder / "scan.json", scan_document(phantom))
        if scene.walk.poses == "given":
            times = phantom.depth_times_s
            write_trajectory(folder / "trajectory.txt", times, phantom.motion.T_recorded(times))
        _write_truth(phantom, folder / "truth")
    return out


# ---------------------------------------------------------------- pictures


@dataclass(frozen=True, eq=False)
class Studio:
    """The rays of every camera and the subject at every level of its breath: built once, read by all frames."""

    phantom: Phantom
    subjects: tuple[Subject, ...]
    texture: Texture
    depth_rays: Float
    thermal_rays: Float
    color_rays: Float | None

    @classmethod
    def of(cls, phantom: Phantom) -> Studio:
        color = phantom.color
        return cls(
            phantom,
            _breathing_subjects(phantom),
            Texture.random(phantom.rng(SEED_TEXTURE)),
            image_rays(phantom.depth.camera),
            image_rays(phantom.thermal.camera, phantom.thermal.supersample),
            None if color is None else image_rays(color),
        )

    def subject(self, time_s: float) -> Subject:
        """The subject at the nearest level of its breath."""
        if self.phantom.posture is not None:
            return _moved(self.subjects[0], self.phantom.posture.at(time_s))
        motion, n = self.phantom.motion, len(self.subjects)
        if n == 1:
            return self.subjects[0]
        height = motion.breath_m(np.array([time_s]))[0] / (motion.breathing_mm / 2e3)
        return self.subjects[int(np.clip(round((height + 1) / 2 * (n - 1)), 0, n - 1))]

    def poses(self, time_s: float, T_camera_depth: Float | None = None) -> tuple[Float, Float]:
        """T_body_camera and T_world_camera (4, 4) at a time; T_camera_depth (4, 4), None = the depth camera itself."""
        t, T_depth_camera = np.array([time_s]), np.eye(4) if T_camera_depth is None else invert(T_camera_depth)
        motion = self.phantom.motion
        return motion.T_body_depth(t)[0] @ T_depth_camera, motion.T_world_depth(t)[0] @ T_depth_camera

    def depth(self, i: int) -> np.ndarray:
        """The i-th depth image (H, W), uint16 mm."""
        p, t = self.phantom, float(self.phantom.depth_times_s[i])
        T_body, T_world = self.poses(t)
        baseline = p.depth.baseline_m if p.depth.noisy else 0.0
        z, theta, shadow = render_depth(
            self.subject(t), p.depth.camera, self.depth_rays, p.scene.room, T_body, T_world, baseline
        )
        return measure_depth(p.depth, z, theta, shadow, p.rng(SEED_DEPTH, i))

    def radiance(self, i: int) -> np.ndarray:
        """What reaches the thermal lens in frame i, supersampled: (S·H, S·W) float32, W m-2 sr-1."""
        p, t = self.phantom, float(self.phantom.thermal_times_s[i])
        T_body, T_world = (T[0] for T in p.thermal_poses(np.array([t])))
        subject, surround = self.subject(t), Surround(p.scene.room, p.thermal.band)
        image = render_thermal(subject, p.thermal.camera, self.thermal_rays, surround, T_body, T_world)
        blackbody = p.scene.thermal.blackbody
        if blackbody is not None and i in blackbody.frames:
            room = float(p.thermal.band.emit(np.array(p.scene.room.reflected_degC)))
            paint_blackbody(p.thermal, blackbody, image, room)
        if p.scene.thermal.scatter:
            camera = wide_camera(p.thermal.camera)
            wide = render_thermal(subject, camera, image_rays(camera), surround, T_body, T_world)
            image = scattered(image, wide, p.scene.thermal.scatter, p.thermal.camera.shape)
        return image

    def thermal(self, i: int) -> np.ndarray:
        """The i-th thermal image (H, W), uint16 counts."""
        p, rng = self.phantom, self.phantom.rng(SEED_THERMAL, i)
        if p.shutter[i]:
            return shutter_image(p.thermal, rng)
        return expose(p.thermal, self.radiance(i), float(p.offsets_K[i]), rng)

    def color(self, i: int) -> np.ndarray:
        """The colour image at depth frame i, (H, W, 3) sRGB in R, G, B order."""
        p, t = self.phantom, float(self.phantom.depth_times_s[i])
        assert p.color is not None
        assert self.color_rays is not None
        T_body, T_world = self.poses(t, color_rig())
        return render_color(self.subject(t), p.color, self.color_rays, p.scene.room, T_body, T_world, self.texture)


def _moved(subject: Subject, vertices_m: Float32) -> Subject:
    """The subject with its vertices (V, 3) elsewhere; what it radiates is as at rest."""
    mesh = subject.mesh
    normals = vertex_normals(vertices_m, mesh.triangles).astype(np.float32)
    moved = replace(mesh, vertices_m=vertices_m, normals=normals)
    return replace(subject, mesh=moved, caster=Caster(vertices_m, mesh.triangles))


def _breathing_subjects(phantom: Phantom) -> tuple[Subject, ...]:
    """The subject cast at each level of its breath (one level if it does not breathe)."""
    mesh, emitted = phantom.mesh, phantom.thermal.band.emit(phantom.covering.degC).astype(np.float32)
    amplitude_m = phantom.motion.breathing_mm / 2e3
    levels = np.linspace(-1, 1, BREATH_LEVELS) if amplitude_m and mesh.chest.any() else np.zeros(1)
    subjects = []
    for level in levels:
        v = (mesh.vertices_m + level * amplitude_m * mesh.chest[:, None] * mesh.normals).astype(np.float32)
        normals = vertex_normals(v, mesh.triangles).astype(np.float32) if level else mesh.normals
        moved = replace(mesh, vertices_m=v, normals=normals)
        subjects.append(Subject(moved, phantom.covering, phantom.exchange, Caster(v, mesh.triangles), emitted))
    return tuple(subjects)


def _record(
    phantom: Phantom, folder: Path, workers: int, progress: Callable[[int, int], None] | None
) -> list[tuple[str, int, float, str, bool]]:
    """Take and write every picture. Returns the rows of frames.csv."""
    studio = Studio.of(phantom)
    color = phantom.scene.color
    jobs = [("depth", i, i) for i in range(len(phantom.depth_times_s))]
    jobs += [("thermal", i, i) for i in range(len(phantom.thermal_times_s))]
    if color is not None:
        jobs += [("color", k, i) for k, i in enumerate(range(0, len(phantom.depth_times_s), color.every))]

    def take(job: tuple[str, int, int]) -> tuple[str, int, float, str, bool]:
        stream, k, i = job
        name = f"{stream}/{k:06d}.{'jpg' if stream == 'color' else 'png'}"
        quality = color.jpeg_quality if stream == "color" and color is not None else None
        write_image(folder / name, getattr(studio, stream)(i), jpeg_quality=quality)
        if stream == "thermal":
            written = float(phantom.thermal_times_s[i]) - phantom.scene.rig.clock_error_s
            return stream, k, written, name, bool(phantom.shutter[i])
        return stream, k, float(phantom.depth_times_s[i]), name, False

    rows = []
    with ThreadPoolExecutor(workers) as pool:
        for row in pool.map(take, jobs):
            rows.append(row)
            if progress is not None:
                progress(len(rows), len(jobs))
    return rows


# ---------------------------------------------------------------- documents


def scan_document(phantom: Phantom) -> dict[str, Any]:
    """scan.json: what a recorder would know, errors of rig and room included."""
    scene, thermal = phantom.scene, phantom.thermal
    cameras: dict[str, Any] = {
        "depth": {
            **camera_json(phantom.depth.camera, phantom.depth.name),
            "depth_unit_m": 0.001,
            "up": held_up(scene.walk.roll_deg),
        },
        "thermal": {
            **camera_json(thermal.camera, thermal.name),
            "band_um": list(thermal.band_um),
            "netd_K": thermal.netd_K if thermal.netd_K > 0 else 1e-3,
            "time_offset_s": 0.0,
            "signal": {"kind": "counts", "curve": thermal.curve},
        },
    }
    if thermal.psf_sigma_px > 0:
        cameras["thermal"]["psf_sigma_px"] = thermal.psf_sigma_px
    extrinsics = {}
    if phantom.apart is None:
        extrinsics["T_thermal_depth"] = phantom.T_thermal_depth_written.tolist()
    else:
        cameras["thermal"]["mount"] = "free"
    if phantom.color is not None:
        cameras["color"] = camera_json(phantom.color, "simulated colour camera")
        extrinsics["T_color_depth"] = color_rig().tolist()
    room = scene.room
    return {
        "schema": "thermofusion-scan/1",
        "name": scene.name,
        "recorded_at": "2026-05-04T10:31:00+02:00",
        "cameras": cameras,
        "extrinsics": extrinsics,
        "environment": {
            "reflected_degC": room.reflected_degC + room.reflected_error_K,
            "air_degC": room.air_degC,
            "relative_humidity_pct": room.relative_humidity_pct,
        },
        "references": _references(phantom),
        "subject": {"pseudonym": "simulated", "posture": "standing"},
    }


def _references(phantom: Phantom) -> list[dict[str, Any]]:
    config = phantom.scene.thermal.blackbody
    if config is None:
        return []
    frames = [i for i in config.frames if i < len(phantom.shutter) and not phantom.shutter[i]]
    return [
        {
            "kind": "blackbody",
            "degC": config.degC,
            "uncertainty_K": config.uncertainty_K,
            "emissivity": config.emissivity,
            "thermal_polygon_px": blackbody_polygon(config, phantom.thermal.camera).tolist(),
            "frames": frames,
        }
    ]


def _write_truth(phantom: Phantom, folder: Path) -> None:
    """surface.npz, trajectory.txt (T_body_depth: the pose relative to the subject) and the resolved scene."""
    mesh, used = phantom.mesh, ~phantom.shutter
    times = phantom.depth_times_s
    write_trajectory(folder / "trajectory.txt", times, phantom.motion.T_body_depth(times))
    if phantom.apart is not None:
        T_body_thermal = phantom.thermal_poses(phantom.thermal_times_s)[0]
        write_trajectory(folder / "thermal_trajectory.txt", phantom.thermal_times_s, T_body_thermal)
    np.savez_compressed(
        folder / "surface.npz",
        vertices_m=mesh.vertices_m,
        triangles=mesh.triangles,
        temperature_degC=phantom.covering.degC,
        body_fraction=phantom.exchange.body_fraction.astype(np.float16),
        material=phantom.covering.material.astype(np.uint8),
        offsets_K=phantom.offsets_K[used],
        thermal_index=np.flatnonzero(used),
        thermal_times=phantom.thermal_times_s[used],
        T_thermal_depth=phantom.T_thermal_depth,
        clock_error_s=phantom.scene.rig.clock_error_s,
        reflected_degC=phantom.scene.room.reflected_degC,
        vignetting_K=vignetting_field(phantom.thermal)[::8, ::8].astype(np.float32),
        **({} if phantom.posture is None else phantom.posture.truth(times)),
    )
    (folder / "scene.toml").write_text(phantom.scene.to_toml(), encoding="utf-8")
