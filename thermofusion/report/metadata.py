"""What a study must say beside its numbers: the 15 items of TISEM and a laboratory's own, asked for, never demanded.

TISEM: Moreira et al. 2017, J. Thermal Biology 69, 155, doi:10.1016/j.jtherbio.2017.07.006. The answers stand in
`metadata.json` beside the recording (`thermofusion check SCAN --template`); scan.json and the recording answer some.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, JsonValue

from ..errors import counted
from ..files.reading import read_json
from ..files.strict import Border, validated
from ..physics.band import ZERO_DEGC_K
from ..recipe import TemperatureSection
from ..types import BudgetInput, Scan

SCHEMA: Literal["thermofusion-metadata/1"] = "thermofusion-metadata/1"
FILE = "metadata.json"
LONGEST = 2000  # characters of an answer that are kept


@dataclass(frozen=True)
class Item:
    """One thing to state. tisem : its number there, None = beyond. personal : goes when identity goes."""

    key: str
    what: str
    tisem: int | None = None
    personal: bool = False


ITEMS = (
    Item("subject.pseudonym", "pseudonym of the subject", personal=True),
    Item("subject.description", "age, sex, height, mass, whatever else bears on skin temperature", 1, personal=True),
    Item("preparation.abstained", "4 h before: alcohol, smoking, caffeine, meals, ointments, cosmetics, shower", 2),
    Item("preparation.skin_factors", "exercise, massage, therapy, sun, heat or cold before the recording", 3),
    Item("room.climate", "room temperature and humidity, mean and spread", 4),
    Item("room.sources", "radiant sources, lamps and airflow near the subject", 5),
    Item("camera.thermal", "thermal camera: maker, model, accuracy", 6),
    Item("preparation.acclimatisation_min", "acclimatisation in the room, minutes", 7),
    Item("camera.warm_up_min", "camera switched on before the recording, minutes", 8),
    Item("recording.distance", "distance of the camera", 9),
    Item("recording.angle", "angle between camera and skin", 10),
    Item("recording.emissivity", "emissivity used", 11),
    Item("recording.time", "date and time of day", 12, personal=True),
    Item("subject.posture", "position of the body", 13),
    Item("preparation.drying", "how the skin was dried, if it was wet", 14),
    Item("analysis.regions", "how regions were chosen and evaluated", 15),
    Item("camera.serial", "serial number of the thermal camera", personal=True),
    Item("camera.calibration_date", "last calibration of the thermal camera", personal=True),
    Item("camera.reference", "temperature reference in view"),
    Item("camera.optics", "lens, window, filters"),
    Item("operator", "who recorded", personal=True),
)


class MetadataFile(Border):
    """metadata.json: answers by key; null = not stated."""

    schema_: Literal["thermofusion-metadata/1"] = Field(alias="schema")
    answers: dict[str, JsonValue] = Field(default_factory=dict)


def template(scan: Scan) -> dict[str, Any]:
    """A metadata.json to fill in: what the recording answers itself is filled, each item said in words."""
    known = {row["key"]: row["value"] for row in stated(scan)}
    return {
        "schema": SCHEMA,
        "answers": {item.key: known[item.key] for item in ITEMS},
        "what": {item.key: f"TISEM {item.tisem}: {item.what}" if item.tisem else item.what for item in ITEMS},
    }


def stated(scan: Scan, found: Mapping[str, str] | None = None) -> list[dict[str, Any]]:
    """Every item with what is stated, by whom; value None = missing.

    found : answers that the result itself gives. Raises ScanError for a metadata.json that is none.
    """
    given = {k: (v, FILE) for k, v in _answers(scan).items()}
    own = {k: (v, "scan.json") for k, v in _of_scan(scan).items()}
    measured = {k: (v, "measured") for k, v in (found or {}).items()}
    known = measured | own | given
    return [
        {"key": i.key, "what": i.what, "tisem": i.tisem, "value": known.get(i.key, (None, None))[0],
         "source": known.get(i.key, (None, None))[1]}
        for i in ITEMS
    ]  # fmt: skip


def _answers(scan: Scan) -> dict[str, str]:
    folder = scan.root if scan.root.is_dir() else scan.root.parent
    path = folder / FILE
    if not path.is_file():
        return {}
    answers = validated(MetadataFile, read_json(path), path, "`thermofusion check SCAN --template` prints one").answers
    return {k: _text(v) for k, v in answers.items() if v not in (None, "")}


def _of_scan(scan: Scan) -> dict[str, str]:
    """Answers that the recording gives."""
    subject, room, out = scan.subject, scan.environment, {}
    for key, name in (("subject.pseudonym", "pseudonym"), ("subject.posture", "posture"),
                      ("preparation.acclimatisation_min", "acclimatisation_min")):  # fmt: skip
        if name in subject:
            out[key] = _text(subject[name])
    if room.air_degC is not None:
        humidity = "" if room.relative_humidity_pct is None else f", {room.relative_humidity_pct:g} % humidity"
        out["room.climate"] = f"{room.air_degC:g} °C{humidity}"
    if scan.recorded_at is not None:
        out["recording.time"] = scan.recorded_at
    if scan.references:
        out["camera.reference"] = ", ".join(f"{r.kind} at {r.degC:g} ± {r.uncertainty_K:g} °C" for r in scan.references)
    return out


def _text(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text[:LONGEST]


def radiometric_numbers(
    scan: Scan, settings: TemperatureSection, inputs: Sequence[BudgetInput] = ()
) -> list[dict[str, str]]:
    """Every number that turned signal into temperature, with its unit and where it comes from.

    inputs : what the temperatures depended on; a room that was seen is told beside what was stated of it.
    """
    room, e = scan.environment, settings.emissivity
    shape = ", ".join(f"{k} = {v:g}" for k in ("n", "k", "epsilon0") if (v := getattr(e, k)) is not None)
    rows = [("emissivity ε(θ)", f"{e.model}{', ' * bool(shape)}{shape}", "recipe")]
    for m in scan.materials:
        stated = m.emissivity if isinstance(m.emissivity, dict) else {}
        told = "as the skin" if m.emissivity == "skin" else ", ".join(f"{k} = {v}" for k, v in stated.items())
        rows.append((f"emissivity of '{m.name}'", told or "not stated", "scan.json"))
    each = _frame_by_frame(scan)
    for what, key, chosen, of_scan in (
        ("reflected temperature", "reflected_degC", settings.reflected_degC, room.reflected_degC),
        ("air temperature", "air_degC", settings.air_degC, room.air_degC),
    ):
        if chosen is None and key in each:
            rows.append((what, *each[key]))
        elif chosen is not None or of_scan is not None:
            value, source = (of_scan, "scan.json") if chosen is None else (chosen, "recipe")
            rows.append((what, f"{value:g} °C", source))
        else:
            rows.append((what, "not stated", "assumed: see the notes"))
    for i in inputs:
        if i.name == "reflected" and i.kind == "A":
            seen = f"{i.value - ZERO_DEGC_K:.2f} ± {i.u:.2f} °C"
            rows.insert(
                2 + len(scan.materials), ("reflected temperature that was used", seen, "background of the views")
            )
    if "relative_humidity_pct" in each:
        rows.append(("humidity", *each["relative_humidity_pct"]))
    elif room.relative_humidity_pct is not None:
        rows.append(("humidity", f"{room.relative_humidity_pct:g} %", "scan.json"))
    for what, key in (("temperature of the sensor", "fpa_degC"), ("temperature of the lens", "lens_degC")):
        rows += [(what, *each[key])] if key in each else []
    rows.append(("transmission of a metre of air", f"{settings.transmission_per_m:g}", "recipe"))
    rows.append(("uncertainty of the reflected temperature", f"{settings.sigma_reflected_K:g} K", "recipe"))
    rows.append(("uncertainty of ε(0)", f"{settings.sigma_emissivity0:g}", "recipe"))
    if scan.thermal is not None:
        camera = scan.thermal.camera
        curve = camera.signal.kind if camera.signal.curve == "none" else camera.signal.curve
        rows.append(("band of the camera", "{:g} to {:g} µm".format(*camera.band_um), "scan.json"))
        rows.append(("noise of a pixel (NETD)", f"{camera.netd_K:g} K", "scan.json"))
        rows.append(("signal", curve, "scan.json"))
    rows += [(f"reference: {r.kind}", f"{r.degC:g} ± {r.uncertainty_K:g} °C", "scan.json") for r in scan.references]
    return [dict(zip(("what", "value", "source"), row, strict=True)) for row in rows]


def _frame_by_frame(scan: Scan) -> dict[str, tuple[str, str]]:
    """What is stated of each thermal frame, by column: (its range, where it stands)."""
    if scan.thermal is None or scan.thermal.conditions is None:
        return {}
    source = "frames.csv" if scan.format == "native" else "the recording"
    out = {}
    for name, column in scan.thermal.conditions.stated.items():
        known = column[np.isfinite(column)]
        unit = "%" if name.endswith("_pct") else "°C"
        stated = f"{known.min():g} to {known.max():g} {unit}, stated of {counted(len(known), 'frame')}"
        out[name] = stated, source
    return out
