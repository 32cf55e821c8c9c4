"""Do the calibration's 95 % intervals hold? Simulated rigs with truth, many seeds.

    python tests/benchmarks/calibration_coverage.py [seeds] [views] [fine]

`fine`: picks as good as sub-pixel detection (0.05 px colour, 0.1 px thermal), and a depth lens the maker calibrated.

Prints the share of true values inside their intervals by kind of number, and the errors of the extrinsics.
"""

from __future__ import annotations

import sys

import numpy as np

from thermofusion.calibration.cameras import intrinsics_of, to_rt
from thermofusion.calibration.rig import calibrate_views
from thermofusion.calibration.simulate import Noise, SimulatedRig, simulate_set
from thermofusion.geometry import invert, rotation_angle_deg


def run(seed: int, views: int, fine: bool) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """z scores (error / sigma) by kind, and the extrinsic errors (deg, mm)."""
    rig = SimulatedRig()
    noise = Noise(color_px=0.05, thermal_px=0.1) if fine else Noise()
    data, depth, _ = simulate_set(rig, seed, views=views, noise=noise)
    c = calibrate_views(data, depth_images=depth, depth_camera=rig.depth, depth_lens_known=fine)
    z, errors = {}, {}
    for name in ("color", "thermal"):
        s = np.sqrt(np.diag(c.fit.block_covariance(name)))
        free = s > 0
        z[name] = ((c.fit.block(name) - intrinsics_of(rig.camera(name)))[free]) / s[free]
        T, truth = c.extrinsics[f"T_{name}_depth"], rig.T_camera_depth(name)
        s = np.sqrt(np.diag(c.extrinsic_covariance[f"T_{name}_depth"]))
        z[f"T_{name}_depth"] = (to_rt(T) - to_rt(truth)) / s
        errors[f"{name}_deg"] = float(rotation_angle_deg(T @ invert(truth)))
        errors[f"{name}_mm"] = float(1e3 * np.linalg.norm(T[:3, 3] - truth[:3, 3]))
    T = c.extrinsics["T_thermal_depth"] @ invert(c.extrinsics["T_color_depth"])
    truth = rig.T_thermal_depth @ invert(rig.T_color_depth)
    errors["thermal_color_deg"] = float(rotation_angle_deg(T @ invert(truth)))
    errors["thermal_color_mm"] = float(1e3 * np.linalg.norm(T[:3, 3] - truth[:3, 3]))
    return z, errors


def main() -> None:
    numbers = [int(a) for a in sys.argv[1:] if a.isdigit()]
    seeds, views = numbers + [50, 24][len(numbers) :]
    results = [run(seed, views, "fine" in sys.argv) for seed in range(seeds)]
    print(f"{seeds} seeds, {views} views: share inside 95 % intervals, rms z")
    everything = []
    for kind in results[0][0]:
        z = np.stack([r[0][kind] for r in results])
        everything.append(z.ravel())
        print(f"  {kind:16s} {np.mean(np.abs(z) < 1.96):.3f}  {np.sqrt(np.mean(z**2)):.2f}  by number", end="")
        print(" ", np.mean(np.abs(z) < 1.96, axis=0).round(2), np.sqrt(np.mean(z**2, axis=0)).round(2))
    print(f"  all              {np.mean(np.abs(np.concatenate(everything)) < 1.96):.3f}")
    for key in results[0][1]:
        e = np.array([r[1][key] for r in results])
        print(f"  {key:18s} median {np.median(e):.4f}  95th percentile {np.percentile(e, 95):.4f}")


if __name__ == "__main__":
    main()
