"""The whole rig: cameras alone, their places to each other, depth, and what the fit says about itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..geometry import invert
from ..types import Camera, Float
from .bundle import Fit, Options, Problem, solve
from .cameras import camera_of, from_rt, intrinsics_of, project_with_jacobian, to_rt
from .depth_model import DepthModel, DisparityDepth, MetricDepth
from .depth_samples import sample_board
from .dropouts import MARK_SIGMA_PX, agreeing, register_dropouts
from .groups import Grouping, find_groups, misfits
from .mirror import fits_unmirrored, refuse_mirrored, refuse_mirrored_depth, refuse_mirrored_pair
from .single import SingleFit, fit_camera, noise_px
from .start import board_pose, common_transform
from .views import MIN_POINTS, CalibrationSet, View

FOCAL_PRIOR = 0.01  # one sigma of a joint focal length about the camera's own fit
CENTER_PRIOR = 0.01  # of the principal point, image widths
FOCAL_LIMIT = 0.03  # a joint fit that leaves this is not believed
DEPTH_FOCAL_PRIOR = 0.01  # of a depth camera's focal length about its data sheet
DEPTH_CENTER_PRIOR = 0.01  # of its principal point, image widths
DEPTH_PLACE_M = (
    0.1,
    0.1,
    0.015,
)  # of the depth camera's place about the guess, hub axes: pupils on one frame stand side
# by side, not behind each other; boards alone trade that distance against the depth scale
PLANE_FLOOR = 1e-4  # m at 1 m: no depth camera is truer than this over a whole plane, however many pixels it averages
MIN_MARKED_VIEWS = 4
KINECT_FOCAL = 585.0 / 640.0  # image widths; structured-light and many time-of-flight cameras lie near it

DepthImages = Mapping[str, Callable[[], NDArray]]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything a calibration found.

    cameras : by name; `T_color_depth`, `T_thermal_depth` of the chosen group (None: not determined). fit : the joint
    bundle. single : each camera alone. grouping : None with fewer than two cameras. spacing_m and its sigma.
    depth_model, depth_parameters : correction of reported depth. notes : sentences for the user, worst first.
    """

    data: CalibrationSet
    fit: Fit
    single: dict[str, SingleFit]
    grouping: Grouping | None
    chosen_group: int
    cameras: dict[str, Camera]
    extrinsics: dict[str, Float]
    extrinsic_covariance: dict[str, Float]
    spacing_m: float
    spacing_sigma_m: float
    depth_model: DepthModel | None
    notes: tuple[str, ...] = field(default=())

    @property
    def depth_parameters(self) -> Float | None:
        return None if self.depth_model is None else self.fit.block("depth_model")

    def views_used(self) -> list[str]:
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

    depth_images : view name -> loader of metres (NaN none) or, for depth_kind `disparity`, of raw disparity.
    depth_camera : its data sheet (default: a Kinect's field of view), or with `depth_lens_known` the maker's own
    calibration of this very camera, which is then held. T_depth_hub : first guess, default identity.
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
    groups = None if grouping is None else _spread(grouping, [v.name for v in data.views])
    fit, more = _joint(data, single, groups)
    model: DepthModel | None = None
    if depth_images:
        lens = depth_camera or _default_depth_camera(depth_images)
        size = (lens.width_px, lens.height_px)
        model = DisparityDepth(size) if depth_kind == "disparity" else MetricDepth(size)
        guess = np.eye(4) if T_depth_hub is None else T_depth_hub
        T, margin = guess, -0.1
        points = fit
        if depth_kind == "metric":
            _refuse_mirrored_depth(data, depth_images, lens, T, fit)
        for turn in range(3):  # again, knowing where the board lies in the depth image
            seen = _with_depth(data, depth_images, lens, T, fit.board_poses(), depth_kind, margin)
            fit, extra = _add_depth(
                points, seen, single, groups, model, depth_camera or lens, T, guess, free_spacing, depth_lens_known
            )
            lens = camera_of(fit.block("depth"), size)
            T, margin = from_rt(fit.block(f"T_depth_{fit.problem.hub}")), 0.0
            if turn == 1 and not any(v.depth_marks for v in seen.views):
                break
        data, more = seen, more + extra
    return _assemble(data, fit, single, grouping, model, group, (*notes, *more))


def _refuse_mirrored_pairs(single: dict[str, SingleFit]) -> None:
    hub, *others = single
    for c in others:
        refuse_mirrored_pair(hub, single[hub].poses(), c, single[c].poses())


def _refuse_mirrored_depth(data: CalibrationSet, images: DepthImages, lens: Camera, T: Float, fit: Fit) -> None:
    """Board normals in the depth images, as they are and if need be flipped, against the pictures' boards."""
    poses = fit.board_poses()
    plain = _depth_normals(_with_depth(data, images, lens, T, poses, "metric", -0.1), lens, poses)
    if fits_unmirrored(plain):
        return
    flipped: DepthImages = {n: (lambda load=load: load()[:, ::-1]) for n, load in images.items()}  # type: ignore[misc]
    refuse_mirrored_depth(
        plain, _depth_normals(_with_depth(data, flipped, lens, T, poses, "metric", -0.1), lens, poses)
    )


def _depth_normals(data: CalibrationSet, lens: Camera, poses: dict[str, Float]) -> tuple[Float, Float]:
    """(N, 3) unit normals of the boards as the pictures have them, and of planes through the depth samples."""
    a, b, K = [], [], lens.K
    for view in data.views:
        if view.depth is None or view.name not in poses:
            continue
        d = view.depth
        x = np.stack([(d.u_px - K[0, 2]) / K[0, 0], (d.v_px - K[1, 2]) / K[1, 1], np.ones(len(d))], axis=1)
        points = x * d.value[:, None]
        n = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
        a.append(poses[view.name][:3, 2])
        b.append(n * np.sign(n[2]))
    return np.array(a).reshape(-1, 3), np.array(b).reshape(-1, 3)


def _grouping(data: CalibrationSet, single: dict[str, SingleFit]) -> Grouping | None:
    """Runs of views: lenses from the single fits, extrinsic and board poses solved as if for one rig."""
    problem = Problem(data)
    x0 = initial_guess(problem, single)
    if "thermal" not in problem.cameras or problem.hub == "thermal":
        return None
    held = Options(fixed=frozenset({"spacing", *single}), sigma={c: s.sigma_px for c, s in single.items()})
    fit = solve(problem, x0, held)
    return find_groups(misfits(problem, fit.x))


def initial_guess(problem: Problem, single: dict[str, SingleFit]) -> Float:
    """Start of the joint fit: single lenses; poses in the hub's frame, through the extrinsic where the hub is blind."""
    x = np.zeros(len(problem.names))
    poses = {c: s.poses() for c, s in single.items()}
    hub = problem.hub
    for c, s in single.items():
        x[problem.slices[c]] = s.intrinsics
    T_c_hub: dict[str, Float] = {}
    for c in problem.cameras:
        if c == hub:
            continue
        both = [n for n in poses[c] if n in poses[hub]]
        if not both:
            raise ScanError(
                f"no view shows the board to both the {hub} and the {c} camera",
                hint="record the board where both cameras see it, and name the files alike",
            )
        for g in sorted(set(problem.group.tolist())) if c == "thermal" else [0]:
            in_group = {v.name for v, k in zip(problem.views, problem.group, strict=True) if k == g or c != "thermal"}
            names = [n for n in both if n in in_group] or both
            T = np.stack([poses[c][n] @ invert(poses[hub][n]) for n in names])
            T_c_hub[c] = common_transform(T)
            x[problem.slices[problem.extrinsic_key(c, g)]] = to_rt(T_c_hub[c])
    for view in problem.views:
        seen = next(c for c in (hub, *problem.cameras) if view.name in poses.get(c, {}))
        T = poses[seen][view.name]
        x[problem.slices[f"view:{view.name}"]] = to_rt(T if seen == hub else invert(T_c_hub[seen]) @ T)
    return x


def _joint(data: CalibrationSet, single: dict[str, SingleFit], groups: dict[str, int] | None) -> tuple[Fit, list[str]]:
    """All point cameras: three rounds, each with the noise, and the misfit of the rig itself, that the last showed."""
    problem = Problem(data, groups=groups)
    fixed = frozenset({"spacing"} | {f"{c}.k3" for c, s in single.items() if not s.uses_k3})
    options = Options(
        fixed=fixed, priors=_priors(single, problem, None), sigma={c: s.sigma_px for c, s in single.items()}
    )
    fit = solve(problem, initial_guess(problem, single), options)
    for _ in range(2):
        options = replace(options, sigma=_sigmas(fit, single))
        fit = solve(problem, fit.x, options)
    return _plausible(fit, single)


def _plausible(fit: Fit, single: dict[str, SingleFit]) -> tuple[Fit, list[str]]:
    """Lenses held at their own fits where the joint one left the limit."""
    notes = []
    for c, s in single.items():
        away = float(np.abs(fit.block(c)[:2] / s.intrinsics[:2] - 1).max())
        if away > FOCAL_LIMIT:
            notes.append(
                f"the joint fit pulled the {c} focal length {100 * away:.1f} % away from the camera's own: all lenses "
                "are held at their own fits"
            )
    if not notes:
        return fit, []
    x = fit.x.copy()
    for c, s in single.items():
        x[fit.problem.slices[c]] = s.intrinsics
    return solve(fit.problem, x, replace(fit.options, fixed=fit.options.fixed | set(single))), notes


def _add_depth(
    fit: Fit,
    data: CalibrationSet,
    single: dict[str, SingleFit],
    groups: dict[str, int] | None,
    model: DepthModel,
    depth_camera: Camera,
    T_depth_hub: Float,
    T_guess: Float,
    free_spacing: bool,
    depth_lens_known: bool,
) -> tuple[Fit, list[str]]:
    """Depth planes on top of the point cameras' fit: first alone against held boards, which shows how far whole planes
    miss; then everything together with that as their weight."""
    size = (depth_camera.width_px, depth_camera.height_px)
    problem = Problem(data, groups=groups, depth_model=model, depth_size=size)
    if problem.depth is None:
        raise ScanError(
            "no depth image shows the board's plane",
            hint="give a first guess of T_depth_color, or check the depth unit",
        )
    x = np.zeros(len(problem.names))
    for key, s in fit.problem.slices.items():
        x[problem.slices[key]] = fit.x[s]
    key = f"T_depth_{problem.hub}"
    if "depth" not in fit.problem.slices:
        x[problem.slices["depth"]] = intrinsics_of(depth_camera)
        x[problem.slices[key]] = to_rt(T_depth_hub)
    x[problem.slices["depth_model"]] = model.start()
    fixed = set(fit.options.fixed) - {"spacing"}
    fixed |= {"depth_model"} if free_spacing else {"spacing"}
    if depth_lens_known:
        fixed.add("depth")
    held = frozenset(fixed | {k for k in fit.problem.slices if k not in ("spacing", "depth", key)})
    priors = _priors(single, problem, depth_camera)
    if "depth" not in single:
        place = zip("xyz", T_guess[:3, 3], DEPTH_PLACE_M, strict=True)
        priors |= {f"{key}.t{axis}": (float(m), e) for axis, m, e in place}
    marks = MARK_SIGMA_PX * 2.0  # four corners share one measured shift
    options = Options(fixed=held, priors=priors, sigma={"depth": marks, **fit.options.sigma})
    for _ in range(2):
        alone = solve(problem, x, options)
        x = alone.x
        options = replace(options, sigma={**options.sigma, "depth_plane": _depth_sigma(alone, fit)})
    joint = solve(problem, x, replace(options, fixed=frozenset(fixed)))
    return _plausible(joint, single)


def _priors(
    single: dict[str, SingleFit], problem: Problem, depth_camera: Camera | None
) -> dict[str, tuple[float, float]]:
    """A joint fit may move a lens only as far as that camera's own pictures leave open, and a little."""
    out: dict[str, tuple[float, float]] = {}
    for c, s in single.items():
        width = problem.sizes[c][0]
        floor = np.array([FOCAL_PRIOR * s.intrinsics[0]] * 2 + [CENTER_PRIOR * width] * 2 + [0.02] * 4)
        sigma = np.maximum(floor, 4 * s.sigmas[:8])
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
        out |= {f"{c}.{n}": (float(m), float(e)) for n, m, e in zip(names, s.intrinsics, sigma, strict=False)}
    if depth_camera is not None and "depth" not in single:
        k, w = intrinsics_of(depth_camera), depth_camera.width_px
        for n, m, e in zip(
            ("fx", "fy", "cx", "cy"), k, (DEPTH_FOCAL_PRIOR * k[0],) * 2 + (DEPTH_CENTER_PRIOR * w,) * 2, strict=False
        ):
            out[f"depth.{n}"] = (float(m), float(e))
    return out


def _sigmas(fit: Fit, single: dict[str, SingleFit]) -> dict[str, float]:
    """Noise of each sensor in the joint fit.

    What a camera misses beyond its own fit is common to all points of a view (the rig moved, the board bent), so the
    points of a view are not independent witnesses: sigma grows by Kish's design effect sqrt(1 + (n - 1)·rho) with rho
    the systematic share of the variance. On a rigid rig rho is 0.
    """
    out = {}
    residuals = fit.residuals()
    for c, s in single.items():
        now, own = noise_px(fit, c, free_per_view=4.0), s.sigma_px
        n = len(residuals[c][0]) / max(len(np.unique(residuals[c][1])), 1)
        rho = max(0.0, 1 - (1.03 * own / now) ** 2)
        out[c] = float(now * np.sqrt(1 + (n - 1) * rho))
    return out


def _depth_sigma(alone: Fit, points: Fit) -> float:
    """Noise of a depth sample, in units of its own sigma, with the design effect of planes that miss as a whole by more
    than the boards' own uncertainty explains."""
    problem = alone.problem
    assert problem.depth is not None
    r, J, columns = problem.depth_residuals(problem.depth, alone.x)
    view = problem.depth.view
    scale = max(1.4826 * float(np.median(np.abs(r))), 0.05)
    where = {n: i for i, n in enumerate(points.problem.names)}
    known = np.array([where.get(n, -1) for n in problem.names])
    excess = []
    for i in np.unique(view):
        rows = view == i
        c = known[columns[rows][0]]
        Jv = J[rows].mean(0) * (c >= 0)
        var = Jv @ points.covariance[np.ix_(np.maximum(c, 0), np.maximum(c, 0))] @ Jv
        excess.append((np.median(r[rows]) ** 2 - var) / scale**2 - 1.6 / rows.sum())
    n = len(r) / len(excess)
    middle = float(np.median(problem.depth.value))
    floor = 0.0 if isinstance(problem.depth_model, DisparityDepth) else (PLANE_FLOOR * middle**2) ** 2
    floor /= (scale * float(np.median(problem.depth.sigma))) ** 2
    rho = float(np.clip(np.mean(np.minimum(excess, 9.0)), floor, 9.0))
    return scale * float(np.sqrt(1 + n * rho))


def _with_depth(
    data: CalibrationSet,
    images: DepthImages,
    camera: Camera,
    T_depth_hub: Float,
    poses: dict[str, Float],
    kind: str,
    margin: float,
) -> CalibrationSet:
    outline = data.board.outline_m(margin)
    views, found = [], {}
    for view in data.views:
        samples = None
        if view.name in images and view.name in poses:
            image = images[view.name]()
            if image.shape != camera.shape:
                raise ScanError(
                    f"the depth image is {image.shape[1]} x {image.shape[0]} px, the camera {camera.width_px} x "
                    f"{camera.height_px}",
                    place=view.name,
                )
            T_depth_board = T_depth_hub @ poses[view.name]
            samples = sample_board(image, camera, T_depth_board, outline, disparity=kind == "disparity")
            dropout = register_dropouts(image, camera, T_depth_board, data.board) if margin >= 0 else None
            if dropout is not None and data.board.kind in ("pins", "checkerboard"):
                found[view.name] = dropout
        views.append(replace(view, depth=samples))
    marks = agreeing(found)
    marks = marks if len(marks) >= MIN_MARKED_VIEWS else {}
    return replace(
        data, views=tuple(replace(v, depth_marks=marks[v.name].marks if v.name in marks else None) for v in views)
    )


def _default_depth_camera(images: DepthImages) -> Camera:
    h, w = next(iter(images.values()))().shape
    f = KINECT_FOCAL * w
    return Camera(w, h, np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1.0]]))


def _without(view: View, grouping: Grouping) -> View:
    """The view with its thermal points left out if it was named an outlier: colour and depth may still be good."""
    return view.with_points("thermal", None) if view.name in grouping.outliers else view


def _spread(grouping: Grouping, names: list[str]) -> dict[str, int]:
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
    data: CalibrationSet,
    fit: Fit,
    single: dict[str, SingleFit],
    grouping: Grouping | None,
    model: DepthModel | None,
    group: int | None,
    notes: tuple[str, ...],
) -> Calibration:
    problem = fit.problem
    counts = np.bincount(problem.group)
    chosen = int(np.argmax(counts)) if group is None else group
    lenses = {c: camera_of(fit.block(c), problem.sizes[c]) for c in {*problem.cameras, *(["depth"] if model else [])}}
    extrinsics, covariances = derived_extrinsics(fit, chosen)
    s = problem.slices["spacing"].start
    spacing = data.board.spacing_m * float(np.exp(fit.x[s]))
    sigma = spacing * float(np.sqrt(fit.covariance[s, s]))
    if not fit.converged:
        notes = (f"the joint fit did not converge ({fit.message})", *notes)
    return Calibration(
        data, fit, single, grouping, chosen, lenses, extrinsics, covariances, spacing, sigma, model, notes
    )


def predict_px(calibration: Calibration, view: View, *, camera: str = "thermal", group: int | None = None) -> Float:
    """(N, 2) px: where the rig puts the board points of `camera` minus where they were seen.

    The board's pose is taken from the hub's picture alone; the view need not have been part of the fit."""
    fit, problem = calibration.fit, calibration.fit.problem
    k = calibration.chosen_group if group is None else group
    board = problem.data.board.points_m * calibration.spacing_m / problem.data.board.spacing_m
    T = from_rt(fit.block(problem.extrinsic_key(camera, k if camera == "thermal" else 0)))
    T = T @ board_pose(view.points[problem.hub], board, fit.block(problem.hub))
    X = board[view.points[camera].index] @ T[:3, :3].T + T[:3, 3]
    return project_with_jacobian(X, fit.block(camera))[0] - view.points[camera].px


def derived_extrinsics(fit: Fit, group: int) -> tuple[dict[str, Float], dict[str, Float]]:
    """T_color_depth, T_thermal_depth (or T_thermal_color without depth) and (6, 6) covariances of their (rotation
    vector [rad], translation [m]), by differences of the composed transform."""
    p = fit.problem
    keys = {c: p.extrinsic_key(c, group if c == "thermal" else 0) for c in ("color", "thermal", "depth")}
    rt = {c: (np.zeros(6) if c == p.hub else fit.block(k)) for c, k in keys.items() if c == p.hub or k in p.slices}
    base = "depth" if "depth" in rt else p.hub
    out, cov = {}, {}
    for c in rt:
        if c == base:
            continue

        def relative(a: Float, b: Float) -> Float:
            return to_rt(from_rt(a) @ invert(from_rt(b)))

        columns, J = [], []
        for name, first in ((c, True), (base, False)):
            if name == p.hub:
                continue
            s = p.slices[keys[name]]
            columns += list(range(s.start, s.stop))
            for k in range(6):
                h = np.zeros(6)
                h[k] = 1e-6
                up, down = (relative(rt[c] + (d if first else 0), rt[base] + (0 if first else d)) for d in (h, -h))
                J.append((up - down) / 2e-6)
        Jm = np.array(J).T
        out[f"T_{c}_{base}"] = from_rt(rt[c]) @ invert(from_rt(rt[base]))
        cov[f"T_{c}_{base}"] = Jm @ fit.covariance[np.ix_(columns, columns)] @ Jm.T
    return out, cov


__all__ = ["MIN_POINTS", "Calibration", "calibrate_views", "derived_extrinsics", "predict_px"]
