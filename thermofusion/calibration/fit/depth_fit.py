"""The depth camera on top of the point cameras: samples, orientation, noise, and the fit of all together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...robust import mad_sigma
from ...types import Camera, Float
from ..board.views import CalibrationSet
from ..detect.depth_samples import sample_board
from ..detect.dropouts import MARK_SIGMA_PX, agreeing, register_dropouts
from .bundle import Options, Problem
from .cameras import camera_with, from_rt, intrinsics_of, to_rt
from .depth_model import DepthModel, DisparityDepth
from .joint import lens_priors, plausible
from .mirror import fits_unmirrored, refuse_mirrored_depth
from .single import SingleFit
from .solver import Fit, solve

# One sigma of the depth camera's place about the guess, hub axes: pupils on one frame stand side by side, not behind
# each other; boards alone trade that distance against the depth scale.
DEPTH_PLACE_M = (0.1, 0.1, 0.015)
PLANE_FLOOR = 2.5e-5  # m at 1 m: no depth camera is truer than this over a whole plane, however many pixels it averages
MIN_MARKED_VIEWS = 4  # fewer drawings of dropouts do not outvote one that was matched a square off
UNSURE_SPACINGS = -0.1  # the board's margin while the depth camera's place is a guess: the rim may lie beside the board
MAX_TURNS = 3  # the third only where the second found the board drawn by dropouts
KINECT_FOCAL = 585.0 / 640.0  # image widths; structured-light and many time-of-flight cameras lie near it

DepthImages = Mapping[str, Callable[[], NDArray]]


@dataclass(frozen=True, eq=False)
class DepthStart:
    """What the fit of the depth camera starts from.

    images : view name -> loader of (H, W), m along z (NaN none), or raw disparity for DisparityDepth. model : of their
    error. sheet : the camera's data sheet, None if nobody knows it; with `lens_known` the maker's calibration of this
    very camera, which is held. T_guess : (4, 4) first guess of T_depth_hub. free_spacing : the boards' spacing is
    unknown, and depth true in scale. lens, T_depth_hub (4, 4) : lens and place as known so far.
    """

    images: DepthImages
    model: DepthModel
    sheet: Camera | None
    lens_known: bool
    T_guess: Float
    free_spacing: bool
    lens: Camera
    T_depth_hub: Float

    def at(self, fit: Fit) -> DepthStart:
        """With lens and place as a fit found them."""
        lens = camera_with(fit.block("depth"), self.model.size)
        return replace(self, lens=lens, T_depth_hub=from_rt(fit.block(f"T_depth_{fit.problem.hub}")))


def add_depth(points: Fit, single: dict[str, SingleFit], start: DepthStart) -> tuple[Fit, list[str]]:
    """Depth on top of the point cameras' fit, in turns: each knows better where the boards lie in the depth images.

    Raises ScanError: pictures of another size, mirrored depth images, no board in them.
    """
    data, size = points.problem.data, start.model.size
    if data.image_size.get("depth", size) != size:
        raise ScanError(
            "the infrared pictures are {} x {} px, the depth images {} x {}".format(*data.image_size["depth"], *size),
            hint="crop them to the same pixels: both must be one camera's",
        )
    margin = UNSURE_SPACINGS
    if "depth" in single:  # infrared pictures say where the depth camera is
        seen, margin = start.at(points), 0.0
        start = replace(seen, lens=start.lens) if start.lens_known else seen
    if not isinstance(start.model, DisparityDepth):
        check_depth_orientation(points, start)
    fit, notes = points, list[str]()
    for turn in range(MAX_TURNS):
        scale = float(np.exp(fit.block("spacing")[0]))
        sampled = with_depth(data, start, fit.board_poses(), margin, scale)
        fit, notes = fit_with_depth(points, sampled, single, start)
        start, margin = start.at(fit), 0.0
        if turn == 1 and not any(v.depth_marks for v in sampled.views):
            break
    return fit, notes


def fit_with_depth(
    points: Fit, data: CalibrationSet, single: dict[str, SingleFit], start: DepthStart
) -> tuple[Fit, list[str]]:
    """Depth planes on top of the point cameras' fit: first alone against held boards, which shows how far whole planes
    miss; then everything together with that as their weight.

    Raises ScanError if no depth image shows a board.
    """
    before, camera = points.problem, start.sheet or start.lens
    groups = dict(zip((v.name for v in before.views), before.group.tolist(), strict=True))
    problem = Problem(data, groups=groups, depth_model=start.model, depth_size=start.model.size)
    if problem.depth is None:
        raise ScanError(
            "no depth image shows the board's plane",
            hint="give a first guess of T_depth_color, or check the depth unit",
        )
    key = f"T_depth_{problem.hub}"
    fixed = set(points.options.fixed) - {"spacing"} | {"depth_model" if start.free_spacing else "spacing"}
    if start.lens_known:
        fixed.add("depth")
    held = frozenset(fixed | {k for k in before.slices if k not in ("spacing", "depth", key)})
    priors = lens_priors(single, problem, camera)
    if "depth" not in single:
        place = zip("xyz", start.T_guess[:3, 3], DEPTH_PLACE_M, strict=True)
        priors |= {f"{key}.t{axis}": (float(m), e) for axis, m, e in place}
    marks = MARK_SIGMA_PX * 2.0  # four corners share one measured shift
    options = Options(fixed=held, priors=priors, sigma={"depth": marks, **points.options.sigma})
    x = _depth_guess(problem, points, camera, start)
    for _ in range(2):
        alone = solve(problem, x, options)
        x = alone.x
        options = replace(options, sigma={**options.sigma, "depth_plane": _depth_sigma(alone, points)})
    joint = solve(problem, x, replace(options, fixed=frozenset(fixed)))
    return plausible(joint, single)


def _depth_guess(problem: Problem, points: Fit, camera: Camera, start: DepthStart) -> Float:
    """(P,) start of the fit with depth: what the point cameras' fit found, and the depth camera as known so far."""
    x = np.zeros(len(problem.names))
    for key, s in points.problem.slices.items():
        x[problem.slices[key]] = points.x[s]
    if "depth" not in points.problem.slices:
        x[problem.slices[f"T_depth_{problem.hub}"]] = to_rt(start.T_depth_hub)
    if "depth" not in points.problem.slices or start.lens_known:
        x[problem.slices["depth"]] = intrinsics_of(camera)
    x[problem.slices["depth_model"]] = start.model.start()
    return x


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
    data: CalibrationSet, start: DepthStart, poses: Mapping[str, Float], margin: float, scale: float = 1.0
) -> CalibrationSet:
    """The set with depth samples on each board, and where dropouts draw it.

    poses : T_hub_board (4, 4) by view, m. margin : spacings by which the board is taken larger than its points. scale :
    of the board's nominal spacing, as found so far. Raises ScanError if an image is of another size than the camera.
    """
    board, disparity = (
        replace(data.board, spacing_m=data.board.spacing_m * scale),
        isinstance(start.model, DisparityDepth),
    )
    outline = board.outline_m(margin)
    views, found = [], {}
    for view in data.views:
        samples = None
        if view.name in start.images and view.name in poses:
            image, T_depth_board = _image(start, view.name), start.T_depth_hub @ poses[view.name]
            samples = sample_board(image, start.lens, T_depth_board, outline, disparity=disparity)
            dropout = register_dropouts(image, start.lens, T_depth_board, board) if margin >= 0 else None
            if dropout is not None and data.board.kind in ("pins", "checkerboard"):
                found[view.name] = dropout
        views.append(replace(view, depth=samples))
    marks = agreeing(found)
    marks = marks if len(marks) >= MIN_MARKED_VIEWS else {}
    return replace(
        data, views=tuple(replace(v, depth_marks=marks[v.name].marks if v.name in marks else None) for v in views)
    )


def _image(start: DepthStart, name: str) -> NDArray:
    image, lens = start.images[name](), start.lens
    if image.shape != lens.shape:
        raise ScanError(
            f"the depth image is {image.shape[1]} x {image.shape[0]} px, the camera {lens.width_px} x {lens.height_px}",
            place=name,
        )
    return image


def check_depth_orientation(points: Fit, start: DepthStart) -> None:
    """Raises ScanError if board normals in the depth images fit the pictures' boards only when those are flipped."""
    plain = _depth_normals(points, start)
    if fits_unmirrored(plain):
        return
    flipped: DepthImages = {n: (lambda load=load: load()[:, ::-1]) for n, load in start.images.items()}  # type: ignore[misc]
    refuse_mirrored_depth(plain, _depth_normals(points, replace(start, images=flipped)))


def _depth_normals(points: Fit, start: DepthStart) -> tuple[Float, Float]:
    """(N, 3) unit normals of the boards as the pictures have them, and of planes through the depth samples."""
    a, b, K, poses = [], [], start.lens.K, points.board_poses()
    for view in with_depth(points.problem.data, start, poses, UNSURE_SPACINGS).views:
        if view.depth is None or view.name not in poses:
            continue
        d = view.depth
        x = np.stack([(d.u_px - K[0, 2]) / K[0, 0], (d.v_px - K[1, 2]) / K[1, 1], np.ones(len(d))], axis=1)
        X = x * d.value[:, None]
        n = np.linalg.svd(X - X.mean(0), full_matrices=False)[2][2]
        a.append(poses[view.name][:3, 2])
        b.append(n * np.sign(n[2]))
    return np.array(a).reshape(-1, 3), np.array(b).reshape(-1, 3)


def default_depth_camera(images: DepthImages) -> Camera:
    """A camera of the images' size with a Kinect's field of view (57 deg), centred."""
    h, w = next(iter(images.values()))().shape
    f = KINECT_FOCAL * w
    return Camera(w, h, np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1.0]]))
