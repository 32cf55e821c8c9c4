"""Verbs that look and change nothing: doctor, devices, check, recipe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..files.json import to_json
from .console import emit, help_alone, named, note

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
recipes = typer.Typer(
    help="The processing recipes: list, show, validate, keys.", invoke_without_command=True, callback=help_alone
)


def register(app: typer.Typer) -> None:
    """Add this module's verbs."""
    app.command()(doctor)
    app.command()(devices)
    app.command()(check)
    app.add_typer(recipes, name="recipe")


def doctor(
    udev: Annotated[
        Path | None, typer.Option(help="Write the udev rule that lets you open the cameras to this file.")
    ] = None,
    json: Json = False,
) -> int:
    """Versions, libraries, memory, cameras and USB permissions: what works here."""
    from .doctor import examine

    if udev is not None:
        from ..files.whole import write_text
        from ..recording.devices import KNOWN
        from ..recording.udev import RULES_FILE, udev_rules

        write_text(udev, udev_rules(KNOWN))
        note(f"wrote {udev}; its first lines say how it is put into {RULES_FILE}")
    findings = examine()
    sign = {"ok": "ok     ", "warning": "warning", "problem": "PROBLEM"}
    emit(findings, "\n".join(f"{sign[f.status]}  {f.subject}: {f.text}" for f in findings), json)
    return 5 if any(f.status == "problem" for f in findings) else 0


def devices(json: Json = False) -> None:
    """The cameras on the USB bus that `record` knows, and whether they may be opened."""
    from ..recording.devices import cameras
    from ..recording.usb import may_open

    rows = [
        {
            "name": c.name,
            "usb": f"{c.ids[0]:04x}:{c.ids[1]:04x}",
            "bus": c.bus,
            "address": c.address,
            "may_open": may_open(c.usb),
        }
        for c in cameras()
    ]
    lines = [
        f"{r['name']} ({r['usb']} at {r['bus']}:{r['address']}){'' if r['may_open'] else ': no permission'}"
        for r in rows
    ]
    emit({"devices": rows}, "\n".join(lines) or "no camera known to thermofusion is on the USB bus", json)


def check(
    scan: Annotated[Path, typer.Argument(help="A scan folder, or a foreign recording.")],
    format: Annotated[str | None, typer.Option(help="Format of the recording; recognised by default.")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for overlay pictures.", callback=named)
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="Overlay this rig.json instead of the scan's own.")] = None,
    template: Annotated[
        bool, typer.Option("--template", help="Print a metadata.json to fill in and to put beside the recording.")
    ] = False,
    json: Json = False,
) -> int:
    """Streams, sync, units, extrinsics, overlay pictures, missing metadata of a recording."""
    from ..report.metadata import template as to_fill_in
    from ..report.pictures import write_png
    from ..scans import open_scan, with_rig
    from ..scans.check import check_scan, overlays

    recording = open_scan(scan, format=format)
    if rig is not None:
        recording = with_rig(recording, rig)
    if template:
        document = to_fill_in(recording)
        emit(document, to_json(document), json)
        return 0
    report = check_scan(recording)
    pictures = []
    if out is not None:
        for name, image in overlays(recording).items():
            write_png(out / f"{name}.png", image)
            pictures.append(out / f"{name}.png")
    emit({**vars(report), "pictures": pictures}, report.text(), json)
    for picture in pictures:
        note(f"wrote {picture}")
    return 3 if report.unusable else 0


@recipes.command("list")
def recipe_list(json: Json = False) -> None:
    """The shipped recipes, and the scenes of `simulate`."""
    from ..phantom import load_scene, shipped_scenes
    from ..recipe import load_recipe, shipped_recipes

    found = {name: load_recipe(name).description for name in shipped_recipes()}
    scenes = {name: load_scene(name).description for name in shipped_scenes()}
    lines = [f"{name:<18} {text}" for name, text in found.items()]
    lines += ["", "scenes, for `thermofusion simulate SCENE -o SCAN`:"]
    lines += [f"{name:<18} {text}".rstrip() for name, text in scenes.items()]
    emit({"recipes": found, "scenes": scenes}, "\n".join(lines), json)


@recipes.command("show")
def recipe_show(
    recipe: Annotated[str, typer.Argument(help="A shipped name or a TOML file.")],
    set_: Annotated[list[str] | None, typer.Option("--set", help="section.key=value")] = None,
    source: Annotated[bool, typer.Option("--source", help="The commented file instead of every resolved key.")] = False,
    json: Json = False,
) -> None:
    """A recipe with every key it resolves to, or (--source) the commented file."""
    from ..recipe import find_recipe, load_recipe

    resolved = load_recipe(recipe, set_ or ())
    text = find_recipe(recipe).read_text(encoding="utf-8") if source else resolved.to_toml()
    emit(resolved, text.rstrip(), json)


@recipes.command("validate")
def recipe_validate(
    recipe: Annotated[str, typer.Argument(help="A shipped name or a TOML file.")],
    set_: Annotated[list[str] | None, typer.Option("--set", help="section.key=value")] = None,
    json: Json = False,
) -> None:
    """Whether a recipe is valid; an unknown key is named with its nearest match."""
    from ..recipe import load_recipe

    resolved = load_recipe(recipe, set_ or ())
    emit({"valid": True, "name": resolved.name}, f"{recipe}: valid", json)


@recipes.command("keys")
def recipe_keys(json: Json = False) -> None:
    """Every key a recipe may have, its default and its meaning."""
    from ..recipe import Recipe, key_reference

    emit(Recipe.model_json_schema(), key_reference().rstrip(), json)
