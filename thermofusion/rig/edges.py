"""Where the model's outline should stand in a thermal image, and where the image shows it.

Only outlines against the empty background are used: rays of a coarse pixel grid find where the surface ends, bisection
finds the end to a fraction of a pixel. A true occluding contour is seen edge-on, and away from the mesh's open borders;
the rim of a hole or of the cut at the waist is dropped (the body goes on where the mesh does not). The image's edge is
the steepest step along the outline's normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.outline import ProjectedContour
from ..types import Float, Float32

PROFILE_STEP_PX = 0.5
BLUR_SIGMA_PX = 1.0  # of the image before its steepest step is looked for: noise of the derivative
CLIMB = 4  # steps from a preferred place on an edge to its top
FLANK_PX = 4.0  # the step's height is taken this far on both sides


@dataclass(frozen=True, eq=False)
class Edges:
    """Image edges found along the normals of N projected contour points.

    offset_px : (N,) signed distance from the prediction to the edge, positive outward; NaN = none within reach.
    step : (N,) inside minus outside, in the image's unit.
    """

    offset_px: Float
    step: Float


def smooth_image(image: NDArray) -> Float32:
    """The image (H, W) blurred for derivatives; NaN pixels spread as NaN over the kernel."""
    return np.asarray(cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), BLUR_SIGMA_PX), np.float32)


def find_edges(smooth: Float32, contour: ProjectedContour, reach_px: float, sign: float) -> Edges:
    """The steepest step of an image along normals, within ±reach.

    smooth : (H, W) from `smooth_image`. sign : +1 if the body is brighter than the background, -1 if darker, 0 either.
    """
    span = reach_px + FLANK_PX + PROFILE_STEP_PX
    s = np.arange(-span, span + 1e-6, PROFILE_STEP_PX)
    at = contour.uv_px[:, None, :] + s[None, :, None] * contour.normal_px[:, None, :]
    profile: Float = cv2.remap(
        smooth,
        at[..., 0].astype(np.float32),
        at[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    ).astype(np.float64)
    fall = (profile[:, :-2] - profile[:, 2:]) / (2 * PROFILE_STEP_PX)
    strength = np.abs(fall) if sign == 0 else sign * fall
    s_fall = s[1:-1]
    # A nearer edge is the likelier one, so it is preferred, gently; its place is where the image itself is steepest.
    prefer = np.where(np.abs(s_fall) <= reach_px, 1 / (1 + (s_fall / reach_px) ** 2), 0.0)
    whole = np.asarray(np.isfinite(profile).all(1))
    strength = np.where(whole[:, None], strength, 0.0)
    peak, row, last = np.argmax(strength * prefer, axis=1), np.arange(len(profile)), len(s_fall) - 1
    for _ in range(CLIMB):
        around = np.stack([np.clip(peak + d, 0, last) for d in (-1, 0, 1)])
        peak = around[np.argmax(strength[row, around], axis=0), row]
    inside_reach = np.abs(s_fall[peak]) < reach_px - PROFILE_STEP_PX
    left, mid, right = (strength[row, np.clip(peak + d, 0, last)] for d in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = np.clip(0.5 * (left - right) / (left - 2 * mid + right), -1, 1)
    offset = s_fall[peak] + np.where(np.isfinite(shift), shift, 0.0) * PROFILE_STEP_PX
    flank = round(FLANK_PX / PROFILE_STEP_PX)
    step = profile[row, peak + 1 - flank] - profile[row, np.minimum(peak + 1 + flank, profile.shape[1] - 1)]
    return Edges(np.where(whole & inside_reach, offset, np.nan), np.where(whole, step, np.nan))
