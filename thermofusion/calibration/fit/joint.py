"""All point cameras together: where they sit to each other, and how much the views may say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...errors import ScanError
from ...geometry.rigid import invert
from ...types import Camera, Float
from ..board.views import CalibrationSet
from .bundle import Options, Problem
from .cameras import FOCAL, INTRINSIC_NAMES, PINHOLE, intrinsics_of, to_rt
from .single import SingleFit, noise_px
from .solver import Fit, solve
from .start import common_transform

FOCAL_PRIOR = 0.01  # one sigma of a joint focal length about the camera's own fit
CENTER_PRIOR = 0.01  # of the principal point, image widths
FOCAL_LIMIT = 0.03  # a joint fit that leaves this is not believed
DEPTH_FOCAL_PRIOR = 0.01  # of a depth camera's focal length about its data sheet
DEPTH_CENTER_PRIOR = 0.01  # of its principal point, image widths


def initial_guess(problem: Problem, single: dict[str, SingleFit]) -> Float:
    """Start (P,) of the joint fit, px, rad and m: single lenses; poses in the hub's frame, through the extrinsic where
    the hub is blind."""
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


def fit_jointly(
    data: CalibrationSet, single: dict[str, SingleFit], groups: dict[str, int] | None
) -> tuple[Fit, list[str]]:
    """All point cameras: three rounds, each with the noise, and the misfit of the rig itself, that the last showed."""
    problem = Problem(data, groups=groups)
    fixed = frozenset({"spacing"} | {f"{c}.k3" for c, s in single.items() if not s.uses_k3})
    options = Options(
        fixed=fixed, priors=lens_priors(single, problem, None), sigma={c: s.sigma_px for c, s in single.items()}
    )
    fit = solve(problem, initial_guess(problem, single), options)
    for _ in range(2):
        options = replace(options, sigma=_noise_levels(fit, single))
        fit = solve(problem, fit.x, options)
    return plausible(fit, single)


def plausible(fit: Fit, single: dict[str, SingleFit]) -> tuple[Fit, list[str]]:
    """Lenses held at their own fits where the joint one left the limit."""
    notes = []
    for c, s in single.items():
        away = float(np.abs(fit.block(c)[FOCAL] / s.intrinsics[FOCAL] - 1).max())
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


def lens_priors(
    single: dict[str, SingleFit], problem: Problem, depth_camera: Camera | None
) -> dict[str, tuple[float, float]]:
    """A joint fit may move a lens only as far as that camera's own pictures leave open, and a little."""
    out: dict[str, tuple[float, float]] = {}
    for c, s in single.items():
        width = problem.sizes[c][0]
        floor = np.array([FOCAL_PRIOR * s.intrinsics[0]] * 2 + [CENTER_PRIOR * width] * 2 + [0.02] * 4)
        sigma = np.maximum(floor, 4 * s.sigmas[: len(floor)])  # all but k3, which the camera's own fit has decided
        rows = zip(INTRINSIC_NAMES, s.intrinsics, sigma, strict=False)
        out |= {f"{c}.{n}": (float(m), float(e)) for n, m, e in rows}
    if depth_camera is not None and "depth" not in single:
        k = intrinsics_of(depth_camera)[PINHOLE]
        sigmas = (DEPTH_FOCAL_PRIOR * k[0],) * 2 + (DEPTH_CENTER_PRIOR * depth_camera.width_px,) * 2
        rows = zip(INTRINSIC_NAMES, k, sigmas, strict=False)
        out |= {f"depth.{n}": (float(m), float(e)) for n, m, e in rows}
    return out


def _noise_levels(fit: Fit, single: dict[str, SingleFit]) -> dict[str, float]:
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
