"""Thermal views onto the surface: which vertex was seen by which pixel, how, and with what signal.

The paper's steps 2 and 3 (3D-2D transformation and interpolation, Eqs. 9-12), for many views of one fused surface. A
vertex is observed by a view when it projects into the image, faces the camera, nothing of the surface lies between, and
its pixel is clear of silhouettes: there the point spread mixes skin with room (766 mK at 1 px, 0.1 mK at 3 px).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..geometry.camera import project, viewing_cosine
from ..geometry.mesh import undirected_edges
from ..geometry.rays import RayScene
from ..geometry.rigid import invert, transform_points
from ..motion.body import BodyMotion, moved_by, parted
from ..physics.signal import SignalConverter
from ..progress import Progress, silent
from ..recipe import InputSection, MappingSection
from ..rig.align import RigResult
from ..rig.rows import ReadOut
from ..types import (
    Bool,
    Camera,
    Float,
    Float32,
    Int,
    LensScatter,
    Observations,
    Scan,
    SurfaceMesh,
    ThermalStream,
    ThermalViews,
    Trajectory,
    brief,
)
from .background import Background, find_background
from .corrections import MotionResult, view_corrections
from .pixels import bad_pixels
from .references import BlackbodyReading, read_blackbodies
from .scatter import check_scatter, estimate_scatter, spread_on
from .span import placed
from .views import thermal_views
from .witness import Depths, DepthWitness

EDGE_CAP_PX = 32.0  # distances to a silhouette are stored up to here; nothing depends on larger ones
NORMAL_OFFSET_M = 0.003  # a ray to the eye starts this far off the surface, so that noise does not shadow itself


class SurfaceRays:
    """A mesh prepared for asking what a camera sees of it: ray casting, contours, visibility."""

    def __init__(self, mesh: SurfaceMesh, motion: BodyMotion | None = None) -> None:
        """motion : of the subject, for `at`."""
        self.mesh, self._motion = mesh, motion
        self._moved: Float32 | None = None
        self._scene = RayScene.of(mesh)
        self._lifted = mesh.vertices_m + np.float32(NORMAL_OFFSET_M) * mesh.normals
        edges, self._on_boundary = undirected_edges(mesh.triangles)
        self._edge_a, self._edge_b = np.ascontiguousarray(edges[:, 0]), np.ascontiguousarray(edges[:, 1])

    def at(self, time_s: float) -> SurfaceRays:
        """The same as the subject stands at a time, s on the depth clock."""
        if self._motion is None:
            return self
        posed = copy(self)
        posed._moved = self._motion.affine_at(time_s)
        posed.mesh = moved_by(self.mesh, posed._moved)
        return posed

    def visible(self, vertices: NDArray, eye_m: NDArray, tolerance_m: float) -> Bool:
        """Whether nothing lies between each of the vertices (indices) and the eye, (N,).

        The first `tolerance_m` of the way do not count: a noisy surface shadows itself at grazing angles. Of a subject
        that moved, rays run in the surface at rest, from each vertex to where the eye is for it: what stands in the way
        is taken to move with it, which is true to a few millimetres near to the vertex, where it matters.
        """
        rays = np.empty((len(vertices), 6), np.float32)
        start, ray = rays[:, :3], rays[:, 3:]
        np.take(self._lifted, vertices, axis=0, out=start, mode="clip")
        eye = eye_m.astype(np.float32)
        if self._moved is None:
            np.subtract(eye, start, out=ray)
        else:
            M = self._moved.take(vertices, axis=0, mode="clip")
            np.subtract(np.einsum("vji,vj->vi", M[:, :, :3], eye - M[:, :, 3]), start, out=ray)
        nearest = np.sqrt(np.einsum("ij,ij->i", ray, ray).min(initial=np.inf))
        near = tolerance_m / max(float(nearest), tolerance_m)
        return ~self._scene.occluded(rays, near, 1.0)

    def contour_points(self, eye_m: NDArray, facing: NDArray, tolerance_m: float) -> Float32:
        """Points (N, 3) along the visible occluding contours and open borders, as seen from the eye.

        facing : (V,) sign of n·(eye - v). A contour runs through edges whose ends face to opposite sides.
        """
        front = facing > 0
        front_a, front_b = front.take(self._edge_a), front.take(self._edge_b)
        crossing = np.flatnonzero((front_a != front_b) | (self._on_boundary & front_a))
        a, b = self._edge_a[crossing], self._edge_b[crossing]
        nearer, edge_of = np.unique(np.where(front_a[crossing], a, b), return_inverse=True)
        seen = self.visible(nearer, eye_m, tolerance_m)[edge_of]
        p, q = self.mesh.vertices_m[a[seen]], self.mesh.vertices_m[b[seen]]
        return np.concatenate([p, (p + q) / 2, q])


@dataclass(frozen=True, eq=False)
class Mapped:
    """What the thermal views saw: observations of vertices, and readings of blackbodies.

    left_out : thermal frames that did not enter, by reason. motion : corrections of single views, if asked for.
    bad_pixels : (B, 2) u, v px of dead, stuck or blinking pixels, which were left out.
    outline_px : what the rig's alignment left between the outlines of model and image, NaN = not measured.
    jitter_s : one sigma of what single thermal frames' stamps lacked and was put right. depth_scale : depth over truth
    less 1, as outlines ask for it, 0 = no news.
    background : what the views show of the room; None in results of earlier versions. scatter : of the lens, taken off
    where its share is not 0; spread : (V,) what one whole share of it would do to each vertex, W m-2 sr-1.
    unsettled : (V,) vertices whose motion was not followed; (0,) for a subject that stood still.
    readout : the time that reading an image's rows takes, as outlines tell it; None = no news.
    """

    views: ThermalViews
    left_out: dict[str, int]
    observations: Observations
    blackbodies: tuple[BlackbodyReading, ...]
    motion: MotionResult | None = None
    bad_pixels: Int = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    outline_px: float = float("nan")
    jitter_s: float = 0.0
    depth_scale: float = 0.0
    background: Background | None = None
    unsettled: Bool = field(default_factory=lambda: np.zeros(0, bool))
    scatter: LensScatter | None = None
    spread: Float32 | None = None
    readout: ReadOut | None = None

    __repr__ = brief

    @property
    def scattered(self) -> Float32 | None:
        """(V,) what one sigma of the lens's scatter does to readings of each vertex, W m-2 sr-1; None: not known."""
        if self.scatter is None or self.spread is None:
            return None
        return np.asarray(self.spread * np.float32(self.scatter.sigma))


def observe(
    scan: Scan,
    surface: SurfaceMesh,
    path: Trajectory | BodyMotion,
    rig: RigResult,
    *,
    input: InputSection,
    mapping: MappingSection,
    progress: Progress = silent,
) -> Mapped:
    """Project all thermal views onto the surface, with the aligned rig and clock.

    path : of the depth camera; or with it how the subject moved: every view sees it as it stood at the view's own time.
    Raises ScanError if no thermal frame can be placed, or no view sees the surface.
    """
    trajectory, body = parted(path)
    if scan.thermal is None or len(scan.thermal) == 0:
        raise ScanError("the scan has no thermal frames", place=scan.root)
    stream, motion = scan.thermal, None
    if rig.free is not None:
        views, left_out = rig.free.views(stream), rig.free.left_out
        body = None  # their clock is another: the subject is seen at rest
    else:
        moved = None if rig.knocks is None else rig.knocks.of(np.arange(len(stream)))
        gap_s = input.max_pose_gap_ms / 1e3
        views, left_out = thermal_views(scan, trajectory, gap_s, rig.camera, rig.frame_dt_s, moved)
    if mapping.view_motion and rig.free is None:  # free views follow the outline one by one already
        motion = view_corrections(stream, surface, views, rig.outline_width_px, body, progress=progress)
        views = replace(views, T_world_thermal=motion.T_world_thermal)
    converter = SignalConverter(stream.camera)
    bad = bad_pixels(stream, views.frame, converter)
    if bad.any():
        converter = SignalConverter(stream.camera, bad)
    background = find_background(stream, surface, views, converter, scan.references)
    lens, stated = stream.camera.lens, stream.camera.scatter
    background = placed(background, views, surface.vertices_m.mean(axis=0, dtype=np.float64), lens, converter.band)
    if stated is None:
        scatter = estimate_scatter(background, lens, converter.band)
    else:
        scatter = check_scatter(background, lens, converter.band, stated)
    if scatter.share:
        converter, background = SignalConverter(stream.camera, bad, scatter), background.without(scatter)
    witness = None
    if rig.free is None:
        witness = DepthWitness(scan, trajectory, views, stream.camera.lens, mapping.visibility_tolerance_mm / 1e3)
    rays = SurfaceRays(surface, body)
    observations = observe_views(stream, rays, views, converter, mapping, witness=witness, progress=progress)
    blackbodies = read_blackbodies(stream, views, scan.references, converter)
    uv = np.argwhere(bad)[:, ::-1].astype(np.int32)
    spread = spread_on(stream, views, converter, observations, len(surface))
    left = rig.residual_px_after, rig.jitter_s, rig.depth_scale
    unsettled = np.zeros(0, bool) if body is None else body.unsettled
    seen = Mapped(views, left_out, observations, blackbodies, motion, uv, *left, background, unsettled, scatter, spread)
    return replace(seen, readout=rig.readout)


def observe_views(
    stream: ThermalStream,
    surface: SurfaceRays,
    views: ThermalViews,
    converter: SignalConverter,
    mapping: MappingSection,
    *,
    witness: DepthWitness | None = None,
    progress: Progress = silent,
) -> Observations:
    """All observations of the surface's vertices by the thermal views. Raises ScanError if no view sees the surface.

    witness : depth frames that tell what else stood in the way.
    """

    def one(view: int) -> Observations:
        frame = int(views.frame[view])
        image = converter.radiance(stream.load(frame), stream.places[frame])
        posed = surface.at(float(views.times_s[view]))
        depths = None if witness is None else witness.of(view)
        T = views.T_world_thermal[view]
        return observe_view(posed, stream.camera.lens, T, image, mapping, view=view, depths=depths)

    parts: list[Observations] = []
    with ThreadPoolExecutor(max_workers=3) as pool:
        for part in pool.map(one, range(len(views))):
            parts.append(part)
            progress("mapping", len(parts), len(views))
    columns = Observations.__dataclass_fields__
    if not sum(len(p) for p in parts):
        raise ScanError(
            "no thermal view sees the surface",
            hint="check T_thermal_depth and the thermal clock with `thermofusion check SCAN`",
        )
    return Observations(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in columns})


def observe_view(
    surface: SurfaceRays,
    camera: Camera,
    T_world_thermal: Float,
    radiance: Float32,
    mapping: MappingSection,
    *,
    view: int = 0,
    depths: Depths | None = None,
) -> Observations:
    """The observations of one thermal image, sorted by vertex.

    radiance : (H, W) float32. Columns as in `Observations`; footprint = range²/(f² cosθ) [m²]. depths : what the depth
    frame of the moment shows: rows that it hides are dropped, doubtful ones count as near to an outline.
    """
    mesh, eye_m = surface.mesh, T_world_thermal[:3, 3]
    cos = viewing_cosine(mesh.vertices_m, mesh.normals, eye_m)
    cos_limit = np.cos(np.radians(mapping.last_resort_angle_deg))
    candidates = np.flatnonzero(cos > cos_limit)

    points = transform_points(invert(T_world_thermal), mesh.vertices_m.take(candidates, axis=0))
    uv, _ = project(camera, points)
    inside = np.flatnonzero(_inside(uv, camera, mapping.border_px))
    candidates, points, uv = candidates.take(inside), points.take(inside, axis=0), uv.take(inside, axis=0)

    tolerance_m = mapping.visibility_tolerance_mm / 1000
    edge_px = _edge_distance(surface, camera, T_world_thermal, cos, tolerance_m)
    pixel = np.rint(uv).astype(np.intp)
    distance = edge_px.ravel().take(pixel[:, 1] * camera.width_px + pixel[:, 0])
    least_px = min(mapping.last_resort_silhouette_px, mapping.silhouette_px)
    clear = np.flatnonzero(distance >= least_px)
    candidates, points, uv = candidates.take(clear), points.take(clear, axis=0), uv.take(clear, axis=0)

    signal = sample_bilinear(radiance, uv)
    distance = distance.take(clear)
    hidden = np.zeros(len(candidates), bool)
    if depths is not None:
        hidden, doubtful = depths.judge(uv, points[:, 2], cos.take(candidates))
        distance[doubtful] = least_px
        if least_px == mapping.silhouette_px:  # there is no last resort
            hidden |= doubtful
    seen = np.flatnonzero(surface.visible(candidates, eye_m, tolerance_m) & np.isfinite(signal) & ~hidden)
    points, uv = points.take(seen, axis=0), uv.take(seen, axis=0)
    vertex, range_m = candidates.take(seen), np.sqrt(np.einsum("ij,ij->i", points, points))
    cos_angle = cos.take(vertex)
    return Observations(
        vertex=vertex.astype(np.int32),
        view=np.full(len(vertex), view, np.int32),
        radiance=signal.take(seen),
        cos_angle=cos_angle.astype(np.float32),
        range_m=range_m.astype(np.float32),
        footprint_m2=(range_m**2 / (camera.focal_px**2 * cos_angle)).astype(np.float32),
        u_px=uv[:, 0].astype(np.float32),
        v_px=uv[:, 1].astype(np.float32),
        edge_px=distance.take(seen),
    )


def clear_of_silhouettes(observations: Observations, n_vertices: int, silhouette_px: float) -> tuple[Bool, Bool]:
    """Which rows lie clear of outlines, and which count: the clear ones, and others where a vertex has no clear one.

    Returns ((N,) clear, (N,) counts).
    """
    clear = observations.edge_px >= np.float32(silhouette_px)
    served = np.zeros(n_vertices, bool)
    served[observations.vertex[clear]] = True
    return clear, clear | ~served[observations.vertex]


def sample_bilinear(image: NDArray, uv: NDArray) -> Float32:
    """Values of (H, W) at pixels (N, 2), NaN if one of the four neighbours is NaN or outside."""
    h, w = image.shape
    u, v = uv[:, 0], uv[:, 1]
    u0, v0 = np.clip(np.floor(u), 0, w - 2).astype(np.intp), np.clip(np.floor(v), 0, h - 2).astype(np.intp)
    fu, fv = (u - u0).astype(np.float32), (v - v0).astype(np.float32)
    flat, i = image.ravel(), v0 * w + u0
    top = flat[i] * (1 - fu) + flat[i + 1] * fu
    bottom = flat[i + w] * (1 - fu) + flat[i + w + 1] * fu
    value = (top * (1 - fv) + bottom * fv).astype(np.float32)
    value[~((u >= 0) & (v >= 0) & (u <= w - 1) & (v <= h - 1))] = np.nan
    return value


def _inside(uv: NDArray, camera: Camera, border_px: float) -> Bool:
    u, v = uv[:, 0], uv[:, 1]
    return (
        (u >= border_px)
        & (v >= border_px)
        & (u <= camera.width_px - 1 - border_px)
        & (v <= camera.height_px - 1 - border_px)
    )


def _edge_distance(
    surface: SurfaceRays, camera: Camera, T_world_thermal: Float, facing: NDArray, tolerance_m: float
) -> Float32:
    """Distance of every pixel (H, W) to the nearest visible silhouette or open border, in pixels, capped."""
    eye_m = T_world_thermal[:3, 3]
    contour = surface.contour_points(eye_m, facing, tolerance_m)
    uv, _ = project(camera, transform_points(invert(T_world_thermal), contour))
    uv = np.rint(uv[_inside(uv, camera, 0.0)]).astype(np.intp)
    free = np.full(camera.shape, 255, np.uint8)
    free[uv[:, 1], uv[:, 0]] = 0
    if not len(uv):
        return np.full(camera.shape, EDGE_CAP_PX, np.float32)
    return np.minimum(cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5), EDGE_CAP_PX)
