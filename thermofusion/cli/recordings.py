"""Verbs that make scans: import, simulate."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from ..errors import RecipeError
from .console import emit, progress

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Force = Annotated[bool, typer.Option("--overwrite", help="Replace an existing scan folder.")]


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.command("import")(import_)
    app.command()(simulate)


def import_(
    recording: Annotated[Path, typer.Argument(help="A foreign recording.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Scan folder to write.")],
    format: Annotated[str | None, typer.Option(help="Format of the recording; recognised by default.")] = None,
    thermal: Annotated[Path | None, typer.Option(help="FLIR JPEG or SEQ file(s) to add as thermal frames.")] = None,
    rig: Annotated[Path | None, typer.Option(help="rig.json with the cameras; needed with --thermal.")] = None,
    overwrite: Force = False,
    json: Json = False,
) -> None:
    """Write a foreign recording in the native scan form."""
    from ..scans import open_scan, with_rig, with_thermal
    from ..scans.native.write import write_scan
    from ..scans.thermal.flir import read_thermal_frames

    scan = open_scan(recording, format=format)
    if thermal is not None and rig is None:
        raise RecipeError(
            "--thermal needs --rig: where the thermal camera sits",
            hint="`thermofusion calibrate PICTURES -o rig.json` writes one",
        )
    if thermal is not None and rig is not None:
        scan = with_thermal(scan, read_thermal_frames(thermal), rig)
    elif rig is not None:
        scan = with_rig(scan, rig)
    with progress(json) as step:
        write_scan(scan, out, overwrite=overwrite, progress=step)
    streams = {name: len(s) for name in ("depth", "color", "thermal") if (s := getattr(scan, name)) is not None}
    counts = ", ".join(f"{n} {name}" for name, n in streams.items())
    emit(
        {"scan": out, "format": scan.format, "frames": streams, "notes": scan.notes},
        f"wrote {out}: {counts} frames",
        json,
    )


def simulate(
    scene: Annotated[
        str, typer.Argument(help="A shipped scene (`thermofusion recipe list` names them) or a TOML file.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Scan folder to write.")],
    seed: Annotated[int, typer.Option(help="Of the noise; same seed, same scan.")] = 0,
    overwrite: Force = False,
    json: Json = False,
) -> None:
    """A phantom with known truth, recorded as a scan."""
    from ..phantom import load_scene
    from ..phantom import simulate as record

    with progress(json) as step:
        frames = partial(step, "frames")
        folder = record(load_scene(scene), out, seed=seed, overwrite=overwrite, progress=frames)
    emit({"scan": folder, "seed": seed}, f"wrote {folder}", json)
