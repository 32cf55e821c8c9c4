"""Raw Kinect disparity, end to end: are depth model, rig and depth found within their intervals? Many seeds.

    python tests/benchmarks/calibration_disparity.py [seeds] [views]

Prints the share of true values inside their 95 % intervals by kind, and the error of depth itself over the image.
"""

from __future__ import annotations

import sys

import numpy as np
from support.simulated_disparity import disparity_image, true_parameters
from support.simulated_rig import SimulatedRig, simulate_set

from thermofusion.calibration.fit.cameras import to_rt
from thermofusion.calibration.fit.depth_model import DisparityDepth
from thermofusion.calibration.fit.rig import calibrate_views


def run(seed: int, views: int) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """z scores (error / sigma) by kind; errors of depth at 0.9, 1.3 and 1.8 m [mm], rms over the image's inner part."""
    rig, model = SimulatedRig(), DisparityDepth((640, 480))
    data, _, poses = simulate_set(rig, seed, views=views, with_depth=False)
    theta = true_parameters(model, 1000 + seed)
    images = {}
    for i, (view, T) in enumerate(zip(data.views, poses, strict=True)):
        image = disparity_image(rig, T, model, theta, 100 * seed + i).astype(np.float32)
        images[view.name] = lambda image=image: image
    c = calibrate_views(data, depth_images=images, depth_camera=rig.depth, depth_kind="disparity")
    found, covariance = c.fit.block("depth_model"), c.fit.block_covariance("depth_model")
    z = {"c0 c1 decay": ((found - theta) / np.sqrt(np.diag(covariance)))[:3]}
    z["field"] = ((found - theta) / np.sqrt(np.diag(covariance)))[3:]
    for name in ("color", "thermal"):
        key = f"T_{name}_depth"
        sigma = np.sqrt(np.diag(c.extrinsic_covariance[key]))
        z[key] = (to_rt(c.extrinsics[key]) - to_rt(rig.T_camera_depth(name))) / sigma
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(120, 520, 9), np.linspace(100, 380, 7)))
    errors = {}
    for distance in (0.9, 1.3, 1.8):
        true = np.full(len(u), distance)
        e = model.to_depth_m(found, model.to_disparity(theta, true, u, v), u, v) - true
        errors[f"depth at {distance} m, mm"] = 1e3 * float(np.sqrt(np.mean(e**2)))
        raw = model.to_depth_m(model.start(), model.to_disparity(theta, true, u, v), u, v) - true
        errors[f"uncalibrated at {distance} m"] = 1e3 * float(np.sqrt(np.mean(raw**2)))
    return z, errors


def main() -> None:
    seeds, views = ([int(a) for a in sys.argv[1:]] + [20, 24][len(sys.argv) - 1 :])[:2]
    results = [run(seed, views) for seed in range(seeds)]
    print(f"{seeds} seeds, {views} views: share inside 95 % intervals, rms z")
    for kind in results[0][0]:
        z = np.stack([r[0][kind] for r in results])
        print(f"  {kind:16s} {np.mean(np.abs(z) < 1.96):.3f}  {np.sqrt(np.mean(z**2)):.2f}")
    everything = np.concatenate([np.concatenate(list(r[0].values())) for r in results])
    print(f"  all              {np.mean(np.abs(everything) < 1.96):.3f}")
    for key in results[0][1]:
        print(f"  {key:22s} median {np.median([r[1][key] for r in results]):.2f}")


if __name__ == "__main__":
    main()
