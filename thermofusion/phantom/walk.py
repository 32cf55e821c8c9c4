"""Where the rig is at every moment, and how the subject moves meanwhile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..geometry.rigid import invert, se3_exp
from ..types import Float
from .scene import ApartConfig, MotionConfig, PathConfig, RigConfig, WalkConfig

TREMOR_HZ = (0.4, 6.0)  # physiological tremor of an outstretched arm, and the walker's gait
SWAY_HZ = (0.1, 0.6)  # quiet standing
MOTION_WAVES = 12  # sines a component

# The rig's true extrinsics: the thermal camera above the depth camera, colour beside it.
THERMAL_TWIST = np.array([-0.05, 0.02, 0.01, 0.018, -0.100, 0.011])
COLOR_TWIST = np.array([0.005, -0.008, 0.003, -0.025, 0.0006, 0.0012])


@dataclass(frozen=True, eq=False)
class Wobble:
    """A small rigid motion over time: six sums of sines, each of given rms."""

    amplitude: Float  # (6, W) rotation [rad] and translation [m] parts
    omega: Float  # (6, W) rad/s
    phase: Float  # (6, W)

    @classmethod
    def random(cls, deg: float, mm: float, band_hz: tuple[float, float], rng: np.random.Generator) -> Wobble:
        """Of rms `deg` and `mm` per axis, frequencies log-uniform in the band, slow ones larger."""
        hz = np.exp(rng.uniform(np.log(band_hz[0]), np.log(band_hz[1]), (6, MOTION_WAVES)))
        weight = 1 / hz
        weight *= np.sqrt(2) / np.linalg.norm(weight, axis=1, keepdims=True)
        size = np.repeat([np.radians(deg), mm / 1e3], 3)[:, None]
        return cls(size * weight, 2 * np.pi * hz, rng.uniform(0, 2 * np.pi, hz.shape))

    def at(self, times_s: Float) -> Float:
        """(N,) -> (N, 4, 4)."""
        angle = self.omega[None] * times_s[:, None, None] + self.phase[None]
        return se3_exp((self.amplitude[None] * np.sin(angle)).sum(2))


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of the depth camera and of the subject at any time.

    The *body* frame is fixed to the subject; it is the world of the truth. It differs from the world by sway and,
    on a turntable, by the turn.
    """

    walk: WalkConfig
    tremor: Wobble
    sway: Wobble
    breathing_mm: float
    breathing_hz: float

    @classmethod
    def of(cls, walk: WalkConfig, motion: MotionConfig, rng: np.random.Generator) -> Motion:
        return cls(
            walk,
            Wobble.random(walk.tremor_deg, walk.tremor_mm, TREMOR_HZ, rng),
            Wobble.random(motion.sway_deg, motion.sway_mm, SWAY_HZ, rng),
            motion.breathing_mm,
            motion.breaths_per_min / 60,
        )

    @property
    def duration_s(self) -> float:
        return self.walk.depth_frames / self.walk.depth_hz

    def T_world_depth(self, times_s: Float) -> Float:
        """(N,) -> (N, 4, 4)."""
        phase = 0 * times_s if self.walk.subject_turns else times_s / self.duration_s
        return path(self.walk, phase) @ self.tremor.at(times_s)

    def T_world_body(self, times_s: Float) -> Float:
        """(N,) -> (N, 4, 4)."""
        return self.turn(times_s) @ self.sway.at(times_s)

    def T_body_depth(self, times_s: Float) -> Float:
        """The pose a fusion of the subject needs: (N,) -> (N, 4, 4)."""
        return invert(self.T_world_body(times_s)) @ self.T_world_depth(times_s)

    def T_recorded(self, times_s: Float) -> Float:
        """What a tracker outside would report: the rig about the turntable's axis, blind to sway. (N, 4, 4)."""
        return invert(self.turn(times_s)) @ self.T_world_depth(times_s)

    def turn(self, times_s: Float) -> Float:
        """The turntable (clockwise, as a rig would walk counter-clockwise): (N,) -> (N, 4, 4)."""
        T = np.tile(np.eye(4), (len(times_s), 1, 1))
        if self.walk.subject_turns:
            angle = -2 * np.pi * self.walk.turns * times_s / self.duration_s
            T[:, :3, :3] = Rotation.from_euler("z", angle[:, None]).as_matrix()
        return T

    def breath_m(self, times_s: Float) -> Float:
        """How far the chest stands out, (N,) metres, mean 0."""
        return self.breathing_mm / 2e3 * np.sin(2 * np.pi * self.breathing_hz * times_s)


@dataclass(frozen=True, eq=False)
class ApartMotion:
    """Poses of a thermal camera that is not on the rig."""

    walk: ApartConfig
    tremor: Wobble

    @classmethod
    def of(cls, walk: ApartConfig, rng: np.random.Generator) -> ApartMotion:
        return cls(walk, Wobble.random(walk.tremor_deg, walk.tremor_mm, TREMOR_HZ, rng))

    @property
    def times_s(self) -> Float:
        """(N,) when it takes its pictures, depth clock."""
        return self.walk.start_s + np.arange(self.walk.frames) / self.walk.hz

    def T_world_thermal(self, times_s: Float) -> Float:
        """(N,) -> (N, 4, 4)."""
        since = times_s - self.walk.start_s
        return path(self.walk, since * self.walk.hz / self.walk.frames) @ self.tremor.at(since)


def path(walk: PathConfig, phase: Float) -> Float:
    """The path without tremor; phase (N,) runs from 0 to 1 over the recording. Returns T_world_depth (N, 4, 4)."""
    angle = 2 * np.pi * walk.turns * phase
    around = angle + np.radians(walk.start_deg) - np.pi / 2  # 0 = in front, at -y
    wobble = np.sin(walk.wobbles_per_turn * angle)
    radius = walk.radius_m + walk.radius_wobble_m * np.sin((walk.wobbles_per_turn + 1) * angle + 0.7)
    height = walk.height_from_m + (walk.height_to_m - walk.height_from_m) * phase + walk.height_wobble_m * wobble
    eye = np.stack([radius * np.cos(around), radius * np.sin(around), height], 1)
    target = np.zeros_like(eye)
    target[:, 2] = walk.look_from_m + (walk.look_to_m - walk.look_from_m) * phase
    z = target - eye
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(phase), 1, 1))
    T[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=2)
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_euler("z", walk.roll_deg, degrees=True).as_matrix()
    T[:, :3, 3] = eye
    return T


def held_up(roll_deg: float) -> list[float]:
    """Which way is up in the frame of a depth camera that is rolled by an angle: (0, -1, 0) upright."""
    a = np.radians(roll_deg)
    return [round(float(-np.sin(a)), 6) + 0.0, round(float(-np.cos(a)), 6) + 0.0, 0.0]


def thermal_rig(rig: RigConfig, rng: np.random.Generator) -> tuple[Float, Float]:
    """(true, written) T_thermal_depth, (4, 4) m: they differ by the calibration error in a random direction."""
    true = se3_exp(THERMAL_TWIST)
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    error = np.concatenate([np.radians(rig.rotation_error_deg) * axes[0], rig.translation_error_mm / 1e3 * axes[1]])
    return true, se3_exp(error) @ true


def color_rig() -> Float:
    """True T_color_depth, (4, 4) m."""
    return se3_exp(COLOR_TWIST)
