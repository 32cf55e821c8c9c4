"""One thermal view on a surface: what each vertex looks like and at which angle, correction, back-projection."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..export.axes import axes_of
from ..geometry.camera import pixel_rays
from ..geometry.rays import RayScene, rays_from
from ..physics.band import ZERO_DEGC_K, Band
from ..physics.emissivity import EmissivityModel
from ..types import Camera, Float, Float32, Int, Scan, SurfaceMesh
from .models import by_radiance_degC, eq25_degC, eqs25_27_degC

if TYPE_CHECKING:
    from ..pipeline import Result

HEAD_M = 0.25  # what is drawn, from the highest vertex down


@dataclass(frozen=True, eq=False)
class View:
    """What one thermal view saw, per vertex of the surface (V,), NaN where it saw nothing.

    apparent_degC, radiance : as the camera reports it. cos_ray : of the angle between normal and the pixel's own ray.
    cos_axis : |n·z| with the camera's axis, the paper's Eq. 28. u_px, v_px : where. axes : (3, 3) right, up, front.
    """

    surface: SurfaceMesh
    camera: Camera
    band: Band
    room_degC: float
    T_world_thermal: Float
    axes: Float
    apparent_degC: Float
    radiance: Float
    cos_ray: Float
    cos_axis: Float
    u_px: Float
    v_px: Float

    def angle_deg(self, *, axis: bool = False) -> Float:
        """(V,) viewing angle, degrees, by the pixel's ray, or by the camera's axis as the paper has it."""
        return np.degrees(np.arccos(np.clip(self.cos_axis if axis else self.cos_ray, 0, 1)))

    def linear_degC(self, model: EmissivityModel, *, axis: bool = False) -> Float:
        """Eq. 25 alone, (V,)."""
        return eq25_degC(self.apparent_degC, self.cos_axis if axis else self.cos_ray, model, self.room_degC)

    def paper_degC(self, model: EmissivityModel) -> Float:
        """Eqs. 25-27, (V,): S from the vertices that face the camera."""
        return eqs25_27_degC(self.apparent_degC, self.cos_ray, model, self.room_degC)

    def radiance_degC(self, model: EmissivityModel) -> Float:
        """The radiance method, normal-equivalent, (V,)."""
        L_room = float(self.band.radiance(self.room_degC + ZERO_DEGC_K))
        return by_radiance_degC(self.radiance, self.cos_ray, model, L_room, self.band)

    def head(self) -> SurfaceMesh:
        """The surface's uppermost 25 cm."""
        up = self.surface.vertices_m @ self.axes[1].astype(np.float32)
        keep = up > up[self.surface.triangles.ravel()].max() - HEAD_M
        return replace(self.surface, triangles=self.surface.triangles[keep[self.surface.triangles].all(axis=1)])


def on_vertices(count: int, vertex: Int, values: NDArray) -> Float:
    """(V,) of values (N,), any unit, at vertex (N,) of `count`; NaN elsewhere, the last one where several are given."""
    out = np.full(count, np.nan)
    out[vertex] = values
    return out


def first_view(result: Result, scan: Scan, room_degC: float) -> View:
    """The first of a result's thermal views."""
    assert result.mapped is not None
    assert scan.thermal is not None
    seen, surface = result.mapped, result.mesh_in_world.surface
    rows = seen.observations.select(seen.observations.view == 0)
    T, camera = seen.views.T_world_thermal[0], scan.thermal.camera
    band = Band(*camera.band_um)
    cos_axis = np.abs(surface.normals[rows.vertex].astype(np.float64) @ T[:3, 2])
    columns = (rows.radiance, rows.cos_angle, cos_axis, rows.u_px, rows.v_px)
    radiance, *others = (on_vertices(len(surface), rows.vertex, x) for x in columns)
    apparent_degC = band.temperature_K(radiance) - ZERO_DEGC_K
    axes = axes_of(result.mesh_in_world.metadata)
    return View(surface, camera.lens, band, room_degC, T, axes, apparent_degC, radiance, *others)


@dataclass(frozen=True, eq=False)
class BackProjection:
    """Where each pixel's ray meets the surface: hit (M,) of the flattened image, corners (M, 3), weights (M, 3)."""

    shape: tuple[int, int]
    hit: NDArray[np.intp]
    corners: NDArray[np.int32]
    weights: Float32

    @classmethod
    def of(cls, view: View) -> BackProjection:
        """Cast every pixel of the thermal camera."""
        directions = pixel_rays(view.camera).reshape(-1, 3) @ view.T_world_thermal[:3, :3].T
        scene = RayScene(view.surface.vertices_m, view.surface.triangles)
        found = scene.hits(rays_from(view.T_world_thermal[:3, 3], directions))
        hit = np.flatnonzero(found.triangle >= 0)
        return cls(view.camera.shape, hit, view.surface.triangles[found.triangle[hit]], found.weights[hit])

    def image(self, values: NDArray) -> Float:
        """(H, W) px of per-vertex values (V,), NaN where the surface is not, or has none."""
        out = np.full(self.shape[0] * self.shape[1], np.nan)
        out[self.hit] = (np.asarray(values, np.float64)[self.corners] * self.weights).sum(1)
        return out.reshape(self.shape)
