"""README's pictures of the demo: `python docs/build_images.py DEMO-RESULT` after `thermofusion demo -o DEMO-RESULT`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from thermofusion.export import palettes
from thermofusion.pipeline import load_mesh
from thermofusion.report.lettering import Scale
from thermofusion.report.pictures import SHADING, render_scalar, render_views, write_png

HEIGHT_PX = 720


def build(result: Path, images: Path) -> None:
    """Write demo-result.png and demo-correction.png into a folder. Raises ScanError for what is no result."""
    mesh = load_mesh(result)
    write_png(images / "demo-result.png", render_views(mesh, height_px=HEIGHT_PX)["overview"])
    correction_K = mesh.temperature_degC - mesh.apparent_degC
    lo, hi = palettes.color_range(correction_K, step=0.1)
    low, middle, high = np.nanpercentile(correction_K, (1, 50, 99))
    about = "emissivity, oblique view, reflection, drift and vignetting of the camera\n"
    about += f"demo; median {middle:.2f} K; 98 % of the skin within {low:.2f} to {high:.2f} K"
    scale = Scale("cividis", lo, hi, "K", "Skin temperature minus apparent temperature", about, SHADING)
    write_png(images / "demo-correction.png", render_scalar(mesh, correction_K, scale, height_px=HEIGHT_PX)["overview"])


if __name__ == "__main__":
    build(Path(sys.argv[1]), Path(__file__).resolve().parent / "images")
