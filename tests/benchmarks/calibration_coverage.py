"""Do the calibration's 95 % intervals hold? Simulated rigs with truth, many seeds.

    python tests/benchmarks/calibration_coverage.py pictures [seeds] [views]
    python tests/benchmarks/calibration_coverage.py [fine] [seeds] [views]

`pictures`: whole folders of colour, thermal, depth and infrared pictures (blur, noise, pins of either sign, missing
pins, a Kinect's disparity), read, detected and adjusted by `calibrate`; every seed with another depth camera. Without
the infrared pictures and the depth lens unknown, then with the maker's calibration of it, then with the infrared ones.
Otherwise points with the noise of picks by hand, or (`fine`) of 0.05 px in colour and 0.1 px in thermal pictures and
the depth lens known.

Prints the share of true values inside their intervals by kind of number, and the errors of the extrinsics.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from support.simulated_pictures import Kinect, write_folder
from support.simulated_rig import Noise, SimulatedRig, simulate_set, true_pixels

from thermofusion.calibration import Calibration, calibrate, calibrate_views
from thermofusion.calibration.fit.cameras import intrinsics_of, to_rt
from thermofusion.geometry.rigid import invert, rotation_angle_deg

Result = tuple[dict[str, np.ndarray], dict[str, float]]


def judged(rig: SimulatedRig, c: Calibration) -> Result:
    """z scores (error / sigma) by kind, and the errors of the extrinsics (deg, mm)."""
    z, errors = {}, {}
    for name in ("color", "thermal"):
        s = np.sqrt(np.diag(c.fit.block_covariance(name)))
        free = s > 0
        z[name] = ((c.fit.block(name) - intrinsics_of(rig.camera(name)))[free]) / s[free]
        T, truth = c.extrinsics[f"T_{name}_depth"], rig.T_camera_depth(name)
        s = np.sqrt(np.diag(c.extrinsic_covariance[f"T_{name}_depth"]))
        z[f"T_{name}_depth"] = (to_rt(T) - to_rt(truth)) / s
        _add_errors(errors, f"{name}-depth", T, truth)
    T = c.extrinsics["T_thermal_depth"] @ invert(c.extrinsics["T_color_depth"])
    truth = rig.T_thermal_depth @ invert(rig.T_color_depth)
    fit = c.fit
    key = fit.problem.extrinsic_key("thermal", c.chosen_group)
    z["T_thermal_color"] = (fit.block(key) - to_rt(truth)) / np.sqrt(np.diag(fit.block_covariance(key)))
    _add_errors(errors, "thermal-color", T, truth)
    return z, errors


def _add_errors(errors: dict[str, float], pair: str, T: np.ndarray, truth: np.ndarray) -> None:
    errors[f"{pair} deg"] = float(rotation_angle_deg(T @ invert(truth)))
    errors[f"{pair} mm"] = float(1e3 * np.linalg.norm(T[:3, 3] - truth[:3, 3]))


def from_points(seed: int, views: int, fine: bool) -> dict[str, Result]:
    rig = SimulatedRig()
    noise = Noise(color_px=0.05, thermal_px=0.1) if fine else Noise()
    data, depth, _ = simulate_set(rig, seed, views=views, noise=noise)
    c = calibrate_views(data, depth_images=depth, depth_camera=rig.depth, depth_lens_known=fine)
    return {"points": judged(rig, c)}


def from_pictures(seed: int, views: int) -> dict[str, Result]:
    rig = SimulatedRig()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        poses = write_folder(root, rig, seed, views=views, kinect=Kinect.drawn(seed), infrared=True)
        found = calibrate(root)
        full, folder_ = found.calibration, found.folder
        images = {n: (lambda n=n: folder_.depth(n)) for n in folder_.files["depth"]}
        blind = replace(full.data, views=tuple(v.with_points("depth", None) for v in full.data.views))
        c = calibrate_views(blind, depth_images=images, depth_camera=folder_.depth_camera)
        known = calibrate_views(blind, depth_images=images, depth_camera=rig.depth, depth_lens_known=True)
    out = {
        "depth lens unknown": judged(rig, c),
        "depth lens known": judged(rig, known),
        "infrared pictures, lens unknown": judged(rig, full),
    }
    for camera in ("color", "thermal"):
        e = [
            v.points[camera].px - true_pixels(rig, camera, poses[int(v.name)])[v.points[camera].index]
            for v in c.data.seen_by(camera)
        ]
        for _, errors in out.values():
            errors[f"{camera} points px"] = float(np.median(np.linalg.norm(np.concatenate(e), axis=1)))
            errors[f"{camera} views"] = float(len(e))
    short = {k: round(v, 3) for k, v in out["depth lens unknown"][1].items()}
    print(f"seed {seed}: {short} {' '.join(c.notes)}", file=sys.stderr, flush=True)
    return out


def main() -> None:
    cv2.setNumThreads(1)
    numbers = [int(a) for a in sys.argv[1:] if a.isdigit()]
    seeds, views = numbers + [50, 24][len(numbers) :]
    if "pictures" in sys.argv:
        results = [from_pictures(seed, views) for seed in range(seeds)]
    else:
        results = [from_points(seed, views, "fine" in sys.argv) for seed in range(seeds)]
    for case in results[0]:
        print(f"{case}, {seeds} seeds, {views} views: share inside 95 % intervals, rms z")
        _print([r[case] for r in results])


def _print(results: list[Result]) -> None:
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
