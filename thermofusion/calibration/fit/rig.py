"""The whole rig: cameras alone, their places to each other, depth, and what the fit says about itself."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ...errors import ScanError
from ...geometry.rigid import invert
from ...scans.native.depth_correction import MetricDepth
from ...types import Camera, Float
from ..board.views import CAMERAS, BoardView, CalibrationSet
from .bundle import Options, Problem
from .cameras import camera_with, from_rt, project_with_jacobian, to_rt
from .depth_fit import DepthImages, DepthStart, add_depth, default_depth_camera
from .depth_model import DepthModel, DisparityDepth
from .groups import Grouping, find_groups, misfits
from .joint import fit_jointly, initial_guess
from .mirror import refuse_mirrored, refuse_mirrored_pair
from .single import SingleFit, fit_camera
from .solver import Fit, solve
from .start import board_pose

HOUSING_M, BESIDE_M = 0.08, 0.01  # lenses of one housing stand this close, and level to this
STEP = 1e-6  # rad and m, of derivatives by differences


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything a calibration found.

    fit : the joint bundle. single : each camera alone. grouping : None with fewer than two cameras. chosen_group : the
    state of the rig reported. cameras : by name. extrinsics : `T_color_depth`, `T_thermal_depth` (4, 4), m, of that
    state (without depth `T_thermal_color`); extrinsic_covariance : (6, 6), rad and m. spacing_m and its sigma.
    notes : sentences for the user, worst first.
    """

    fit: Fit
    single: dict[str, SingleFit]
    grouping: Grouping | None
    chosen_group: int
    cameras: dict[str, Camera]
    extrinsics: dict[str, Float]
    extrinsic_covariance: dict[str, Float]
    spacing_m: float
    spacing_sigma_m: float
    notes: tuple[str, ...] = field(default=())

    @property
    def data(self) -> CalibrationSet:
        """What was seen, without what was left out."""
        return self.fit.problem.data

    @property
    def depth_model(self) -> DepthModel | None:
        """Of the reported depth's error; its parameters are the fit's block of that name."""
        return self.fit.problem.depth_model

    def views_used(self) -> list[str]:
        """Names of the views in the fit."""
        return [v.name for v in self.fit.problem.views]


def calibrate_views(
    data: CalibrationSet,
    *,
    depth_images: DepthImages | None = None,
    depth_camera: Camera | None = None,
    depth_kind: str = "metric",
    T_depth_hub: Float | None = None,
    depth_lens_known: bool = False,
    free_spacing: bool = False,
    group: int | None = None,
) -> Calibration:
    """Cameras, rig and depth from what was seen of the board.

    depth_images : view name -> loader of (H, W), m (NaN none), or, for depth_kind `disparity`, raw disparity.
    depth_camera : its data sheet (default: a Kinect's field of view), or with `depth_lens_known` the maker's own
    calibration of this very camera, which is then held. T_depth_hub : (4, 4) first guess, default identity.
    free_spacing : estimate the board's spacing; depth must then be true in scale. group : which state of the rig to
    report where it moved; default the one with most views.

    Raises ScanError with the next step for input that cannot be used (see `single`, `mirror`).
    """
    if not data.cameras:
        raise ScanError("no camera sees the board", hint="check the board's columns and rows")
    refuse_mirrored(data)
    single = {c: fit_camera(data, c) for c in data.cameras}
    _refuse_mirrored_pairs(single)
    grouping = _grouping(data, single)
    notes = _group_notes(grouping)
    if grouping is not None and grouping.outliers:
        data = replace(data, views=tuple(_without(v, grouping) for v in data.views))
    groups = None if grouping is None else _runs(grouping, [v.name for v in data.views])
    fit, held = fit_jointly(data, single, groups)
    if depth_images:
        lens = depth_camera or default_depth_camera(depth_images)
        model = (DisparityDepth if depth_kind == "disparity" else MetricDepth)((lens.width_px, lens.height_px))
        T = np.eye(4) if T_depth_hub is None else T_depth_hub
        start = DepthStart(depth_images, model, depth_camera, depth_lens_known, T, free_spacing, lens, T)
        fit, more = add_depth(fit, single, start)
        held = held + more
    return _assemble(fit.resampled(), single, grouping, group, (*notes, *held))


def _refuse_mirrored_pairs(single: dict[str, SingleFit]) -> None:
    hub, *others = single
    for c in others:
        refuse_mirrored_pair(hub, single[hub].poses(), c, single[c].poses())


def _grouping(data: CalibrationSet, single: dict[str, SingleFit]) -> Grouping | None:
    """Runs of views: lenses from the single fits, extrinsic and board poses solved as if for one rig."""
    problem = Problem(data)
    x0 = initial_guess(problem, single)
    if "thermal" not in problem.cameras or problem.hub == "thermal":
        return None
    held = Options(fixed=frozenset({"spacing", *single}), sigma={c: s.sigma_px for c, s in single.items()})
    fit = solve(problem, x0, held)
    return find_groups(misfits(problem, fit.x))


def _without(view: BoardView, grouping: Grouping) -> BoardView:
    """The view with its thermal points left out if it was named an outlier: colour and depth may still be good."""
    return view.with_points("thermal", None) if view.name in grouping.outliers else view


def _runs(grouping: Grouping, names: list[str]) -> dict[str, int]:
    """Views that the second camera did not see take the run of the view before them."""
    out, last = {}, min(grouping.group.values())
    for n in names:
        last = grouping.group.get(n, last)
        out[n] = last
    return out


def _group_notes(grouping: Grouping | None) -> list[str]:
    if grouping is None:
        return []
    notes = [
        f"view {n}: its thermal points lie {px:.1f} px from where the other views put them; left out, look at its "
        "picks or repeat it"
        for n, px in grouping.outliers.items()
    ]
    if grouping.count > 1:
        runs = [grouping.names(k) for k in range(grouping.count)]
        text = ", ".join(f"{r[0]} to {r[-1]} ({len(r)} views)" for r in runs)
        notes.append(f"the thermal camera moved on the rig between groups of views: {text}; each has its own extrinsic")
    return notes


def _assemble(
    fit: Fit, single: dict[str, SingleFit], grouping: Grouping | None, group: int | None, notes: tuple[str, ...]
) -> Calibration:
    problem = fit.problem
    chosen = int(np.argmax(np.bincount(problem.group))) if group is None else group
    lenses = {c: camera_with(fit.block(c), problem.sizes[c]) for c in CAMERAS if c in problem.slices}
    extrinsics, covariances = derived_extrinsics(fit, chosen)
    s = problem.slices["spacing"].start
    spacing = problem.data.board.spacing_m * float(np.exp(fit.x[s]))
    sigma = spacing * float(np.sqrt(fit.covariance[s, s]))
    notes = (*notes, *_implausible(extrinsics))
    if not fit.converged:
        notes = (f"the joint fit did not converge ({fit.message})", *notes)
    return Calibration(fit, single, grouping, chosen, lenses, extrinsics, covariances, spacing, sigma, notes)


def _implausible(extrinsics: dict[str, Float]) -> list[str]:
    """A colour camera that stands beside the depth camera, as in one housing, but before or behind it."""
    T = extrinsics.get("T_color_depth")
    if T is None or np.linalg.norm(T[:2, 3]) > HOUSING_M or abs(T[2, 3]) < BESIDE_M:
        return []
    where = "behind" if T[2, 3] > 0 else "before"
    return [
        f"the colour lens comes out {abs(T[2, 3]) * 1e3:.0f} mm {where} the depth lens: in one housing they stand side "
        "by side, and depth may be off by as much, which sigma does not hold; infrared pictures of the board settle it"
    ]


def predict_px(
    calibration: Calibration, view: BoardView, *, camera: str = "thermal", group: int | None = None
) -> Float:
    """(N, 2) px: where the rig puts the board points of `camera` minus where they were seen.

    The board's pose is taken from the hub's picture alone; the view need not have been part of the fit."""
    fit, problem = calibration.fit, calibration.fit.problem
    k = calibration.chosen_group if group is None else group
    board = problem.data.board.points_m * calibration.spacing_m / problem.data.board.spacing_m
    T = from_rt(fit.block(problem.extrinsic_key(camera, k if camera == "thermal" else 0)))
    T = T @ board_pose(view.points[problem.hub], board, fit.block(problem.hub))
    X = board[view.points[camera].index] @ T[:3, :3].T + T[:3, 3]
    return project_with_jacobian(X, fit.block(camera))[0] - view.points[camera].px


def held_out_px(
    calibration: Calibration, view: BoardView, *, camera: str = "thermal", group: int | None = None
) -> Float:
    """(N, 2) px residuals of `camera` in a view that took no part in the fit, as a training view would have them.

    The rig is held; the board's pose, unknown for every view, is fitted to all cameras at the fit's own weights.
    """
    fit = calibration.fit
    k = calibration.chosen_group if group is None else group
    problem = Problem(replace(calibration.data, views=(view,)), groups={view.name: k})
    own = f"view:{view.name}"
    rig = {key: s for key, s in problem.slices.items() if key != own}
    x = np.zeros(len(problem.names))
    for key, s in rig.items():
        x[s] = fit.block(key)
    board = problem.data.board.points_m
    x[problem.slices[own]] = to_rt(board_pose(view.points[problem.hub], board, fit.block(problem.hub)))
    alone = solve(problem, x, replace(fit.options, fixed=frozenset(rig), priors={}))
    return alone.residuals()[camera][0]


def _relative(a: Float, b: Float) -> Float:
    """`to_rt` of T_a_hub @ T_hub_b, from the (6,) of T_a_hub and T_b_hub."""
    return to_rt(from_rt(a) @ invert(from_rt(b)))


def derived_extrinsics(fit: Fit, group: int) -> tuple[dict[str, Float], dict[str, Float]]:
    """T_color_depth, T_thermal_depth (or T_thermal_color without depth) and (6, 6) covariances of their (rotation
    vector [rad], translation [m]), by differences of the composed transform."""
    p = fit.problem
    keys = {c: p.extrinsic_key(c, group if c == "thermal" else 0) for c in CAMERAS}
    rt = {c: (np.zeros(6) if c == p.hub else fit.block(k)) for c, k in keys.items() if c == p.hub or k in p.slices}
    base = "depth" if "depth" in rt else p.hub
    out, cov = {}, {}
    for c in rt:
        if c == base:
            continue

        columns, J = [], []
        for name, first in ((c, True), (base, False)):
            if name == p.hub:
                continue
            s = p.slices[keys[name]]
            columns += list(range(s.start, s.stop))
            for k in range(6):
                h = np.zeros(6)
                h[k] = STEP
                up, down = (_relative(rt[c] + (d if first else 0), rt[base] + (0 if first else d)) for d in (h, -h))
                J.append((up - down) / (2 * STEP))
        Jm = np.array(J).T
        out[f"T_{c}_{base}"] = from_rt(rt[c]) @ invert(from_rt(rt[base]))
        cov[f"T_{c}_{base}"] = Jm @ fit.covariance[np.ix_(columns, columns)] @ Jm.T
    return out, cov
