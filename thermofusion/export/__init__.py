"""A result's files: each writer with its reader. Which property is what: docs/formats.md."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from ..errors import RecipeError, ResourceError, ScanError
from ..files.tum import read_trajectory, write_trajectory
from ..types import OutputMode, ThermalMesh
from .axes import axes_of, view_axes
from .csv import read_csv, write_csv
from .glb import read_glb, write_glb
from .ply import read_ply, write_ply
from .solid import closed, write_closed, write_obj, write_stl
from .vtp import read_vtp, write_vtp

__all__ = [
    "MeshFormat",
    "axes_of",
    "closed",
    "export",
    "read_csv",
    "read_glb",
    "read_mesh",
    "read_ply",
    "read_trajectory",
    "read_vtp",
    "showing",
    "view_axes",
    "write_csv",
    "write_glb",
    "write_ply",
    "write_trajectory",
    "write_vtp",
]

MeshFormat = Literal["ply", "glb", "vtp", "csv", "obj", "stl", "vtk-mesh"]
FILES = {"vtk-mesh": "{0}-closed.vtp"}  # of formats whose file is not NAME.FORMAT
_COLORED: dict[str, Callable[[Path, ThermalMesh, str, tuple[float, float] | None], Path]] = {
    "ply": write_ply,
    "glb": write_glb,
    "vtp": write_vtp,
    "obj": write_obj,
    "stl": write_stl,
    "vtk-mesh": write_closed,
}
_READERS: dict[str, Callable[[Path], ThermalMesh]] = {".ply": read_ply, ".glb": read_glb, ".vtp": read_vtp}


def export(
    mesh: ThermalMesh,
    folder: str | Path,
    formats: Iterable[str] = ("ply", "glb", "vtp"),
    *,
    palette: str = "inferno",
    range_degC: tuple[float, float] | None = None,
    name: str = "mesh",
) -> list[Path]:
    """Write `<name>.<format>` for each format (`<name>-closed.vtp` for vtk-mesh) into a folder, made if need be.

    Raises RecipeError for an unknown format, palette or range, ValueError for a broken mesh, ResourceError for the
    disk. Every file is whole or absent.
    """
    folder, wanted = Path(folder), list(dict.fromkeys(formats))
    unknown = [f for f in wanted if f not in get_args(MeshFormat)]
    if unknown:
        raise RecipeError(f"there is no format '{unknown[0]}'", hint=f"choose from {', '.join(get_args(MeshFormat))}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ResourceError(f"the folder cannot be made ({e.strerror})", place=folder) from None
    written = []
    for form in wanted:
        path = folder / FILES.get(form, "{}.{}").format(name, form)
        written.append(write_csv(path, mesh) if form == "csv" else _COLORED[form](path, mesh, palette, range_degC))
    return written


def read_mesh(path: str | Path) -> ThermalMesh:
    """A result from its mesh file, by suffix, or from its folder (PLY first: it keeps everything). Raises ScanError."""
    path = Path(path)
    if path.is_dir():
        found = [path / f"mesh{suffix}" for suffix in (".ply", ".vtp", ".glb") if (path / f"mesh{suffix}").is_file()]
        if not found:
            raise ScanError("the folder has no mesh.ply, mesh.vtp or mesh.glb", place=path)
        path = found[0]
    if path.suffix.lower() not in _READERS:
        raise ScanError(f"'{path.suffix}' is no mesh format that is read", place=path, hint="use .ply, .vtp or .glb")
    return _READERS[path.suffix.lower()](path)


def showing(mesh: ThermalMesh, mode: OutputMode) -> ThermalMesh:
    """The mesh with its apparent temperature in the first place (`mode="apparent"`), or itself if it is of that mode.

    The budget is the corrected value's, so an apparent mesh has none (NaN). Raises RecipeError for what the mesh does
    not hold: absolute and normal-equivalent temperatures need the observations, not only the result.
    """
    if mode == mesh.mode:
        return mesh
    if mode != "apparent":
        raise RecipeError(
            f"the result holds {mesh.mode} temperatures, not {mode}", hint=f"run with --set temperature.output={mode}"
        )
    unknown = np.full(len(mesh), np.nan, np.float32)
    return replace(mesh, temperature_degC=mesh.apparent_degC, mode=mode, uncertainty_K=unknown, uncertainty_parts={})
