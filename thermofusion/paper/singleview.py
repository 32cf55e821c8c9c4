"""One thermal view on a surface: what each vertex looks like and at which angle, correction, back-projection."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from ..export.axes import axes_of
from ..geometry.camera import pixel_rays
from ..geometry.rays import RayScene, rays_from
from ..physics.band import ZERO_DEGC_K, Band
from ..physics.emissivity import EmissivityModel
from ..physics.equation import normal_equivalent, paper_chain
from ..physics.signal import SignalConverter
from ..types import Camera, Float, Float32, Scan, SignalCurve, SurfaceMesh

if TYPE_CHECKING:
    from ..pipeline import Result

FACING_DEG = 10.0  # of Eq. 26: where the surface faces the camera
HEAD_M = 0.25  # what is drawn, from the highest vertex down
BILATERAL = (13, 0.010, 3.5)  # window [px], depth [m], width [px] of the smoothing of a single depth frame


@dataclass(frozen=True, eq=False)
class View:
    """What one thermal view saw, per vertex of the surface (V,), NaN where it saw nothing.

    apparent_degC, radiance : as the camera reports it. cos_ray : of the angle between normal and the pixel's own ray.
    cos_axis : |n·z| with the camera's axis, the paper's Eq. 28. u_px, v_px : where. axes : (3, 3) right, up, front.
    """

    surface: SurfaceMesh
    camera: Camera
    T_world_thermal: Float
    band: Band
    room_degC: float
    apparent_degC: Float
    radiance: Float
    cos_ray: Float
    cos_axis: Float
    u_px: Float
    v_px: Float
    axes: Float

    @property
    def facing(self) -> NDArray[np.bool_]:
        """(V,) vertices that the camera sees straight on."""
        return self.cos_ray >= np.cos(np.radians(FACING_DEG))

    def angle_deg(self, *, axis: bool = False) -> Float:
        """(V,) viewing angle by the pixel's ray, or by the camera's axis as the paper has it."""
        return np.degrees(np.arccos(np.clip(self.cos_axis if axis else self.cos_ray, 0, 1)))

    def linear_degC(self, model: EmissivityModel, *, axis: bool = False) -> Float:
        """Eq. 25 alone, (V,)."""
        cos = self.cos_axis if axis else self.cos_ray
        return paper_chain(self.apparent_degC, _where_seen(model, cos), self.room_degC)[0]

    def paper_degC(self, model: EmissivityModel, *, axis: bool = False) -> Float:
        """Eqs. 25-27, (V,): S from the vertices that face the camera."""
        corrected = self.linear_degC(model, axis=axis)
        S = np.nanmedian(self.apparent_degC[self.facing]) / np.nanmedian(corrected[self.facing])
        return np.asarray(S * corrected)

    def radiance_degC(self, model: EmissivityModel) -> Float:
        """The radiance method, normal-equivalent, (V,)."""
        L_room = self.band.radiance(self.room_degC + ZERO_DEGC_K)
        E = _where_seen(model, self.cos_ray) / model.normal
        return self.band.temperature_K(normal_equivalent(self.radiance, E, L_room)) - ZERO_DEGC_K

    def head(self) -> SurfaceMesh:
        """The surface's uppermost 25 cm."""
        up = self.surface.vertices_m @ self.axes[1].astype(np.float32)
        keep = up > up[self.surface.triangles.ravel()].max() - HEAD_M
        return replace(self.surface, triangles=self.surface.triangles[keep[self.surface.triangles].all(axis=1)])


def _where_seen(model: EmissivityModel, cos: Float) -> Float:
    seen = np.isfinite(cos)
    out = np.full(cos.shape, np.nan)
    out[seen] = model(cos[seen])
    return out


def view_of(result: Result, scan: Scan, room_degC: float, index: int = 0) -> View:
    """One of a result's thermal views."""
    assert result.seen is not None
    assert scan.thermal is not None
    seen, surface = result.seen, result.mesh.surface
    rows = seen.observations.select(seen.observations.view == index)
    T = seen.views.T_world_thermal[index]
    band = Band(*scan.thermal.camera.band_um)

    def column(values: NDArray) -> Float:
        out = np.full(len(surface), np.nan)
        out[rows.vertex] = values
        return out

    radiance = column(rows.radiance)
    axis = np.abs(surface.normals[rows.vertex].astype(np.float64) @ T[:3, 2])
    return View(
        surface,
        scan.thermal.camera.lens,
        T,
        band,
        room_degC,
        band.temperature_K(radiance) - ZERO_DEGC_K,
        radiance,
        column(rows.cos_angle),
        column(axis),
        column(rows.u_px),
        column(rows.v_px),
        axes_of(result.mesh.metadata),
    )


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
        """(H, W) of per-vertex values (V,), NaN where the surface is not, or has none."""
        out = np.full(self.shape[0] * self.shape[1], np.nan)
        out[self.hit] = (np.asarray(values, np.float64)[self.corners] * self.weights).sum(1)
        return out.reshape(self.shape)


# ---------------------------------------------------------------- the laboratory's cameras


def smoothed(scan: Scan) -> Scan:
    """The scan with each depth frame smoothed twice by a bilateral filter.

    A single Kinect frame has steps of 3.5 mm at 1.1 m, which make normals worthless; the paper's ReconstructMe averaged
    many frames. Steps between surfaces (1 cm) stay.
    """

    def load(i: int) -> Float32:
        depth = scan.depth.load(i)
        measured = np.isfinite(depth)
        z = np.where(measured, depth, 0).astype(np.float32)
        for _ in range(2):
            z = np.where(measured, cv2.bilateralFilter(z, *BILATERAL), 0).astype(np.float32)
        return np.where(measured, z, np.float32(np.nan))

    return replace(scan, depth=replace(scan.depth, load=load))


def flat_field(scan: Scan, radiometry: Path, room_px: tuple[slice, slice], room_degC: float) -> tuple[Scan, float]:
    """The face's scan with the authors' per-pixel field added and the room's level set; and that level's shift, K.

    The field z1 + z2 T + z3 T² + z4 T³ (their calibration of 1 March) is *added*: subtracted, it makes the wall behind
    the person less even instead of more. The camera's own level drifts; the wall is at room temperature, so the
    picture is shifted until it reads that.
    """
    assert scan.thermal is not None
    z = [np.asarray(loadmat(radiometry / f"0301_z{i}.mat")[f"z{i}"], np.float64) for i in (1, 2, 3, 4)]
    converter = SignalConverter(scan.thermal.camera)
    T = converter.band.temperature_K(converter.radiance(scan.thermal.load(0)).astype(np.float64)) - ZERO_DEGC_K
    flat = T + z[0] + T * (z[1] + T * (z[2] + T * z[3]))
    shift = room_degC - float(np.nanmedian(flat[room_px]))
    image = (flat + shift).astype(np.float32)
    camera = replace(scan.thermal.camera, signal=SignalCurve())
    return replace(scan, thermal=replace(scan.thermal, load=lambda i: image, camera=camera)), shift
