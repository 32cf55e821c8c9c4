"""Bundle adjustment of colour, thermal and depth together: one least-squares problem with a sparse Jacobian.

The hub is the first camera that sees boards (colour, else thermal); every other frame hangs on it:
p_c = T_c_hub p_hub, p_hub = s T_hub_board p_board, with board poses in units of the nominal spacing and one scale
s = exp(`spacing`): pictures of one camera do not know s, a depth camera does. Point cameras give pixel residuals (paper
Eqs. 2-8); a depth camera gives, for each sample on the board, corrected depth minus the depth of the board's plane
along the pixel's ray.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from ...types import Float
from ..board.views import BoardPoints, CalibrationSet
from .cameras import (
    DISTORTION,
    FOCAL,
    INTRINSIC_NAMES,
    PINHOLE,
    SHIFT,
    TURN,
    LensPrior,
    left_jacobians,
    project_with_jacobian,
    rotations,
    skew,
)
from .depth_model import DepthModel

# Parts of a row of a point's Jacobian: after the lens the board's pose, after `spacing` the extrinsic.
POSE_COLUMNS, EXTRINSIC_COLUMNS = slice(9, 15), slice(16, 22)
DEPTH_ASPECT = 0.003  # one sigma of ln(fx/fy) of a depth camera that is seen through planes only


@dataclass(frozen=True)
class Options:
    """What is estimated and what is believed.

    fixed : blocks held as they start, by name (`color.k3`, `thermal`, `depth`, `spacing`, `depth_model`, ...).
    priors : (mean, sigma) by parameter name, on top of the lens priors.
    sigma : one sigma of a picked point by camera, px; of a depth sample, in units of its own sigma (`depth_plane`).
    """

    lens: LensPrior = field(default_factory=LensPrior)
    fixed: frozenset[str] = frozenset({"spacing"})
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sigma: Mapping[str, float] = field(default_factory=dict)
    robust: bool = True


@dataclass(frozen=True, eq=False)
class _PointBlock:
    """All points of one camera: where their parameters stand and what was seen."""

    camera: str
    board: Float  # (N, 3) at spacing 1 of the start
    px: Float
    view: np.ndarray  # (N,) number of the view
    lens: slice
    pose: np.ndarray  # (N, 6) columns of the board pose
    extrinsic: np.ndarray | None  # (N, 6) columns of T_c_hub, None for the hub


@dataclass(frozen=True, eq=False)
class _DepthBlock:
    u: Float
    v: Float
    value: Float
    sigma: Float
    view: np.ndarray
    lens: slice
    pose: np.ndarray
    extrinsic: np.ndarray
    theta: slice


class Problem:
    """The layout of the unknowns and the residuals of one calibration set.

    groups : number of the rig state of each view; each has its own `T_thermal_hub`, intrinsics are shared.
    """

    def __init__(
        self,
        data: CalibrationSet,
        *,
        groups: Mapping[str, int] | None = None,
        depth_model: DepthModel | None = None,
        depth_size: tuple[int, int] | None = None,
    ) -> None:
        self.data, self.depth_model = data, depth_model
        self.cameras = data.cameras
        self.hub = self.cameras[0]
        self.views = [v for v in data.views if any(len(p) >= 4 for p in v.points.values())]
        self.group = np.array([0 if groups is None else groups[v.name] for v in self.views])
        self.sizes = dict(data.image_size)
        if depth_size is not None:
            self.sizes["depth"] = depth_size
        self.names: list[str] = []
        self.slices: dict[str, slice] = {}
        for c in self.cameras:
            self._add(c, [f"{c}.{n}" for n in INTRINSIC_NAMES])
        if depth_model is not None:
            if "depth" not in self.slices:
                self._add("depth", [f"depth.{n}" for n in INTRINSIC_NAMES])
            self._add("depth_model", [f"depth_model.{n}" for n in depth_model.names])
        rt = ("rx", "ry", "rz", "tx", "ty", "tz")
        for key in self.extrinsic_keys():
            self._add(key, [f"{key}.{n}" for n in rt])
        self._add("spacing", ["spacing"])
        for view in self.views:
            self._add(f"view:{view.name}", [f"view:{view.name}.{n}" for n in rt])
        self.points = [
            self._point_block(c, {v.name: v.points[c] for v in self.views if c in v.points}) for c in self.cameras
        ]
        marks = {v.name: v.depth_marks for v in self.views if v.depth_marks is not None}
        if marks and depth_model is not None and "depth" not in self.cameras:
            self.points.append(self._point_block("depth", marks))
        self.depth = self._depth_block() if depth_model is not None else None

    # ------------------------------------------------------------ layout

    def _add(self, key: str, names: list[str]) -> None:
        self.slices[key] = slice(len(self.names), len(self.names) + len(names))
        self.names += names

    def extrinsic_key(self, camera: str, group: int) -> str:
        """Name of the block T_camera_hub; the thermal camera has one in each group."""
        return f"T_{camera}_{self.hub}" + (f"[{group}]" if camera == "thermal" else "")

    def extrinsic_keys(self) -> list[str]:
        """Names of all blocks T_camera_hub, in the order of the unknowns."""
        others = [c for c in self.cameras if c != self.hub]
        if self.depth_model is not None and "depth" not in others:
            others.append("depth")
        groups = sorted(set(self.group.tolist()))
        return [self.extrinsic_key(c, g) for c in others for g in (groups if c == "thermal" else [0])]

    def _columns(self, key: str) -> np.ndarray:
        s = self.slices[key]
        return np.arange(s.start, s.stop)

    def _board_poses(self, x: Float) -> Float:
        """(V, 6) of `to_rt` of all views, in units of the nominal spacing."""
        return x[self.slices[f"view:{self.views[0].name}"].start :].reshape(len(self.views), 6)

    def _point_block(self, camera: str, points: Mapping[str, BoardPoints]) -> _PointBlock:
        board = self.data.board.points_m
        seen = [(i, points[v.name]) for i, v in enumerate(self.views) if v.name in points]
        number = np.concatenate([np.full(len(p), i) for i, p in seen])
        poses = np.array([self._columns(f"view:{v.name}") for v in self.views])
        extrinsic = None
        if camera != self.hub:
            extrinsic = np.array([self._columns(self.extrinsic_key(camera, g)) for g in self.group])[number]
        return _PointBlock(
            camera,
            board[np.concatenate([p.index for _, p in seen])],
            np.concatenate([p.px for _, p in seen]),
            number,
            self.slices[camera],
            poses[number],
            extrinsic,
        )

    def _depth_block(self) -> _DepthBlock | None:
        seen = [(i, v.depth) for i, v in enumerate(self.views) if v.depth is not None and len(v.depth)]
        if not seen:
            return None
        number = np.concatenate([np.full(len(d), i) for i, d in seen])
        poses = np.array([self._columns(f"view:{v.name}") for v in self.views])
        u, v, value, sigma = (
            np.concatenate([getattr(d, k) for _, d in seen]) for k in ("u_px", "v_px", "value", "sigma")
        )
        extrinsic = np.tile(self._columns(self.extrinsic_key("depth", 0)), (len(u), 1))
        return _DepthBlock(
            u, v, value, sigma, number, self.slices["depth"], poses[number], extrinsic, self.slices["depth_model"]
        )

    # ------------------------------------------------------------ residuals

    def row_views(self) -> np.ndarray:
        """(D,) number of the view of each data residual, as `linearise` orders them."""
        parts = [np.repeat(block.view, 2) for block in self.points]
        return np.concatenate(parts if self.depth is None else [*parts, self.depth.view])

    def point_residuals(self, block: _PointBlock, x: Float) -> tuple[Float, Float, np.ndarray]:
        """(N, 2) projected minus seen [px] at parameters x (P,); the Jacobian's values (N, 2, 16 or 22) and columns."""
        scale, pose = np.exp(x[self.slices["spacing"]][0]), self._board_poses(x)
        X = block.board
        Rv, Jv = rotations(pose[:, TURN]), left_jacobians(pose[:, TURN])
        RX = np.einsum("nij,nj->ni", Rv[block.view], X)
        p = scale * (RX + pose[block.view, SHIFT])
        if block.extrinsic is None:
            q, Rc = p, None
        else:
            keys, which = np.unique(block.extrinsic[:, 0], return_inverse=True)
            rt = np.stack([x[k : k + 6] for k in keys])
            Re, Je = rotations(rt[:, TURN]), left_jacobians(rt[:, TURN])
            Rc = Re[which]
            Rp = np.einsum("nij,nj->ni", Rc, p)
            q = Rp + rt[which, SHIFT]
        uv, J, D = project_with_jacobian(q, x[block.lens])
        Jp = J if Rc is None else J @ Rc
        parts = [D, -scale * Jp @ skew(RX) @ Jv[block.view], scale * Jp, np.einsum("nij,nj->ni", Jp, p)[..., None]]
        n = len(X)
        columns = [
            np.broadcast_to(np.arange(block.lens.start, block.lens.stop), (n, len(INTRINSIC_NAMES))),
            block.pose,
            np.full((n, 1), self.slices["spacing"].start),
        ]
        if block.extrinsic is not None:
            parts += [-J @ skew(Rp) @ Je[which], J]
            columns.append(block.extrinsic)
        return uv - block.px, np.concatenate(parts, axis=2), np.concatenate(columns, axis=1)

    def depth_residuals(self, block: _DepthBlock, x: Float) -> tuple[Float, Float, np.ndarray]:
        """(N,) corrected depth minus the plane's, in sigmas, at parameters x (P,); Jacobian values and columns."""
        assert self.depth_model is not None
        z, dz = self._plane_depth(block, x)
        e, J_theta, e_z = self.depth_model.residual(x[block.theta], block.value, block.u, block.v, z)
        J = np.concatenate([e_z[:, None] * dz, J_theta], axis=1) / block.sigma[:, None]
        k = len(z)
        lens = np.arange(block.lens.start, block.lens.stop)[PINHOLE]
        columns = np.concatenate(
            [
                np.broadcast_to(lens, (k, len(lens))),
                block.extrinsic,
                block.pose,
                np.full((k, 1), self.slices["spacing"].start),
                np.broadcast_to(np.arange(block.theta.start, block.theta.stop), (k, J_theta.shape[1])),
            ],
            axis=1,
        )
        return e / block.sigma, J, columns

    def _plane_depth(self, block: _DepthBlock, x: Float) -> tuple[Float, Float]:
        """(N,) m along z of the board's plane on each sample's ray, and its derivatives (N, 17) by fx, fy, cx, cy, the
        extrinsic, the board's pose and `spacing`."""
        fx, fy, cx, cy = x[block.lens][PINHOLE]
        r = np.stack([(block.u - cx) / fx, (block.v - cy) / fy, np.ones(len(block.u))], axis=1)
        rt_d = x[block.extrinsic[0]]
        Rd, Jd = rotations(rt_d[None, TURN])[0], left_jacobians(rt_d[None, TURN])[0]
        pose = self._board_poses(x)
        n_h, Jv = rotations(pose[:, TURN])[:, :, 2], left_jacobians(pose[:, TURN])
        scale = np.exp(x[self.slices["spacing"]][0])
        # normal and (before translation) origin of the board, depth axes
        n_d, q_d = n_h @ Rd.T, scale * pose[:, SHIFT] @ Rd.T
        n, q, i = n_d[block.view], q_d[block.view], block.view
        p0 = q + rt_d[SHIFT]
        den = np.einsum("ni,ni->n", n, r)
        z = np.einsum("ni,ni->n", n, p0) / den
        m = p0 - z[:, None] * r
        dz_dwd = (np.cross(n, m) + np.cross(q, n)) @ Jd
        dz_dwv = np.einsum("ni,nij->nj", np.cross(n_h[i], m @ Rd), Jv[i])
        dz_dlens = np.zeros((len(z), 4))
        dz_dlens[:, 0], dz_dlens[:, 1] = z * n[:, 0] * r[:, 0] / fx, z * n[:, 1] * r[:, 1] / fy
        dz_dlens[:, 2], dz_dlens[:, 3] = z * n[:, 0] / fx, z * n[:, 1] / fy
        dz_ds = np.einsum("ni,ni->n", n, q)[:, None]
        return z, np.concatenate([dz_dlens, dz_dwd, n, dz_dwv, scale * n @ Rd, dz_ds], axis=1) / den[:, None]

    def priors(self, options: Options) -> tuple[np.ndarray, Float, Float]:
        """Columns (K,), means and sigmas, in the parameters' units, of all beliefs that are linear in one parameter."""
        found: dict[str, tuple[float, float]] = {}
        lens = options.lens
        for c in {*self.cameras, *(["depth"] if self.depth_model is not None else [])}:
            w, h = self.sizes[c]
            sigma_c = lens.center_fraction * w
            found |= {f"{c}.cx": ((w - 1) / 2, sigma_c), f"{c}.cy": ((h - 1) / 2, sigma_c)}
            found |= {f"{c}.k1": (0, lens.radial), f"{c}.k2": (0, lens.radial), f"{c}.k3": (0, lens.radial3)}
            found |= {f"{c}.p1": (0, lens.tangential), f"{c}.p2": (0, lens.tangential)}
        if self.depth_model is not None:
            rows = zip(self.depth_model.names, self.depth_model.start(), self.depth_model.prior_sigma(), strict=True)
            found |= {f"depth_model.{n}": (m, s) for n, m, s in rows}
        found |= dict(options.priors)
        position = {n: i for i, n in enumerate(self.names)}
        known = [(position[n], *found[n]) for n in sorted(found) if n in position]
        a = np.array(known, dtype=float).reshape(-1, 3)
        return a[:, 0].astype(int), a[:, 1], a[:, 2]

    def free(self, options: Options) -> np.ndarray:
        """(P,) True for parameters that are estimated."""

        def held(name: str) -> bool:
            return name in options.fixed or name.rsplit(".", 1)[0] in options.fixed

        free = np.array([not held(n) for n in self.names])
        if self.depth_model is not None and "depth" not in self.cameras:
            # planes alone say next to nothing on the depth lens's distortion: the spatial field takes it up
            free[self._columns("depth")[DISTORTION]] = False
        return free

    def weights(self, x: Float, options: Options, sigmas: float) -> Float:
        """(M,) Huber weights of all data residuals at parameters x (P,): 1 within `sigmas`, then falling as 1/distance;
        by point, not by coordinate."""
        parts = []
        for block in self.points:
            r = np.linalg.norm(self.point_residuals(block, x)[0], axis=1) / options.sigma.get(block.camera, 0.5)
            parts.append(np.repeat(np.minimum(1.0, sigmas / np.maximum(r, 1e-9)), 2))
        if self.depth is not None:
            r = np.abs(self.depth_residuals(self.depth, x)[0]) / options.sigma.get("depth_plane", 1.0)
            parts.append(np.minimum(1.0, sigmas / np.maximum(r, 1e-9)))
        return np.concatenate(parts)

    def linearise(self, x: Float, options: Options, weight: Float | None = None) -> tuple[Float, sp.csr_matrix]:
        """Whitened residuals (M,) of data and priors at parameters x (P,), and their Jacobian (M, P); data's rows times
        the root of `weight` (D,)."""
        residuals, values, columns, rows, start = [], [], [], [], 0

        def put(e: Float, J: Float, c: np.ndarray) -> None:
            nonlocal start
            m = len(e)
            residuals.append(e)
            values.append(J.ravel())
            columns.append(c.ravel())
            rows.append(np.repeat(np.arange(start, start + m), J.shape[1]))
            start += m

        for block in self.points:
            e, J, c = self.point_residuals(block, x)
            s = options.sigma.get(block.camera, 0.5)
            put(e.ravel() / s, J.reshape(-1, J.shape[2]) / s, np.repeat(c, 2, axis=0))
        if self.depth is not None:
            e, J, c = self.depth_residuals(self.depth, x)
            s = options.sigma.get("depth_plane", 1.0)
            put(e / s, J / s, c)
        column, mean, sigma = self.priors(options)
        put((x[column] - mean) / sigma, 1 / sigma[:, None], column[:, None])
        for lens in sorted({*self.cameras, "depth"} & self.slices.keys()):  # fx and fy of one lens are nearly equal
            focal = self._columns(lens)[FOCAL]
            fx, fy = x[focal]
            s = options.lens.aspect if lens in self.cameras else DEPTH_ASPECT
            put(np.array([np.log(fx / fy) / s]), np.array([[1 / fx, -1 / fy]]) / s, focal[None])
        shape = (start, len(self.names))
        J_all = sp.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape)
        e_all = np.concatenate(residuals)
        if weight is None:
            return e_all, J_all
        root = np.concatenate([np.sqrt(weight), np.ones(start - len(weight))])
        return e_all * root, sp.diags_array(root).tocsr() @ J_all
