"""How the errors of vertices add up in a mean over many of them.

A mean averages what errs from spot to spot, not what its vertices have in common. Noise averages over pixels on the
skin, errors of normals over the window that smoothed them. Calibration, ε(0), T_refl, gain and reference are carried by
their signed effects on every vertex; a thermal image that lies askew errs along the gradient, so that it cancels round
a warm spot and adds up on a slope. All other parts count in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Float, Float32, Int, SharedErrors, ThermalMesh, cause_of
from .body import Body
from .patch import Patch

PIXEL_PATCH = 2.25  # pixels whose noise is one: bilinear sampling leaves 4/9 of the variance, over so much more area
AVERAGED = ("noise", "resolution", "normals")  # parts that a mean over an area reduces; a blur only moves things about
ALONG_GRADIENT = ("registration", "scale")  # parts that a picture displaced on the skin, or skin displaced, makes
DERIVED = ("absolute",)  # made of the others
MIN_COS = 0.2  # a pixel is not taken to cover more skin than at 78°


@dataclass(frozen=True, eq=False)
class MeanErrors:
    """One sigma of a weighted mean, K, by cause.

    own_K : what is this region's own, by part. common_K : signed effects of what the whole body shares, (R,), about the
    body's level; absolute_K : the same in full, (R,). names : (R,) of the causes.
    """

    own_K: dict[str, float]
    common_K: Float
    absolute_K: Float
    names: tuple[str, ...]

    @property
    def sigma_K(self) -> float:
        """About the level common to the body."""
        return float(np.sqrt(self._own + (self.common_K**2).sum()))

    @property
    def sigma_absolute_K(self) -> float:
        """On an absolute scale."""
        return float(np.sqrt(self._own + (self.absolute_K**2).sum()))

    @property
    def _own(self) -> float:
        return sum(v**2 for v in self.own_K.values())

    @property
    def budget_K(self) -> dict[str, float]:
        """The parts of `sigma_K`, by name: their squares add up."""
        groups: dict[str, float] = {}
        for name, effect in zip(self.names, self.common_K.tolist(), strict=True):
            kind = cause_of(name)
            groups[kind] = float(np.hypot(groups.get(kind, 0.0), effect))
        return {k: v for k, v in (self.own_K | groups).items() if v > 0}

    def minus(self, other: MeanErrors) -> float:
        """One sigma of the difference to another mean, K: what both have in common cancels."""
        return float(np.sqrt(self._own + other._own + ((self.common_K - other.common_K) ** 2).sum()))


@dataclass(frozen=True, eq=False)
class VertexErrors:
    """The errors of every vertex, as means over vertices need them; unmeasured vertices hold 0.

    noise_K, normals_K, rest_K : (V,). noise_K_m : (V,) noise times the width of skin it is one over, K m. askew_K :
    (V, 3) what a displacement does, along the gradient. common_K : (V, R) signed effects of shared causes, level_K :
    (R,) their level over the body. normal_window_m : over which errors of normals are one; inf where it is not known.
    """

    noise_K: Float32
    noise_K_m: Float32
    normals_K: Float32
    rest_K: Float32
    askew_K: Float32
    common_K: Float32
    level_K: Float32
    names: tuple[str, ...]
    normal_window_m: float

    @classmethod
    def of(cls, mesh: ThermalMesh, shared: SharedErrors | None, body: Body) -> VertexErrors:
        """From a mesh's budget. Without shared errors (an older result) nothing is taken to average."""
        parts = {k: np.nan_to_num(v) for k, v in mesh.uncertainty_parts.items()}
        zero = np.zeros(len(mesh), np.float32)
        noise, normals = np.hypot(parts.get("noise", zero), parts.get("resolution", zero)), parts.get("normals", zero)
        carried = {cause_of(name) for name in shared.names} if shared else set()  # signed, in the shared errors
        apart = {*AVERAGED, *ALONG_GRADIENT, *DERIVED, *carried}
        rest = np.sqrt(sum((v.astype(np.float64) ** 2 for k, v in parts.items() if k not in apart), zero))
        if not parts:
            rest = np.nan_to_num(mesh.uncertainty_K)
        direction = gradient_direction(body.vertices_m, body.triangles, mesh.temperature_degC)
        displaced = np.sqrt(sum((parts.get(k, zero).astype(np.float64) ** 2 for k in ALONG_GRADIENT), zero))
        askew = displaced[:, None] * direction
        if shared is None:
            none = np.zeros((len(mesh), 0), np.float32)
            return cls(noise, noise * np.float32(1e6), normals, _32(rest), _32(askew), none, none[0], (), np.inf)
        cos = np.maximum(np.cos(np.radians(np.nan_to_num(mesh.view_angle_deg))), MIN_COS)
        width = np.sqrt(PIXEL_PATCH / cos) * np.nan_to_num(mesh.distance_m) / shared.focal_px
        common = shared.effect * shared.step_K
        of_body = ~np.char.startswith(np.array(shared.names), "calibration")
        level = np.where(of_body, np.median(common[mesh.measured], axis=0), 0) if mesh.measured.any() else 0 * common[0]
        window = shared.normal_window_m
        return cls(noise, _32(noise * width), normals, _32(rest), _32(askew), common, _32(level), shared.names, window)

    def of_area(self, patch: Patch, area_m2: float) -> MeanErrors:
        """Of the mean over an area; 0 = one spot, where nothing averages."""
        area = max(area_m2, 1e-12)
        return self._of(patch, float(patch.mean(self.noise_K_m**2)) / area, np.pi / 4 * self.normal_window_m**2 / area)

    def of_line(self, patch: Patch, length_m: float) -> MeanErrors:
        """Of the mean along a line: what is one over a width averages over its length."""
        length = max(length_m, 1e-12)
        return self._of(patch, float(patch.mean(self.noise_K * self.noise_K_m)) / length, self.normal_window_m / length)

    def _of(self, patch: Patch, noise_K2: float, normals_share: float) -> MeanErrors:
        common = patch.mean(self.common_K)
        own = {
            "noise": float(np.sqrt(min(float(patch.mean(self.noise_K**2)), noise_K2))),
            "normals": float(np.sqrt(float(patch.mean(self.normals_K**2)) * min(1.0, normals_share))),
            "displacement": float(np.linalg.norm(patch.mean(self.askew_K))),
            "other": float(patch.mean(self.rest_K)),
        }
        return MeanErrors(own, common - self.level_K, common, self.names)


def gradient_direction(vertices_m: Float, triangles: Int, values: NDArray) -> Float:
    """(V, 3) unit vectors along which values (V,) of any unit rise on a surface of vertices_m (V, 3) m; 0: unknown.

    Area-weighted mean of the triangles' (F, 3) gradients Σ T_i (n x e_i) / 2A.
    """
    a, b, c = (vertices_m[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    T = values.astype(np.float64)[triangles]
    rise = sum(T[:, k, None] * np.cross(normal, edge) for k, edge in enumerate((c - b, a - c, b - a)))
    rise = np.nan_to_num(rise / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None])
    corners = triangles.ravel()
    total = np.stack([np.bincount(corners, np.repeat(x, 3), len(vertices_m)) for x in rise.T], axis=1)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-12)[:, None])


def _32(values: NDArray) -> Float32:
    return np.asarray(values, np.float32)
