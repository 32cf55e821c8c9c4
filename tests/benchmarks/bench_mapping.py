"""Thermal mapping against Open3D's texture projection, on one mesh and the same views.

    python tests/benchmarks/bench_mapping.py RESULT SCAN [--open3d] [--views N]

RESULT is a finished result folder of SCAN. Prints ms a view for our projection; with --open3d also the time of
`compute_uvatlas` and `project_images_to_albedo` for the same mesh and views, and the ratio.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line sets it; before NumPy is loaded

import numpy as np

from thermofusion.geometry._open3d import o3d
from thermofusion.geometry.rigid import invert
from thermofusion.mapping.observe import SurfaceRays, observe_views
from thermofusion.physics.signal import SignalConverter
from thermofusion.recipe import MappingSection
from thermofusion.results.artifacts import load_artifact
from thermofusion.scans import open_scan
from thermofusion.types import ThermalViews

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("result", type=Path)
parser.add_argument("scan", type=Path)
parser.add_argument("--open3d", action="store_true")
parser.add_argument("--views", type=int, default=60)
options = parser.parse_args()

scan = open_scan(options.scan)
mesh = load_artifact(options.result / "stages" / "surface.npz").mesh
seen = load_artifact(options.result / "stages" / "mapping.npz").views
n = min(options.views, len(seen))
views = ThermalViews(seen.frame[:n], seen.times_s[:n], seen.T_world_thermal[:n])
assert scan.thermal is not None
converter = SignalConverter(scan.thermal.camera)

start, cpu = time.monotonic(), time.process_time()
rays = SurfaceRays(mesh)
observe_views(scan.thermal, rays, views, converter, MappingSection())
ours_s, ours_cpu_s = time.monotonic() - start, time.process_time() - cpu
told = f"{ours_s:.2f} s, {1e3 * ours_s / n:.1f} ms a view, CPU {ours_cpu_s:.2f} s"
print(f"ours   {len(mesh)} vertices, {n} views: {told}")

if options.open3d:
    target = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(mesh.vertices_m), o3d.core.Tensor(mesh.triangles))
    start = time.monotonic()
    target.compute_uvatlas(size=2048, gutter=1.0)
    atlas_s = time.monotonic() - start
    images = []
    for i in views.frame:
        counts = scan.thermal.load(int(i)).astype(np.float32)
        grey = ((counts - counts.min()) / max(float(np.ptp(counts)), 1.0) * 255).astype(np.uint8)
        images.append(o3d.t.geometry.Image(o3d.core.Tensor(np.repeat(grey[..., None], 3, axis=2))))
    K = o3d.core.Tensor(scan.thermal.camera.lens.K)
    start = time.monotonic()
    target.project_images_to_albedo(
        images, [K] * n, [o3d.core.Tensor(invert(T)) for T in views.T_world_thermal], 2048, True
    )
    project_s = time.monotonic() - start
    print(f"Open3D atlas {atlas_s:.1f} s, projection {project_s:.1f} s; ratio {(atlas_s + project_s) / ours_s:.0f}")
