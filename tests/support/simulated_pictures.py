"""Pictures of a simulated rig: a calibration folder with known truth, to go through the real readers and detectors.

Every picture is evaluated where the camera's true, distorted rays meet the board, on a grid finer than the pixels with
edges covered in part, blurred by the lens, averaged over the pixel, and made noisy. Nothing in it knows how detectors
work.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from support.simulated_rig import SimulatedRig, board_poses, true_pixels

from thermofusion.calibration.board.board import Board
from thermofusion.geometry.camera import undistort
from thermofusion.geometry.rigid import invert
from thermofusion.types import Camera, Float

FINE = 2  # samples per pixel and axis
RIM = 0.7  # of the board beyond its points, spacings
WALL_M = 3.0
PIN_RADIUS = 0.05  # spacings


@dataclass(frozen=True)
class Pictures:
    """How the simulated colour and thermal cameras see.

    blur_px : one sigma of each lens. color_noise : grey levels. thermal_noise, thermal_pattern : counts, of every
    picture and of the sensor's own columns and pixels. missing : share of pins that do not show. board_warmer : counts
    over the wall.
    """

    color_blur_px: float = 0.8
    color_noise: float = 2.0
    thermal_blur_px: float = 1.0
    thermal_noise: float = 5.0
    thermal_pattern: float = 3.0
    missing: float = 0.1
    board_warmer: float = 15.0


@dataclass(frozen=True)
class Kinect:
    """A structured-light depth camera.

    step_m, noise_m : a count of disparity, and one sigma of noise before it is rounded to one, m at 1 m; both grow as
    range² (1/8 px of a 75 mm base; together 1.4 mm at 1 m as in Khoshelham & Elberink 2012). common : share of the
    noise's variance that neighbours within the matching window have in common. window_px : one sigma of that window.
    ragged_px, grown_px : one sigma of an edge's wandering, and how far foreground spreads over background. bend_m :
    bowl of the depth over the image, m at 1 m. scale, offset_m : of reported against true depth. lost, dark_lost :
    share of pixels without depth, and of those on dark squares. projector_m : base; what it cannot reach is lost.
    sheet_focal : focal length of the data sheet over the true one.
    """

    step_m: float = 2.85e-3
    noise_m: float = 1.15e-3
    common: float = 0.5
    window_px: float = 2.0
    ragged_px: float = 0.7
    grown_px: float = 0.5
    bend_m: float = 1e-3
    scale: float = 0.002
    offset_m: float = 0.001
    lost: float = 0.03
    dark_lost: float = 0.0
    projector_m: float = 0.075
    sheet_focal: float = 0.99

    @staticmethod
    def drawn(seed: int) -> Kinect:
        """One of many cameras: its own bowl, scale and offset, and another error of the data sheet."""
        bend, scale, offset, sheet = np.random.default_rng([seed, 1]).standard_normal(4)
        return Kinect(bend_m=1e-3 * bend, scale=3e-3 * scale, offset_m=1.5e-3 * offset, sheet_focal=1 + 0.007 * sheet)


def write_folder(
    root: Path,
    rig: SimulatedRig,
    seed: int,
    *,
    views: int = 24,
    pictures: Pictures | None = None,
    kinect: Kinect | None = None,
    lens_known: bool = False,
    infrared: bool = False,
) -> list[Float]:
    """A calibration folder of a simulated afternoon; returns the true T_depth_board of its views.

    lens_known : calibration.json gives the true depth lens as the maker's calibration; otherwise a data sheet's,
    centred. infrared : the depth camera's own pictures too.
    """
    pictures, kinect = pictures or Pictures(), kinect or Kinect()
    rng = np.random.default_rng(seed)
    poses = board_poses(rig, views, rng)
    pattern = sensor_pattern(rig.thermal, pictures.thermal_pattern, rng)
    for camera in ("color", "thermal", "depth", *(["infrared"] if infrared else [])):
        (root / camera).mkdir(parents=True)
    for i, T in enumerate(poses):
        s = [int(k) for k in rng.integers(2**31, size=3)]
        _write(root / f"color/{i:04d}.png", color_picture(rig, T, s[0], pictures))
        _write(root / f"thermal/{i:04d}.png", thermal_picture(rig, T, s[1], pictures, pattern))
        if infrared:
            _write(root / f"infrared/{i:04d}.png", color_picture(rig, T, s[0] + 1, pictures, "depth"))
        depth_mm = np.round(1e3 * depth_picture(rig, T, s[2], kinect))
        _write(root / f"depth/{i:04d}.png", np.nan_to_num(depth_mm).astype(np.uint16))
    (root / "calibration.json").write_text(json.dumps(_config(rig, None if lens_known else kinect.sheet_focal)))
    return poses


def _config(rig: SimulatedRig, sheet_focal: float | None) -> dict[str, Any]:
    board, lens = rig.board, rig.depth
    w, h, f = lens.width_px, lens.height_px, (sheet_focal or 1) * lens.K[0, 0]
    K = lens.K if sheet_focal is None else np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
    about = {"kind": board.kind, "columns": board.columns, "rows": board.rows, "spacing_m": board.spacing_m}
    camera = {"width_px": w, "height_px": h, "K": K.tolist()}
    return {"board": about, "depth": {"unit_m": 0.001, "lens_known": sheet_focal is None, "camera": camera}}


def _write(path: Path, image: NDArray) -> None:
    cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])


# ---------------------------------------------------------------- colour


def color_picture(
    rig: SimulatedRig, T_depth_board: Float, seed: int, look: Pictures, name: str = "color"
) -> NDArray[np.uint8]:
    """(H, W) grey levels: squares and white rim under uneven light before a blotchy wall; lens blur, noise, 8 bit.

    name : `color`, or `depth` for the depth camera's infrared picture.
    """
    rng, camera = np.random.default_rng(seed), rig.camera(name)
    image = _blotches(rng, camera, 90, 25)
    here, at = _board_xy(rig, name, T_depth_board)
    x, y, c, r = at.x, at.y, rig.board.columns - 1, rig.board.rows - 1
    dark = _squares(at) * at.inside(c, r, 0.0)
    gx, gy = (np.float32(g) for g in rng.uniform(-0.25, 0.25, 2))
    light = (1 - gx / 2 - gy / 2) + gx / np.float32(c) * x + gy / np.float32(r) * y
    pin, number = _pins(rig.board, at)
    heads = rng.uniform(50, 220, len(rig.board)).astype(np.float32)[number]
    fine = (np.float32(200) - np.float32(165) * dark) * light
    fine.ravel()[pin[0]] += pin[1] * (heads - fine.ravel()[pin[0]])
    _paste(image, here, fine, at.inside(c, r, RIM), look.color_blur_px)
    noisy = image + rng.standard_normal(image.shape, np.float32) * np.float32(look.color_noise)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


# ---------------------------------------------------------------- thermal


def sensor_pattern(camera: Camera, sigma: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """(H, W) counts: offsets of columns and pixels that a thermal sensor carries from picture to picture."""
    columns = rng.standard_normal(camera.width_px, np.float32)
    return np.float32(sigma) * (0.7 * columns + 0.7 * rng.standard_normal(camera.shape, np.float32))


def thermal_picture(
    rig: SimulatedRig, T_depth_board: Float, seed: int, look: Pictures, pattern: NDArray[np.float32]
) -> NDArray[np.uint16]:
    """(H, W) counts: pins of either sign on a board that is warmer than the wall; blur, noise, some pins unseen.

    A pin mirrors what stands before it: bright where that is warm, dark where it is cold, both in one picture.
    """
    rng, board, camera = np.random.default_rng(seed), rig.board, rig.thermal
    image = _blotches(rng, camera, 0, 10)
    here, at = _board_xy(rig, "thermal", T_depth_board)
    across = np.sin(np.linspace(0, np.pi, board.columns) + rng.uniform(0, 3))
    contrast = rng.uniform(100, 360, len(board)) * np.sign(np.tile(across, board.rows) + rng.normal(0, 0.3, len(board)))
    contrast[rng.random(len(board)) < look.missing] = 0
    pin, number = _pins(board, at)
    fine = np.full(at.x.shape, look.board_warmer, np.float32)
    fine.ravel()[pin[0]] += pin[1] * contrast[number].astype(np.float32)
    _paste(image, here, fine, at.inside(board.columns - 1, board.rows - 1, RIM), look.thermal_blur_px)
    noise = rng.standard_normal(image.shape, np.float32) * np.float32(look.thermal_noise)
    return np.round(24_200 + image + pattern + noise).astype(np.uint16)


# ---------------------------------------------------------------- depth


def depth_picture(rig: SimulatedRig, T_depth_board: Float, seed: int, kinect: Kinect) -> NDArray[np.float32]:
    """(H, W) metres along z as reported, NaN lost: the board before a wall, by disparity in whole counts."""
    rng, camera, k = np.random.default_rng(seed), rig.depth, kinect
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].astype(np.float32)
    wander = [_smooth_noise(rng, camera.shape, 1.5 * k.window_px) * np.float32(k.ragged_px) for _ in range(2)]
    to_board = _homography(rig, "depth", T_depth_board)
    x, y, w = _plane_xy(to_board, *_rays(camera, u, v))
    seen_x, seen_y, _ = _plane_xy(to_board, *_rays(camera, u + wander[0], v + wander[1]))
    grown = k.grown_px * np.median(np.hypot(np.diff(x, axis=1)[:-1], np.diff(x, axis=0)[:, :-1]))
    on = _on_board(rig, seen_x, seen_y, RIM + grown)
    z = np.where(on, 1 / w, np.float32(WALL_M)).astype(np.float32)
    lost = rng.random(z.shape, np.float32) < k.lost
    lost |= ~on & _in_shadow(rig, T_depth_board, u, v, k.projector_m)
    squares = (x > 0) & (x < rig.board.columns - 1) & (y > 0) & (y < rig.board.rows - 1)
    dark = squares & ((np.floor(x) + np.floor(y)) % 2 == 0)
    lost |= on & dark & (rng.random(z.shape, np.float32) < k.dark_lost)
    r2 = ((u - camera.K[0, 2]) ** 2 + (v - camera.K[1, 2]) ** 2) / camera.K[0, 0] ** 2
    reported = z + k.scale * z + k.offset_m + k.bend_m * (8 * r2 - 1) * z**2
    noise = np.sqrt(k.common) * _smooth_noise(rng, z.shape, k.window_px)
    noise += np.sqrt(1 - k.common) * rng.standard_normal(z.shape, np.float32)
    counts = np.round((1 / reported + k.noise_m * noise) / k.step_m)
    return np.where(lost, np.nan, 1 / (counts * k.step_m)).astype(np.float32)


def _in_shadow(rig: SimulatedRig, T_depth_board: Float, u: NDArray, v: NDArray, base_m: float) -> NDArray[np.bool_]:
    """Pixels whose place on the wall the projector, `base_m` to the right of the camera, sees the board before."""
    x, y = _rays(rig.depth, u, v)
    T_board_depth = invert(T_depth_board)
    eye = T_board_depth[:3, :3] @ [base_m, 0, 0] + T_board_depth[:3, 3]
    R = T_board_depth[:3, :3].astype(np.float32) * np.float32(WALL_M)
    wall = [R[k, 0] * x + R[k, 1] * y + R[k, 2] + np.float32(T_board_depth[k, 3]) for k in range(3)]
    share = eye[2] / (eye[2] - wall[2])
    s = rig.board.spacing_m
    p, q = ((eye[k] + share * (wall[k] - eye[k])) / s for k in (0, 1))
    return (share > 0) & (share < 1) & _on_board(rig, p, q)


# ---------------------------------------------------------------- shared


def _rays(camera: Camera, u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    """x/z and y/z of pixels."""
    K = camera.K
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    return undistort(x, y, camera.distortion, iterations=10) if np.any(camera.distortion) else (x, y)


def _homography(rig: SimulatedRig, name: str, T_depth_board: Float) -> Float:
    """(3, 3) from a camera's rays (x/z, y/z, 1) to the board, in spacings."""
    T = rig.T_camera_depth(name) @ T_depth_board
    H = np.linalg.inv(np.column_stack([T[:3, :2], T[:3, 3]]))
    return np.diag([1 / rig.board.spacing_m, 1 / rig.board.spacing_m, 1]) @ H


def _plane_xy(H: Float, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Board coordinates of rays, spacings, and 1/z of the plane there."""
    a, b, w = (H[k, 0] * x + H[k, 1] * y + H[k, 2] for k in range(3))
    return a / w, b / w, w


@dataclass(frozen=True, eq=False)
class _OnBoard:
    """Where fine samples lie on the board: x, y and the width of a sample along either, all in spacings."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    dx: NDArray[np.float32]
    dy: NDArray[np.float32]

    def inside(self, columns: int, rows: int, rim: float) -> NDArray[np.float32]:
        """Share of each sample within the rectangle from (-rim, -rim) to (columns + rim, rows + rim)."""
        share = [
            np.clip((n / 2 + rim - np.abs(a - n / 2)) / d + 0.5, 0, 1)
            for a, d, n in ((self.x, self.dx, np.float32(columns)), (self.y, self.dy, np.float32(rows)))
        ]
        return (share[0] * share[1]).astype(np.float32)


def _board_xy(rig: SimulatedRig, name: str, T_depth_board: Float) -> tuple[tuple[slice, slice], _OnBoard]:
    """The part of a picture that holds the board, and where its fine samples lie."""
    camera = rig.camera(name)
    px = true_pixels(rig, name, T_depth_board)
    margin = (RIM + 0.3) * np.linalg.norm(np.ptp(px, axis=0)) / (min(rig.board.columns, rig.board.rows) - 1) + 4
    lo = np.maximum(np.floor(px.min(0) - margin), 0).astype(int)
    hi = np.minimum(np.ceil(px.max(0) + margin) + 1, [camera.width_px, camera.height_px]).astype(int)
    hi -= (hi - lo) % 2
    v, u = np.mgrid[lo[1] : hi[1] : 2, lo[0] : hi[0] : 2] + 0.5  # between them: linear to 1e-3 px
    x, y, _ = _plane_xy(_homography(rig, name, T_depth_board), *_rays(camera, u, v))
    steps = [np.hypot(*np.gradient(a)) / (2 * FINE) for a in (x, y)]
    size = ((hi - lo) * FINE).tolist()
    fine = [cv2.resize(a.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) for a in (x, y, *steps)]
    return (slice(lo[1], hi[1]), slice(lo[0], hi[0])), _OnBoard(*(np.asarray(a, np.float32) for a in fine))


def _squares(at: _OnBoard) -> NDArray[np.float32]:
    """Share of each sample that is on squares of even parity."""
    i, j = np.rint(at.x), np.rint(at.y)
    sign = 1 - 2 * ((i.astype(np.int16) + j.astype(np.int16)) & 1).astype(np.float32)
    return 0.5 + 2 * sign * np.clip((at.x - i) / at.dx, -0.5, 0.5) * np.clip((at.y - j) / at.dy, -0.5, 0.5)


def _pins(board: Board, at: _OnBoard) -> tuple[tuple[NDArray, NDArray[np.float32]], NDArray]:
    """Samples (flat index) on a pin's head with the share covered, and the number of each one's pin."""
    i, j = np.rint(at.x), np.rint(at.y)
    share = (PIN_RADIUS - np.hypot(at.x - i, at.y - j)) / (0.5 * (at.dx + at.dy)) + 0.5
    k = np.flatnonzero((share > 0) & (i >= 0) & (i < board.columns) & (j >= 0) & (j < board.rows))
    number = j.ravel()[k] * board.columns + i.ravel()[k]
    return (k, np.minimum(share.ravel()[k], 1)), number.astype(int)


def _on_board(rig: SimulatedRig, x: NDArray, y: NDArray, rim: float = RIM) -> NDArray[np.bool_]:
    c, r = rig.board.columns - 1, rig.board.rows - 1
    return (x > -rim) & (x < c + rim) & (y > -rim) & (y < r + rim)


def _paste(
    image: NDArray[np.float32], here: tuple[slice, slice], fine: NDArray, share: NDArray[np.float32], blur_px: float
) -> None:
    """The board's fine samples into the picture: blurred, averaged over pixels, over what is behind at its edge."""
    h, w = image[here].shape
    behind = cv2.resize(image[here], (w * FINE, h * FINE), interpolation=cv2.INTER_LINEAR)
    whole = (behind + share * (fine - behind)).astype(np.float32)
    blurred = cv2.GaussianBlur(whole, (0, 0), blur_px * FINE)
    image[here] = cv2.resize(blurred, (w, h), interpolation=cv2.INTER_AREA)


def _blotches(rng: np.random.Generator, camera: Camera, mean: float, sigma: float) -> NDArray[np.float32]:
    """(H, W) a background of soft blotches, eighth of a picture wide."""
    coarse = rng.normal(mean, sigma, (7, 9)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (camera.width_px, camera.height_px), interpolation=cv2.INTER_CUBIC))


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, int], sigma_px: float) -> NDArray[np.float32]:
    """(H, W) Gaussian noise of variance 1, correlated over sigma_px."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (0, 0), sigma_px)
    return (noise * np.float32(2 * np.sqrt(np.pi) * sigma_px)).astype(np.float32)
