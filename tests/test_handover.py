"""What leaves the house: DICOM that foreign readers take, and results that do not tell who they are of."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from support.result_maker import result, sphere
from support.scan_maker import tiny_scan
from typer.testing import CliRunner

from thermofusion.cli import app
from thermofusion.errors import ScanError
from thermofusion.export import read_mesh
from thermofusion.export.axes import axes_of
from thermofusion.recipe import Recipe
from thermofusion.regions import Brush, Measurer, Spot, write_regions
from thermofusion.report.casts import cast_views
from thermofusion.report.html import report_html
from thermofusion.report.metadata import stated, template
from thermofusion.results.artifacts import save_artifact
from thermofusion.temperature.solve import Temperature

SECRETS = ("Erika Musterfrau", "MRN-4711", "2026-05-04", "10:31", "SN-998877", "/home/clinic/scans", "Dr. Operator")


@pytest.fixture
def folder(tmp_path):
    """A result's folder of a tall egg, with secrets wherever a result holds text."""
    name, number, day, clock, serial, place, operator = SECRETS
    mesh = result(sphere(60, 90, (0.12, 0.1, 0.3)), unmeasured_below_m=-0.27)
    told = {"metadata": {"up": "0 0 1", "front": "0 -1 0", "scan": name}, "residual": mesh.uncertainty_K}
    mesh = type(mesh)(**{**vars(mesh), **told})
    T = mesh.temperature_degC
    out = tmp_path / "result"
    save_artifact(out / "result.npz", Temperature(mesh, T, T, mesh.apparent_degC, messages=(place,)))
    recipe = Recipe(name="torso", description=f"for {name}")
    (out / "recipe.resolved.toml").write_text(recipe.to_toml())
    stated = {"subject.pseudonym": number, "operator": operator, "camera.serial": serial,
              "preparation.abstained": f"{name} did", "recording.time": f"{day}T{clock}"}  # fmt: skip
    report = {
        "scan": {"name": name, "recorded_at": f"{day}T{clock}:00", "frames": {"depth": 3}},
        "recipe": "torso",
        "messages": [f"read from {place}"],
        "diagnosis": [{"sentence": f"{place} is odd"}],
        "quality": {"failed": []},
        "metadata": [{"key": k, "what": k, "tisem": None, "value": v, "source": "metadata.json"}
                     for k, v in stated.items()],
    }  # fmt: skip
    (out / "result.json").write_text(json.dumps(report))
    return out


def run(*arguments):
    done = CliRunner().invoke(app, [str(a) for a in arguments])
    assert done.exit_code == 0, done.output + str(done.exception)
    return done


def test_nothing_deidentified_tells_who_it_is(folder, tmp_path, monkeypatch):
    """Every byte of every file, as text and unpacked: no name, number, date, time, place; no colour; no face."""
    regions = write_regions(tmp_path / "r.json", [Spot(name=SECRETS[0], point_m=(0, 0.2, 0.05))])
    out = tmp_path / "out"
    page = out / "report.html"
    run("report", folder, "--deidentify", "--regions", regions, "-o", page)
    pytest.importorskip("highdicom", reason="pip install 'thermofusion[dicom]'")
    monkeypatch.setattr("thermofusion.handover.dicom._report_pdf", lambda r: report_html(r).encode())
    formats = "ply,glb,vtp,csv,obj,stl,vtk-mesh,dicom"
    run("export", folder, "--deidentify", "--regions", regions, "--format", formats, "-o", out)
    files = [p for p in out.rglob("*") if p.is_file()]
    assert {p.name for p in files} >= {"report.html", "mesh.ply", "mesh.glb", "mesh-closed.vtp", "report.dcm"}
    for path in files:
        data = path.read_bytes()
        for secret in SECRETS:
            assert secret.encode() not in data, (path.name, secret)
    assert all(secret in (folder / "result.json").read_text() for secret in SECRETS[1:6])  # they were there
    read = read_mesh(out / "mesh.ply")
    assert read.surface.color_rgb is None
    before = Measurer(result(sphere(60, 90, (0.12, 0.1, 0.3)))).body.vertices_m
    after = read.surface.vertices_m.astype(np.float64) @ axes_of(read.metadata).T
    head = before[:, 1].max() - 0.25
    assert (after[:, 1] > head).sum() < 0.2 * (before[:, 1] > head).sum()
    assert (after[:, 1] < head - 0.05).sum() == (before[:, 1] < head - 0.05).sum()
    text = page.read_text()
    assert "forehead" in text
    assert "inner eye corner" in text
    refused = CliRunner().invoke(app, ["export", str(folder), "--deidentify"])
    assert "-o" in str(refused.exception)


def test_dicom_gives_floats_back_and_foreign_readers_take_it(folder, tmp_path, monkeypatch):
    pydicom = pytest.importorskip("pydicom", reason="pip install 'thermofusion[dicom]'")
    pytest.importorskip("highdicom", reason="pip install 'thermofusion[dicom]'")
    tools = {name: shutil.which(name) for name in ("dcmdump", "dciodvfy")}
    monkeypatch.setattr("thermofusion.handover.dicom._report_pdf", lambda _: b"%PDF-1.4 test")
    drawn = [Brush(name="left knee", points_m=[(0, 0, 0.1)], normals=[(0, 0, 1)], radius_m=0.04)]
    regions = write_regions(tmp_path / "r.json", drawn)
    run("export", folder, "--format", "dicom", "--regions", regions, "-o", tmp_path / "a")
    study = {p.stem: pydicom.dcmread(p) for p in (tmp_path / "a" / "dicom").glob("*.dcm")}
    assert len(study) == 4 * 3 + 3
    assert len({d.StudyInstanceUID for d in study.values()}) == 1
    assert len({d.SOPInstanceUID for d in study.values()}) == len(study)
    assert {study[n].Modality for n in study if "-" in n} == {"TG"}
    assert study["surface"].EncapsulatedDocument.startswith(b"# thermofusion")
    assert study["report"].EncapsulatedDocument.startswith(b"%PDF")

    from thermofusion.handover.dicom import HEIGHT_PX, pixels
    from thermofusion.results.folder import load_temperature

    mesh = load_temperature(folder).mesh
    for cast in cast_views(mesh.surface, axes_of(mesh.metadata), HEIGHT_PX):
        ds = study[f"temperature-{cast.name}"]
        stored = np.frombuffer(ds.FloatPixelData, "<f4").reshape(ds.Rows, ds.Columns)
        assert stored.tobytes() == pixels(cast, mesh.temperature_degC).tobytes()
        assert np.nanmax(stored) > 30
        device = ds.ContributingEquipmentSequence[-1].DeviceTypeCodeSequence[0]
        assert (device.CodeValue, device.CodingSchemeDesignator) == ("130648", "DCM")
    reading = Measurer(mesh).read(drawn[0])
    text = str(study["regions"])
    assert "181553006" in text  # SNOMED: skin of anterior surface of knee
    assert "39106-0" in text
    values = [float(x.value) for x in study["regions"].iterall() if x.keyword == "NumericValue"]
    for ours in (reading.value_degC, reading.area_cm2, reading.sigma_K):
        assert np.abs(np.array(values) - ours).min() < 1e-4
    for path in (tmp_path / "a" / "dicom").glob("*.dcm"):
        if tools["dcmdump"]:
            subprocess.run([tools["dcmdump"], "-q", path], check=True, capture_output=True)
        if tools["dciodvfy"] and path.stem != "surface":  # it does not know Encapsulated OBJ
            said = subprocess.run([tools["dciodvfy"], path], capture_output=True, text=True, check=False)
            errors = [line for line in (said.stdout + said.stderr).splitlines() if line.startswith("Error")]
            assert not errors, (path.name, errors)
    run("export", folder, "--format", "dicom", "--regions", regions, "-o", tmp_path / "b")
    again = {p.stem: pydicom.dcmread(p).SOPInstanceUID for p in (tmp_path / "b" / "dicom").glob("*.dcm")}
    assert again == {k: d.SOPInstanceUID for k, d in study.items()}


def test_metadata_beside_a_recording_is_asked_for_and_taken(tmp_path):
    """The template names TISEM's 15 items; what is filled in comes back with its source, the rest is missing."""
    scan = replace(tiny_scan(), root=tmp_path, recorded_at="2026-05-04T10:31:00")
    form = template(scan)
    assert sorted(row["tisem"] for row in stated(scan) if row["tisem"]) == list(range(1, 16))
    assert form["answers"]["recording.time"] == "2026-05-04T10:31:00"
    form["answers"] |= {"subject.posture": "standing", "camera.warm_up_min": 20, "operator": "<b>x</b>"}
    (tmp_path / "metadata.json").write_text(json.dumps(form))
    rows = {row["key"]: row for row in stated(scan, {"recording.distance": "1 m"})}
    assert (rows["subject.posture"]["value"], rows["subject.posture"]["source"]) == ("standing", "metadata.json")
    assert rows["camera.warm_up_min"]["value"] == "20"
    assert rows["recording.distance"]["source"] == "measured"
    assert rows["preparation.drying"]["value"] is None
    for text in ("", "{", "[]", '{"schema": "thermofusion-metadata/2"}', '{"answers": []}', "[" * 100_000):
        (tmp_path / "metadata.json").write_text(text)
        with pytest.raises(ScanError):
            stated(scan)
