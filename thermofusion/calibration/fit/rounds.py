"""Thermal boards found without picks: from the colour camera's, in rounds, each with the calibration of the last.

First, with nothing known, the colour camera's board poses give the grid's shape in every view; the thermal picture
shows it scaled by one focal length and turned by one roll, common to all views, and shifted. What is found calibrates
the thermal camera, which predicts the board in the views still missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...progress import Progress, silent
from ...types import Float
from ..board.board import Board
from ..board.views import CalibrationSet
from ..detect.thermal import (
    SPOT_SIGMA_PX,
    Detection,
    complete,
    find_shift,
    fixed_pattern,
    is_saturated,
    spot_map,
    step_px,
)
from .bundle import Options, Problem
from .cameras import from_rt, project_with_jacobian
from .groups import find_groups, misfits
from .joint import initial_guess
from .single import SingleFit, fit_camera
from .solver import solve

SEARCH_VIEWS = 10  # tell focal length and roll, which all views share; more only take longer
FOCAL_STEPS = np.geomspace(0.7, 2.4, 28)  # image widths: 71 to 24 deg field of view
ROLLS_DEG = (-4.0, -2.0, 0.0, 2.0, 4.0)  # of the thermal camera against the colour camera, both held upright
COARSE = 2  # the first search is done on a smaller picture
ROUNDS = 3  # of predicting, detecting, calibrating: each adds the views that the last could predict
REACH_PX = 14.0  # a prediction of a calibrated rig is not worse, knocks of the tripod included
MIN_START = 3  # views, as `start.zhang` needs to calibrate the thermal camera


@dataclass(frozen=True, eq=False)
class ThermalPictures:
    """The thermal pictures of a set: counts (H, W) by view name, and the sensor's own pattern taken off."""

    clean: Mapping[str, NDArray[np.float32]]
    saturated: tuple[str, ...]

    @staticmethod
    def of(images: Mapping[str, NDArray]) -> ThermalPictures:
        """Of pictures (H, W), counts, by view name."""
        pattern = fixed_pattern(list(images.values()))
        clean = {n: i.astype(np.float32) - (0 if pattern is None else pattern) for n, i in images.items()}
        return ThermalPictures(clean, tuple(n for n, i in images.items() if is_saturated(i)))

    def spots(self, name: str, step: float) -> NDArray[np.float32]:
        """Spot map (H, W) with the spot size that fits the grid's step, px."""
        return spot_map(self.clean[name], float(np.clip(0.04 * step, SPOT_SIGMA_PX, 1.8)))


def detect_thermal_set(
    data: CalibrationSet, images: Mapping[str, NDArray], progress: Progress = silent
) -> tuple[CalibrationSet, dict[str, Detection]]:
    """Thermal points of all views from `images` (H, W) counts by view name; `data` has colour points.

    Returns the set with thermal points, and every view's detection (accepted and rejected points).
    Raises ScanError if the board is found in too few pictures, and says if they are saturated.
    """
    progress("thermal boards", 0, ROUNDS + 1)
    pictures = ThermalPictures.of(images)
    color = fit_camera(data, "color")
    size = _size(images)
    poses = {n: T for n, T in color.poses().items() if n in images}
    found = _first(data, pictures, poses, size)
    data = replace(data, image_size={**data.image_size, "thermal": size})
    for number in range(ROUNDS):
        progress("thermal boards", number + 1, ROUNDS + 1)
        good = {n: d for n, d in found.items() if d.score > 0}
        if len(good) < MIN_START:
            raise ScanError(_why(pictures, len(good), len(images)), hint=_next_step(pictures))
        data = with_detections(data, found)
        found = _predicted(data, color, pictures, found)
    progress("thermal boards", ROUNDS + 1, ROUNDS + 1)
    return with_detections(data, found), found


def with_detections(data: CalibrationSet, found: Mapping[str, Detection]) -> CalibrationSet:
    """The set with the accepted thermal points."""
    views = []
    for v in data.views:
        d = found.get(v.name)
        views.append(v.with_points("thermal", d.points if d is not None and d.score > 0 else None))
    return replace(data, views=tuple(views))


def _first(
    data: CalibrationSet, pictures: ThermalPictures, poses: dict[str, Float], size: tuple[int, int]
) -> dict[str, Detection]:
    """One focal length and roll for all views by the sum of their best scores; then each view by itself."""
    board = data.board.points_m
    shapes = {}
    for n, T in poses.items():
        X = board @ T[:3, :3].T + T[:3, 3]
        shapes[n] = X[:, :2] / X[:, 2:]
    names = list(shapes)[:: max(1, len(shapes) // SEARCH_VIEWS)]
    small = {n: spot_map(_shrink(pictures.clean[n]), SPOT_SIGMA_PX) for n in names}
    reach = 0.25 * size[0] / COARSE
    best, choice = -1.0, (1.0, 0.0)
    for focal in FOCAL_STEPS:
        for roll in ROLLS_DEG:
            score = 0.0
            for n in names:
                q = (_turned(shapes[n], roll) * focal * size[0] + np.array(size) / 2) / COARSE
                score += find_shift(small[n], q, reach)[1]
            if score > best:
                best, choice = score, (float(focal), roll)
    out = {}
    for n, shape in shapes.items():
        q = _turned(shape, choice[1]) * choice[0] * size[0] + np.array(size) / 2
        spots = pictures.spots(n, step_px(q))
        shift, _ = find_shift(spots, q, 0.25 * size[0], dilate_px=4)
        out[n] = _unshifted(complete(spots, q + shift), spots, q + shift, data.board)
    return out


def _unshifted(found: Detection, spots: NDArray[np.float32], q: Float, board: Board) -> Detection:
    """The detection, or that of a grid one row or column further if it lies on more spots: a board's edge can pass for
    a row of pins. Again from there, until no neighbour is better."""
    best = None
    while best is not found:
        best = found
        grid = (found.tried if found.score > 0 else q).reshape(board.rows, board.columns, 2)
        for across, down in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            moved = _stepped(_stepped(grid, across, axis=1), down, axis=0)
            found = max(found, complete(spots, moved.reshape(-1, 2)), key=lambda d: d.score)
    return found


def _stepped(grid: Float, step: int, axis: int) -> Float:
    """A grid (rows, columns, 2) laid one point further, the new line by extrapolation."""
    g = np.moveaxis(grid, axis, 0)[:: step or 1]
    g = np.concatenate([g[1:], 2 * g[-1:] - g[-2:-1]]) if step else g
    return np.moveaxis(g[:: step or 1], 0, axis)


def _predicted(
    data: CalibrationSet, color: SingleFit, pictures: ThermalPictures, before: dict[str, Detection]
) -> dict[str, Detection]:
    """Every view again, from the rig as known now. A view's rig is that of the nearest view in the same run."""
    thermal = fit_camera(data, "thermal")
    problem = Problem(data)
    single = {"color": color, "thermal": thermal}
    held = Options(fixed=frozenset({"spacing", *single}), sigma={c: s.sigma_px for c, s in single.items()})
    fit = solve(problem, initial_guess(problem, single), held)
    grouping = find_groups(misfits(problem, fit.x))
    groups, last = {}, 0
    for v in problem.views:
        last = grouping.group.get(v.name, last)
        groups[v.name] = last
    problem = Problem(data, groups=groups)
    fit = solve(problem, initial_guess(problem, single), held)
    board, out = data.board.points_m, {}
    poses = color.poses()
    for n in before:
        T = from_rt(fit.block(problem.extrinsic_key("thermal", groups.get(n, last)))) @ poses[n]
        X = board @ T[:3, :3].T + T[:3, 3]
        q = project_with_jacobian(X, thermal.intrinsics)[0]
        spots = pictures.spots(n, step_px(q))
        shift, _ = find_shift(spots, q, min(REACH_PX, 0.45 * step_px(q) + 4), dilate_px=1)
        new = complete(spots, q + shift)
        out[n] = new if new.score >= before[n].score else before[n]
    return out


def _turned(xy: Float, roll_deg: float) -> Float:
    a = np.radians(roll_deg)
    return xy @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])


def _shrink(image: NDArray[np.float32]) -> NDArray[np.float32]:
    h, w = image.shape
    return cv2.resize(image, (w // COARSE, h // COARSE), interpolation=cv2.INTER_AREA).astype(np.float32)


def _size(images: Mapping[str, NDArray]) -> tuple[int, int]:
    shapes = {i.shape for i in images.values()}
    if len(shapes) != 1:
        raise ScanError(f"the thermal pictures differ in size: {', '.join(map(str, sorted(shapes)))}")
    h, w = shapes.pop()
    return w, h


def _why(pictures: ThermalPictures, good: int, count: int) -> str:
    if len(pictures.saturated) > count / 2:
        return f"{len(pictures.saturated)} of {count} thermal pictures are saturated, the pins cannot be seen"
    return f"the pins were found in {good} of {count} thermal pictures"


def _next_step(pictures: ThermalPictures) -> str:
    if pictures.saturated:
        return "widen the camera's temperature range and record again"
    return "warm the board, hold something warm beside the camera, check columns and rows, or pick points by hand"
