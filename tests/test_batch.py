"""Many scans: found, fused by workers that die, taken up again, gathered on one page."""

from __future__ import annotations

import base64
import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest

from thermofusion.batch import job as batch_job
from thermofusion.batch.batch import Crew, exit_code, place_for, run_batch
from thermofusion.batch.job import Job, Row, fuse_one, remembered
from thermofusion.batch.pool import TRIES, in_processes
from thermofusion.batch.scans import Source, find_scans
from thermofusion.batch.table import csv_of, page_of
from thermofusion.errors import RecipeError, ScanError
from thermofusion.files.json import to_json
from thermofusion.phantom import load_scene, simulate
from thermofusion.recipe import load_recipe
from thermofusion.scans import open_scan
from thermofusion.types import Scan

BASE = ["surface.voxel_mm=10", "output.views=false", 'output.formats=["ply"]', "output.report=false"]
BASE += ["temperature.crosscal.max_vertices=1000", "temperature.crosscal.vignetting=false", "quality.min_coverage=0"]
BASE += ["tracking.fragment_frames=3"]
LOCAL = Crew(2, 1)


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """Two small scans, one in a folder of a ward, and one that is torn."""
    scene, folder = load_scene("sphere"), tmp_path_factory.mktemp("scans")
    walk, depth = replace(scene.walk, depth_frames=12, depth_hz=3.0), replace(scene.depth, scale=0.25)
    thermal = replace(scene.thermal, scale=0.25, every=1)
    scene = replace(scene, walk=walk, depth=depth, thermal=thermal, color=None)
    for seed, name in enumerate(("p1", "ward/p2")):
        simulate(scene, folder / name, seed=seed)
        shutil.rmtree(folder / name / "truth", ignore_errors=True)
    shutil.copytree(folder / "p1", folder / "torn")
    (folder / "torn" / "frames.csv").unlink()
    return folder


@pytest.fixture(scope="module")
def recipe():
    return load_recipe({}, BASE)


@pytest.fixture(scope="module")
def alone(scans, recipe, tmp_path_factory):
    """What single runs make of the scans: name -> files."""
    out, known = tmp_path_factory.mktemp("alone"), {}
    (out / "r.toml").write_text(recipe.to_toml())
    for name in ("p1", "ward/p2"):
        command = ["run", str(scans / name), "-r", str(out / "r.toml"), "-o", str(out / name)]
        done = subprocess.run([sys.executable, "-m", "thermofusion", *command], check=True, capture_output=True)
        assert b"Traceback" not in done.stderr
        known[name] = files(out / name)
    return known


def files(folder):
    """What a result says, without which stages were taken from where."""
    report = json.loads((folder / "result.json").read_text())
    report.pop("stages_reused")
    return (folder / "mesh.ply").read_bytes(), (folder / "trajectory.txt").read_bytes(), report


def jobs_of(scans, recipe, out):
    tree = recipe.model_dump(mode="json", exclude_none=True)
    return [Job(s, tree, str(out)) for s in find_scans(str(scans), str(out))]


# ---------------------------------------------------------------- finding


def test_scans_are_found_once_and_results_are_none(scans, tmp_path):
    found = find_scans(str(scans), str(tmp_path))
    assert [s.name for s in found] == ["p1", "torn", "ward/p2"]
    folder = tmp_path / "all"
    shutil.copytree(scans / "p1", folder / "p1")
    (folder / "p1" / "loop").symlink_to(folder)
    (folder / "again").symlink_to(folder / "p1")  # the same scan by another name
    shutil.copytree(scans / "p1", folder / "out" / "p9")
    (folder / ".trash").mkdir()
    shutil.copytree(scans / "p1", folder / ".trash" / "p8")
    for name in ("p1.mcap", "p1.r3d"):  # an empty file is no recording
        (folder / name).touch()
    before = find_scans(str(folder), str(folder / "out"))
    assert len(before) == 2
    assert [s.name for s in before] == ["p1", "p1.mcap"]  # two of one name keep their suffix
    os.utime(Path(before[0].place) / "frames.csv", (1, 1))
    assert find_scans(str(folder), str(folder / "out"))[0].content != before[0].content
    with pytest.raises(ScanError, match="no scan is here"):
        find_scans(str(tmp_path / "all" / ".trash" / "p8" / "depth"), "out")
    with pytest.raises(ScanError, match="no such folder"):
        find_scans(str(tmp_path / "nowhere"), "out")
    with pytest.raises(RecipeError, match="one folder"):
        place_for(str(folder) + "/", str(folder))


def test_no_two_scans_share_a_folder_and_none_lies_in_another_s(scans, tmp_path):
    for name in ("s.bag", "s.mkv", "s.bag.mkv", "t.bag", "u.bag", "U.mkv"):
        (tmp_path / name).write_bytes(b"#ROSBAG V2.0" if name.endswith("bag") else b"\x1a\x45\xdf\xa3")
    for name in ("t/inside", "batch.json"):
        shutil.copytree(scans / "p1", tmp_path / name)
    found = find_scans(str(tmp_path), str(tmp_path / "out"))
    names = [s.name for s in found]
    assert len(names) == 8
    assert {"t.bag", "t/inside", "u.bag", "U.mkv", "s.mkv", "batch.json-2"} < set(names)  # the page keeps its names
    assert len({name.casefold() for name in names}) == len(names)
    assert not {parent for name in names for parent in map(str, Path(name).parents)} & set(names)
    assert found == find_scans(str(tmp_path), str(tmp_path / "out"))


def test_images_on_another_disk_count_and_folders_that_cannot_be_read_are_told(scans, tmp_path, monkeypatch):
    (tmp_path / "all").mkdir()
    shutil.copytree(scans / "p1", tmp_path / "all" / "p1")
    (tmp_path / "all" / "p1" / "depth").rename(tmp_path / "disk")
    (tmp_path / "all" / "p1" / "depth").symlink_to(tmp_path / "disk")
    (before,) = find_scans(str(tmp_path / "all"), "out")
    os.utime(next((tmp_path / "disk").iterdir()), (1, 1))
    assert find_scans(str(tmp_path / "all"), "out")[0].content != before.content
    (tmp_path / "all" / "locked").mkdir()
    inside = Path.iterdir

    def refused(folder):
        if folder.name == "locked":
            raise PermissionError(13, "Permission denied")
        return inside(folder)

    monkeypatch.setattr(Path, "iterdir", refused)
    locked = find_scans(str(tmp_path / "all"), "out")[0]
    assert locked.name == "locked"
    row = fuse_one(Job(locked, {}, str(tmp_path / "out")))
    assert row.status == "failed"
    assert row.exit_code == 3


# ---------------------------------------------------------------- workers


def test_one_bad_scan_stops_nothing_and_finished_ones_are_left_alone(scans, recipe, alone, tmp_path):
    sources = find_scans(str(scans), str(tmp_path))
    rows = run_batch(sources, recipe, str(tmp_path), LOCAL)
    assert [(r.name, r.status, r.exit_code, r.reused) for r in rows] == [
        ("p1", "good", 0, False), ("torn", "failed", 3, False), ("ward/p2", "good", 0, False)]  # fmt: skip
    assert exit_code(rows) == 6
    assert "frames.csv" in rows[1].reason
    for name, expected in alone.items():
        assert files(tmp_path / name) == expected
    table = list(csv.DictReader((tmp_path / "batch.csv").read_text().splitlines()))
    known = json.loads((tmp_path / "batch.json").read_text())
    report = alone["p1"][2]
    assert float(table[0]["median_sigma_K"]) == report["quality"]["median_sigma_K"]
    assert known["scans"][0]["figures"]["coverage"] == report["temperature"]["coverage"]
    assert known["counts"] == {"good": 2, "failed": 1}
    stamps = {p: p.stat().st_mtime_ns for name in alone for p in (tmp_path / name).rglob("*")}
    shutil.rmtree(tmp_path / ".batch" / "ward")  # as if `run` had made it: told by its own key
    again = run_batch(sources, recipe, str(tmp_path), LOCAL)
    assert [r.reused for r in again] == [True, False, True]
    assert {p: p.stat().st_mtime_ns for name in alone for p in (tmp_path / name).rglob("*")} == stamps
    changed = load_recipe({}, [*BASE, "output.formats=[]"])
    assert remembered(jobs_of(scans, recipe, tmp_path)[0]) is not None
    assert remembered(jobs_of(scans, changed, tmp_path)[0]) is None
    (tmp_path / "p1" / "mesh.ply").unlink()  # a result that lost a file is made whole
    assert remembered(jobs_of(scans, recipe, tmp_path)[0]) is None


def dies_once(job):
    """Killed when the surface stands, the first time."""
    mark = Path(job.out).parent / f"died.{job.source.name.replace('/', '.')}"

    def told(stage, done, total):
        if (stage, done) == ("rig", 0) and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)

    batch_job.silent = told
    return fuse_one(job)


def dies_always(job):
    """Killed at one scan, however often it is begun."""
    if job.source.name == "p1":
        os.kill(os.getpid(), signal.SIGKILL)
    return replace(Row.of(job.source), status="good", exit_code=0)


def test_a_killed_worker_costs_the_current_stage(scans, recipe, alone, tmp_path):
    out = tmp_path / "out"
    rows = run_batch(find_scans(str(scans), str(out)), recipe, str(out), LOCAL, work=dies_once)
    assert [(r.status, r.attempts) for r in rows] == [("good", 2), ("failed", 1), ("good", 2)]
    for name, expected in alone.items():
        assert files(out / name) == expected
        reused = json.loads((out / name / "result.json").read_text())["stages_reused"]
        assert reused == ["tracking", "surface"]


def test_workers_that_always_die_are_replaced_a_bounded_number_of_times(scans, recipe, tmp_path):
    rows = {job.source.name: row for job, row in in_processes(
        dies_always, jobs_of(scans, recipe, tmp_path), workers=1, threads=1)}  # fmt: skip
    assert rows["p1"].status == "failed"
    assert (rows["p1"].attempts, rows["p1"].exit_code) == (TRIES, 5)
    assert "SIGKILL" in rows["p1"].reason
    assert rows["torn"].status == rows["ward/p2"].status == "good"


def test_interrupted_it_leaves_a_summary_and_no_workers(scans, tmp_path):
    many = tmp_path / "many"
    for k in range(12):
        shutil.copytree(scans / "p1", many / f"{k:02d}")
    recipe, out = tmp_path / "r.toml", tmp_path / "out"
    recipe.write_text(load_recipe({}, BASE).to_toml())
    command = [sys.executable, "-m", "thermofusion", "batch", str(many), "-r", str(recipe), "-o", str(out)]
    process = subprocess.Popen([*command, "--workers", "1"], stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("1/12"):
            break
    os.killpg(process.pid, signal.SIGINT)  # as the terminal does
    rest = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=20) == 130
    assert "Traceback" not in rest
    rows = json.loads((out / "batch.json").read_text())["scans"]
    good = [r["name"] for r in rows if r["status"] == "good"]
    assert good
    assert {r["status"] for r in rows} == {"good", "not done"}
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            break
        time.sleep(0.05)
    else:
        pytest.fail("workers are left")


def sleeps(job):
    """A scan that takes a moment; one kills its worker always."""
    if job.source.name == "s3":
        os._exit(9)
    time.sleep(0.01)
    return replace(Row.of(job.source), status="good", exit_code=0)


def test_dask_does_the_same(tmp_path, monkeypatch):
    dask = pytest.importorskip("dask")
    pytest.importorskip("distributed")
    from thermofusion.batch.cluster import in_cluster

    sources = [Source(f"s{k}", f"/nowhere/s{k}", "") for k in range(40)]
    jobs = [Job(s, {}, str(tmp_path)) for s in sources]
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        rows = {job.source.name: row for job, row in in_cluster(sleeps, jobs, "local", workers=2, threads=1)}
    assert len(rows) == 40
    assert [n for n, r in rows.items() if r.status != "good"] == ["s3"]
    assert rows["s3"].exit_code == 5
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(RecipeError, match="Dask, which is not installed"):
        next(in_cluster(sleeps, jobs, "local", workers=1, threads=1))


# ---------------------------------------------------------------- addresses


def test_scans_and_results_behind_addresses(scans, recipe, alone, tmp_path, monkeypatch):
    fsspec = pytest.importorskip("fsspec")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    memory = fsspec.filesystem("memory")
    memory.store.clear()
    memory.put(f"{scans}/", "memory://lab/", recursive=True)
    sources = find_scans("memory://lab", "memory://results")
    assert [s.name for s in sources] == ["p1", "torn", "ward/p2"]
    job = Job(sources[0], recipe.model_dump(mode="json", exclude_none=True), "memory://results")

    def killed(stage, done, total):
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:  # torn away before the temperature stage
        broken.setattr("thermofusion.temperature.solve.solve", lambda *_, **__: killed("", 0, 1))
        with pytest.raises(KeyboardInterrupt):
            fuse_one(job)
    assert memory.exists("/results/p1/stages/mapping.npz")
    assert not memory.exists("/results/p1/result.json")
    row = fuse_one(job)
    assert (row.status, row.exit_code) == ("good", 0)
    memory.get("/results/p1/", str(tmp_path / "back"), recursive=True)
    known = json.loads((tmp_path / "back" / "result.json").read_text())
    assert known["stages_reused"] == ["tracking", "surface", "rig", "mapping"]
    path = (tmp_path / "back" / "trajectory.txt").read_text().splitlines()
    assert path[2:] == alone["p1"][1].decode().splitlines()[2:]
    # the run's id differs; so may last bits of temperatures, for BLAS has more threads here than in a worker
    assert len((tmp_path / "back" / "mesh.ply").read_bytes()) == len(alone["p1"][0])
    again = remembered(job)
    assert again is not None
    assert again.reused
    torn = fuse_one(replace(job, source=sources[1]))
    assert (torn.exit_code, torn.reason[:18]) == (3, "memory://lab/torn:")
    memory.pipe_file("/lab/p1/scan.json", memory.cat_file("/lab/p1/scan.json") + b" ")
    changed = find_scans("memory://lab", "memory://results")[0]
    assert remembered(replace(job, source=changed)) is None
    assert not list(tmp_path.glob("thermofusion-batch-*/*"))  # copies are gone
    with pytest.raises(RecipeError, match="cannot be used"):
        find_scans("nothing-known://lab", "out")


# ---------------------------------------------------------------- the page


def test_nothing_that_a_person_wrote_becomes_a_script_or_a_formula():
    name = "\"><script>alert(1)</script>/=cmd|' /C calc'!A0"
    rows = [Row.of(Source(name, "/x", "")), Row("=1+1", "/y", "failed", 3, "<img src=x onerror=alert(1)>, \u202egnp")]
    rows += [Row("p1", "/z", "good", 0, figures={"median_degC": 33.123, "coverage": 0.5})]
    page = page_of(rows, "<b>torso")
    code = page.rpartition("<script>")[2].partition("</script>")[0]
    assert page.count("<script>") == 1
    assert "<img" not in page
    assert "<b>torso" not in page
    assert f"script-src 'sha256-{base64.b64encode(sha256(code.encode()).digest()).decode()}'" in page
    assert '<a href="p1/report.html">' in page
    assert re.search(r'data-value="33.123">33.12<', page)
    cells = list(csv.reader(csv_of(rows).splitlines()))
    assert all(len(line) == len(cells[0]) for line in cells)
    assert cells[2][0] == "'=1+1"
    assert to_json(rows)


def test_a_scan_keeps_its_stages_when_it_is_moved(scans, tmp_path):
    from thermofusion.results.stages import fingerprint

    shutil.copytree(scans / "p1", tmp_path / "elsewhere")
    here, there = open_scan(scans / "p1"), open_scan(tmp_path / "elsewhere")
    assert isinstance(here, Scan)
    assert fingerprint(here) == fingerprint(there)
