"""Where a thermal camera may have stood, from nothing but the subject's shape in its image.

The fused surface is cast from viewpoints round it; the edges of these silhouettes are compared with the edges of the
warm body in the image, at all shifts at once (correlation by FFT) and at a few scales and rolls. Both are small
pictures: a viewpoint need only be near enough for the outline's refinement. The score is Dice's coefficient of the two
edge pictures, 2 Σ g·h / (Σ g² + Σ h²): 1 where they agree, and low where either shows an edge that the other does not.
Where the mesh ends (the cut at the waist) its edge does not count: the body goes on there.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2

from ...geometry.outline import border_tree
from ...geometry.rays import RayScene, rays_from
from ...geometry.rigid import invert
from ...robust import evenly
from ...types import Bool, Camera, Float, Float32, SurfaceMesh

BODY_PX = 96  # width of the picture in which the body is told from the room
WIDTH_PX = 36  # of the small pictures, which show the part of it around the subject
MARGIN = 1.3  # of that part over the subject's extent
AZIMUTHS = 24
ELEVATIONS_DEG = (-25.0, -5.0, 15.0, 35.0)
DISTANCES_M = (0.55, 0.85, 1.3, 2.0, 3.1)  # cast here; between them perspective hardly changes
SCALES = (0.87, 1.0, 1.15)  # of the distance, by resizing the picture
ROLLS_DEG = (-12.0, 0.0, 12.0)
QUARTERS = (0, 1, 2, 3)  # upright, or turned by so many right angles
PROBES = 6  # views that decide how the camera was held
CANDIDATES = 8  # kept for a view
APART_DEG = 20.0  # viewpoints nearer than this are one candidate
BORDER_M = 0.005  # and a pixel: outline this near to an open border, and not edge-on, is where the mesh ends
CUT_COS = 0.7
EDGE_SIGMA_PX = 1.0  # blur of the small pictures


@dataclass(frozen=True, eq=False)
class Candidates:
    """Where each of N views may have been taken: T_world_thermal (N, K, 4, 4), score (N, K) in 0..1, best first."""

    T_world_thermal: Float
    score: Float


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The subject from one viewpoint, in the middle of a canvas twice the image's size.

    mask : (2h, 2w), 1 = subject. counts : (2h, 2w), 0 near the mesh's open borders. T_world_thermal : (4, 4).
    distance_m : of the subject's middle.
    """

    mask: Float32
    counts: Float32
    T_world_thermal: Float
    distance_m: float


def search(mesh: SurfaceMesh, lens: Camera, up: Float, body: NDArray) -> Candidates:
    """Candidates for N views.

    up : (3,) which way is up in the mesh's world. body : (N, h, w) from `body_picture`, 1 = subject.
    """
    small, off_px, enlarged = _around(body)
    focal = lens.focal_px * body.shape[2] / lens.width_px * enlarged
    pictures = _Pictures.of(small)
    silhouettes = cast_silhouettes(mesh, focal, up, small.shape[1:])
    some = pictures.rows(evenly(len(body), PROBES))
    heard = [np.median(_scan(some, silhouettes, ((90.0 * q, 1.0),))[0].max(axis=1)) for q in QUARTERS]
    quarter = QUARTERS[int(np.argmax(heard))]
    ways = tuple((roll + 90.0 * quarter, scale) for roll in ROLLS_DEG for scale in SCALES)
    return _best(silhouettes, ways, focal, off_px, *_scan(pictures, silhouettes, ways))


def body_picture(radiance: NDArray) -> Float32:
    """The warm body in an image (H, W) as a smaller picture (h, w), share 0 room to 1 body, by Otsu's threshold."""
    h, w = radiance.shape
    size = BODY_PX, max(2, round(h * BODY_PX / w))
    filled = np.where(np.isfinite(radiance), radiance, np.nanmin(radiance)).astype(np.float32)
    small = cv2.resize(cv2.GaussianBlur(filled, (0, 0), 0.3 * w / BODY_PX), size, interpolation=cv2.INTER_AREA)
    low, high = np.percentile(small, [1, 99.7])
    level = np.clip((small - low) / max(float(high - low), 1e-9), 0, 1)
    threshold, _ = cv2.threshold((255 * level).astype(np.uint8), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    room, skin = level[level <= threshold / 255], level[level > threshold / 255]
    if not (len(room) and len(skin)):
        return np.zeros(size[::-1], np.float32)
    a, b = float(np.median(room)), float(np.median(skin))
    return np.asarray(np.clip((level - a) / max(b - a, 1e-9) * 2 - 0.5, 0, 1), np.float32)


def _around(body: NDArray) -> tuple[Float32, Float, float]:
    """The subject's part of each picture, (N, h, w), their middles off the images', (N, 2) px, and the enlargement."""
    _, h, w = body.shape
    boxes = np.tile([0, 0, w - 1, h - 1], (len(body), 1))
    for box, picture in zip(boxes, body, strict=True):
        v, u = np.nonzero(picture > 0.5)
        if len(u):
            box[:] = u.min(), v.min(), u.max(), v.max()
    extent = ((boxes[:, 2:] - boxes[:, :2] + 1) / [w, h]).max(axis=1)
    share = float(np.clip(MARGIN * np.percentile(extent, 90), WIDTH_PX / w, 1))
    size = np.array([round(share * w), round(share * h)])
    low = np.clip(np.rint((boxes[:, :2] + boxes[:, 2:] + 1 - size) / 2), 0, np.array([w, h]) - size).astype(int)
    small = WIDTH_PX, max(2, round(WIDTH_PX * size[1] / size[0]))
    parts = [p[y : y + size[1], x : x + size[0]] for p, (x, y) in zip(body, low, strict=True)]
    enlarged = WIDTH_PX / size[0]
    off = (low + size / 2 - np.array([w, h]) / 2) * enlarged
    shrunk = np.stack([cv2.resize(p, small, interpolation=cv2.INTER_AREA) for p in parts])
    return np.asarray(shrunk, np.float32), off, float(enlarged)


def cast_silhouettes(mesh: SurfaceMesh, focal_px: float, up: Float, shape: tuple[int, ...]) -> list[Silhouette]:
    """The subject from viewpoints all round, seen by a camera upright that looks at its middle.

    focal_px : of the small picture. up : (3,) direction. shape : (h, w) of it, px; a canvas has twice that.
    """
    h, w = 2 * shape[0], 2 * shape[1]
    v, u = np.mgrid[0:h, 0:w]
    rays = np.stack([(u - (w - 1) / 2) / focal_px, (v - (h - 1) / 2) / focal_px, np.ones((h, w))], axis=-1)
    scene, border = RayScene.of(mesh), border_tree(mesh)
    low, high = np.percentile(mesh.vertices_m, [1, 99], axis=0)
    middle = (low + high) / 2
    out = []
    for T in _viewpoints(middle, up):
        eye, directions = T[:3, 3], (rays @ T[:3, :3].T).reshape(-1, 3)
        found = scene.hits(rays_from(eye, directions))
        hit = found.distance.reshape(h, w)
        mask = np.isfinite(hit)
        counts = np.ones((h, w), np.float32)
        rim = np.flatnonzero(mask & (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0))
        if border is not None and len(rim):
            d = directions[rim]
            facing = -(found.normal[rim] * d).sum(axis=1) > CUT_COS * np.linalg.norm(d, axis=1)
            reach_m = BORDER_M + float(np.median(hit.flat[rim])) / focal_px
            point = eye + hit.flat[rim][:, None] * d
            cut = np.zeros(h * w, np.uint8)
            cut[rim] = facing & np.isfinite(border.query(point, distance_upper_bound=reach_m)[0])
            counts[cv2.dilate(cut.reshape(h, w), np.ones((3, 3), np.uint8)) > 0] = 0
        if mask.any() and not mask.all():
            out.append(Silhouette(mask.astype(np.float32), counts, T, float(np.linalg.norm(T[:3, 3] - middle))))
    return out


def _viewpoints(middle: Float, up: Float) -> list[Float]:
    """T_world_thermal of upright cameras that look at the middle."""
    up = up / np.linalg.norm(up)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    ahead, out = np.cross(up, side), []
    for distance in DISTANCES_M:
        for elevation in np.radians(ELEVATIONS_DEG):
            for a in 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS:
                off = np.cos(elevation) * (np.cos(a) * side + np.sin(a) * ahead) + np.sin(elevation) * up
                x = np.cross(-off, up)
                x /= np.linalg.norm(x)
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = np.stack([x, np.cross(-off, x), -off], axis=1), middle + distance * off
                out.append(T)
    return out


@dataclass(frozen=True, eq=False)
class _Pictures:
    """Spectra of N pictures' edges, on the canvas. energy : (N,) sum of their squares. inside : of the image's area."""

    u: NDArray[np.complex64]
    v: NDArray[np.complex64]
    inside: NDArray[np.complex64]
    energy: Float32
    shape: tuple[int, int]

    @classmethod
    def of(cls, body: NDArray) -> _Pictures:
        _, h, w = body.shape
        canvas = (2 * h, 2 * w)
        within = np.zeros(canvas, np.float32)
        within[1 : h - 1, 1 : w - 1] = 1
        edges = [_edges(b) for b in body]
        gu, gv = (np.stack([e[k] for e in edges]) * within[:h, :w] for k in (0, 1))
        energy = (gu**2 + gv**2).sum(axis=(1, 2))
        return cls(rfft2(gu, s=canvas), rfft2(gv, s=canvas), rfft2(within), energy, (h, w))

    def rows(self, rows: NDArray[np.intp]) -> _Pictures:
        return _Pictures(self.u[rows], self.v[rows], self.inside, self.energy[rows], self.shape)


def _edges(mask: NDArray) -> tuple[Float32, Float32]:
    """Gradient (along u, along v) of a blurred picture."""
    soft = cv2.GaussianBlur(np.asarray(mask, np.float32), (0, 0), EDGE_SIGMA_PX, borderType=cv2.BORDER_REPLICATE)
    gv, gu = np.gradient(soft)
    return np.asarray(gu, np.float32), np.asarray(gv, np.float32)


def _scan(
    pictures: _Pictures, silhouettes: list[Silhouette], ways: tuple[tuple[float, float], ...]
) -> tuple[Float32, NDArray[np.intp]]:
    """For every picture and viewpoint the best score (N, C), and which way and shift it has (N, C, 2).

    ways : roll, degrees, and scale of the distance.
    """
    n, (h, w) = len(pictures.energy), pictures.shape
    score = np.full((n, len(silhouettes)), -1.0, np.float32)
    how = np.zeros((n, len(silhouettes), 2), np.intp)
    forbidden = ~_allowed_shifts(h, w)
    for c, silhouette in enumerate(silhouettes):
        for k, (roll_deg, scale) in enumerate(ways):
            dice = _dice(pictures, silhouette, roll_deg, scale)
            dice[:, forbidden] = -1
            at = dice.reshape(n, -1).argmax(axis=1)
            value = dice.reshape(n, -1)[np.arange(n), at]
            better = value > score[:, c]
            score[better, c] = value[better]
            how[better, c] = np.stack([np.full(n, k), at], axis=1)[better]
    return score, how


def _allowed_shifts(h: int, w: int) -> Bool:
    """Which shifts keep the subject's middle near the image."""
    v, u = np.mgrid[0 : 2 * h, 0 : 2 * w]
    off = np.stack([_centred(uu, vv, h, w) for uu, vv in zip(u.ravel(), v.ravel(), strict=True)])
    return np.asarray((np.abs(off) < [0.6 * w, 0.75 * h]).all(axis=1).reshape(2 * h, 2 * w))


def _centred(du: int, dv: int, h: int, w: int) -> Float:
    """Where a circular shift of the canvas puts its middle, (2,) px from the image's middle."""
    u, v = (w - 0.5 - du) % (2 * w), (h - 0.5 - dv) % (2 * h)  # the canvas's middle, in the image's pixels
    u, v = u if u < 1.5 * w else u - 2 * w, v if v < 1.5 * h else v - 2 * h
    return np.array([u - (w - 1) / 2, v - (h - 1) / 2])


def _dice(pictures: _Pictures, s: Silhouette, roll_deg: float, scale: float) -> Float32:
    """(N, 2h, 2w): how well the silhouette's edges fit those of each picture, at every shift."""
    h2, w2 = s.mask.shape
    M = cv2.getRotationMatrix2D(((w2 - 1) / 2, (h2 - 1) / 2), -roll_deg, 1 / scale)
    turned = cv2.warpAffine(s.mask, M, (w2, h2), borderMode=cv2.BORDER_REPLICATE)
    counts = cv2.warpAffine(s.counts, M, (w2, h2), borderMode=cv2.BORDER_REPLICATE)
    gu, gv = _edges(turned)
    gu, gv = gu * counts, gv * counts
    U, V, G = rfft2(gu), rfft2(gv), rfft2(gu**2 + gv**2)
    # correlation: Σ_x picture(x) · silhouette(x + shift)
    fit = irfft2(np.conj(pictures.u) * U + np.conj(pictures.v) * V, s=(h2, w2))
    seen = irfft2(np.conj(pictures.inside) * G, s=(h2, w2))
    return np.asarray(2 * fit / (np.maximum(seen, 0) + pictures.energy[:, None, None] + 1e-6), np.float32)


def _posed(s: Silhouette, scale: float, roll_deg: float, direction: Float) -> Float:
    """The pose whose image has the subject's middle in a direction (2,), rolled, from `scale` times the distance."""
    T = s.T_world_thermal.copy()
    T[:3, 3] -= (scale - 1) * s.distance_m * T[:3, 2]
    a, z = np.radians(roll_deg), np.array([direction[0], direction[1], 1.0])
    roll, turn = np.eye(4), np.eye(4)
    roll[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    turn[:3, :3] = _turn_to(z / np.linalg.norm(z))
    return T @ invert(turn @ roll)


def _turn_to(direction: Float) -> Float:
    """The smallest rotation (3, 3) that takes the optical axis to a unit direction."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1 + direction[2]))


def _best(
    silhouettes: list[Silhouette],
    ways: tuple[tuple[float, float], ...],
    focal_px: float,
    off_px: Float,
    score: Float32,
    how: NDArray[np.intp],
) -> Candidates:
    """The best viewpoints of each view that lie apart."""
    h, w = (side // 2 for side in silhouettes[0].mask.shape)
    rows, kept, left = np.arange(len(score)), [], score.copy()
    forward = np.stack([s.T_world_thermal[:3, 2] for s in silhouettes])
    for _ in range(CANDIDATES):
        kept.append(left.argmax(axis=1))
        left[forward[kept[-1]] @ forward.T > np.cos(np.radians(APART_DEG))] = -1
    pick = np.stack(kept, axis=1)
    poses = np.empty((*pick.shape, 4, 4))
    for n, k in np.ndindex(pick.shape):
        way, at = how[n, pick[n, k]]
        (roll_deg, scale), (dv, du) = ways[way], divmod(int(at), 2 * w)
        poses[n, k] = _posed(silhouettes[pick[n, k]], scale, roll_deg, (_centred(du, dv, h, w) + off_px[n]) / focal_px)
    return Candidates(poses, np.asarray(score[rows[:, None], pick], np.float64))
