"""The depth camera on top of the point cameras: samples, orientation, noise, and the fit of all together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...robust import mad_sigma
from ...types import Camera, Float
from ..board.views import CalibrationSet
from ..detect.depth_samples import sample_board
from ..detect.dropouts import MARK_SIGMA_PX, agreeing, register_dropouts
from .bundle import Options, Problem
from .cameras import intrinsics_of, to_rt
from .depth_model import DepthModel, DisparityDepth
from .joint import lens_priors, plausible
from .mirror import fits_unmirrored, refuse_mirrored_depth
from .single import SingleFit
from .solver import Fit, solve

# One sigma of the depth camera's place about the guess, hub axes: pupils on one frame stand side by side, not behind
# each other; boards alone trade that distance against the depth scale.
DEPTH_PLACE_M = (0.1, 0.1, 0.015)
PLANE_FLOOR = 2.5e-5  # m at 1 m: no depth camera is truer than this over a whole plane, however many pixels it averages
MIN_MARKED_VIEWS = 4
KINECT_FOCAL = 585.0 / 640.0  # image widths; structured-light and many time-of-flight cameras lie near it

DepthImages = Mapping[str, Callable[[], NDArray]]


def fit_with_depth(
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
    if depth_lens_known:
        x[problem.slices["depth"]] = intrinsics_of(depth_camera)
    x[problem.slices["depth_model"]] = model.start()
    fixed = set(fit.options.fixed) - {"spacing"}
    fixed |= {"depth_model"} if free_spacing else {"spacing"}
    if depth_lens_known:
        fixed.add("depth")
    held = frozenset(fixed | {k for k in fit.problem.slices if k not in ("spacing", "depth", key)})
    priors = lens_priors(single, problem, depth_camera)
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
    return plausible(joint, single)


def _depth_sigma(alone: Fit, points: Fit) -> float:
    """Noise of a depth sample, in units of its own sigma, with the design effect of planes that miss as a whole by more
    than the boards' own uncertainty explains."""
    problem = alone.problem
    assert problem.depth is not None
    r, J, columns = problem.depth_residuals(problem.depth, alone.x)
    view = problem.depth.view
    scale = max(mad_sigma(r), 0.05)
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


def with_depth(
    data: CalibrationSet,
    images: DepthImages,
    camera: Camera,
    T_depth_hub: Float,
    poses: dict[str, Float],
    kind: str,
    margin: float,
    scale: float = 1.0,
) -> CalibrationSet:
    """The set with depth samples on each board, and where dropouts draw it.

    poses : T_hub_board by view, metres. margin : spacings by which the board is taken larger than its points. scale :
    of the board's nominal spacing, as found so far.
    """
    board = replace(data.board, spacing_m=data.board.spacing_m * scale)
    outline = board.outline_m(margin)
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
            dropout = register_dropouts(image, camera, T_depth_board, board) if margin >= 0 else None
            if dropout is not None and data.board.kind in ("pins", "checkerboard"):
                found[view.name] = dropout
        views.append(replace(view, depth=samples))
    marks = agreeing(found)
    marks = marks if len(marks) >= MIN_MARKED_VIEWS else {}
    return replace(
        data, views=tuple(replace(v, depth_marks=marks[v.name].marks if v.name in marks else None) for v in views)
    )


def check_depth_orientation(data: CalibrationSet, images: DepthImages, lens: Camera, T: Float, fit: Fit) -> None:
    """Board normals in the depth images, as they are and if need be flipped, against the pictures' boards."""
    poses = fit.board_poses()
    plain = _depth_normals(with_depth(data, images, lens, T, poses, "metric", -0.1), lens, poses)
    if fits_unmirrored(plain):
        return
    flipped: DepthImages = {n: (lambda load=load: load()[:, ::-1]) for n, load in images.items()}  # type: ignore[misc]
    refuse_mirrored_depth(plain, _depth_normals(with_depth(data, flipped, lens, T, poses, "metric", -0.1), lens, poses))


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


def default_depth_camera(images: DepthImages) -> Camera:
    """A camera of the images' size with a Kinect's field of view (57 deg), centred."""
    h, w = next(iter(images.values()))().shape
    f = KINECT_FOCAL * w
    return Camera(w, h, np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1.0]]))
