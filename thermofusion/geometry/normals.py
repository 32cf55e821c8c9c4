"""Surface normals averaged over a window, by plane fits."""

from __future__ import annotations

import numpy as np

from ..types import Float32, Int
from .mesh import mesh_normals

PLANE_PER_WINDOW = 0.4  # radius of a plane fit, of the normal window: see window_normals
MAX_NEIGHBOURS = 100  # in a plane fit
PLANE_AGREES_COS = 0.8  # 37°: a plane fit farther from the mesh's own normal caught another part of the body


def window_normals(vertices: Float32, triangles: Int, window_m: float) -> Float32:
    """Unit outward normals (V, 3) of vertices (V, 3) m with triangles (F, 3), averaged over a window of the diameter.

    Normals of planes fitted to the vertices within 0.4 of the diameter: a window with a hard rim rounds off curves as
    much as a tapered one of 1.2 times its size. On torso-dev, window 25 mm, the mean error is 1.2°, against 1.5° of
    triangle normals spread over the mesh until as wide. A ball in space may catch a neighbouring finger, too: where the
    plane disagrees with the mesh's own normal, that one is kept.
    """
    from ._open3d import o3d

    own = mesh_normals(vertices, triangles)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(vertices)))
    cloud.estimate_normals(max_nn=MAX_NEIGHBOURS, radius=PLANE_PER_WINDOW * window_m)
    n: Float32 = cloud.point.normals.numpy()
    cos = np.einsum("ij,ij->i", n, own)
    return np.where((np.abs(cos) > PLANE_AGREES_COS)[:, None], n * np.sign(cos)[:, None], own)
