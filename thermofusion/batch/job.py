"""One scan of a batch: everything a worker does, and the row of the table that comes of it."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from ..errors import BusyError, QualityError, ScanError, exit_of, visible
from ..files.json import plain, to_json
from ..files.reading import read_json
from ..progress import Progress, silent
from ..recipe import load_recipe
from ..version import __version__
from .scans import Source
from .store import Mirror, Store, at_hand, is_address, put, scratch

ROWS = ".batch"  # sub-folder of a batch that remembers each scan's row
GOOD, BELOW, FAILED, WAITING = "good", "below gate", "failed", "not done"
DONE = (GOOD, BELOW)
WAITS, WAIT_S = 12, 5.0  # for a folder that another worker writes into


@dataclass(frozen=True)
class Job:
    """A scan to be fused. recipe : its tree. out : the batch's folder or address. threads : for this worker."""

    source: Source
    recipe: dict[str, Any]
    out: str
    threads: int = 1

    @property
    def inputs(self) -> str:
        """Hash of all that the result depends on: files, recipe, edition of the code."""
        from ..pipeline import STAGES

        code = [__version__, *((s.name, s.edition) for s in STAGES)]
        return sha256(json.dumps([self.source.content, self.recipe, code], sort_keys=True).encode()).hexdigest()[:24]

    @property
    def folder(self) -> str:
        """Of its result."""
        return f"{self.out.rstrip('/')}/{self.source.name}"


@dataclass(frozen=True)
class Row:
    """What became of a scan.

    status : good, below gate (written and marked), failed, not done. exit_code : of a single run. reason : why it is
    not good. wall_s, peak_GiB : of its last attempt, the latter of the worker so far. reused : nothing was computed.
    figures : quality figures by name, with units (docs/batch.md).
    """

    name: str
    place: str
    status: str = WAITING
    exit_code: int | None = None
    reason: str = ""
    attempts: int = 0
    reused: bool = False
    wall_s: float = 0.0
    peak_GiB: float = 0.0
    figures: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, source: Source) -> Row:
        """Of a scan that nobody has looked at."""
        return cls(visible(source.name), visible(source.place))


Work = Callable[[Job], Row]


def fuse_one(job: Job) -> Row:
    """Fuse a scan, whatever happens: a row comes back, and is remembered beside the result. Ctrl-C alone passes."""
    start, row = time.monotonic(), Row.of(job.source)
    _bound_threads(job.threads)
    try:
        report, reused = _fused(job)
        failed = report["quality"]["failed"]
        row = replace(row, status=BELOW if failed else GOOD, exit_code=QualityError.exit_code if failed else 0)
        row = replace(row, reason="; ".join(failed), reused=reused, figures=figures_of(report))
    except Exception as e:
        code, sentence = exit_of(e)
        if is_address(job.source.place):  # named by where it is, not by its copy
            sentence = sentence.replace(str(scratch(job.source.place)), visible(job.source.place.rpartition("/")[0]))
        row = replace(row, status=FAILED, exit_code=code, reason=sentence)
    row = replace(row, attempts=1, wall_s=round(time.monotonic() - start, 2), peak_GiB=_peak_GiB())
    try:
        remember(job, row)
    except Exception as e:  # a full disk
        row = row if row.status == FAILED else replace(row, status=FAILED, exit_code=5, reason=exit_of(e)[1])
    return row


def _fused(job: Job) -> tuple[dict[str, Any], bool]:
    """The report of the scan's result, and whether it was there already."""
    from ..pipeline import finished, fuse
    from ..scans import open_scan

    recipe = load_recipe(job.recipe)
    with at_hand(job.source.place) as path:
        scan = open_scan(path)
        with _result_folder(job) as (folder, told):
            report = finished(scan, recipe, folder)
            if report is not None:
                return report, True
            for waits in range(WAITS + 1):
                try:
                    return fuse(scan, recipe, out=folder, progress=told).report, False
                except BusyError:  # a worker that its scheduler lost has not ended yet
                    if waits == WAITS:
                        raise
                time.sleep(WAIT_S)
    raise AssertionError("not reached")


@contextmanager
def _result_folder(job: Job) -> Iterator[tuple[Path, Progress]]:
    """The result's folder on this machine, and who is told of progress: behind an address, what is new is sent."""
    if not is_address(job.folder):
        yield Path(job.folder), silent
        return
    from ..results.folder import REPORT
    from ..results.stages import WORK

    folder = scratch(job.folder) / Path(job.source.name).name
    mirror = Mirror(Store(job.folder), folder)

    def told(stage: str, done: int, total: int) -> None:
        if done == total:
            mirror.send(below=f"{WORK}/")

    yield folder, told
    mirror.send(last=REPORT)
    shutil.rmtree(scratch(job.folder), ignore_errors=True)


def figures_of(report: Mapping[str, Any]) -> dict[str, Any]:
    """The quality figures of a `result.json`, one number or word each."""
    t, rig, motion = (report.get(k) or {} for k in ("temperature", "rig", "motion"))
    quality, levels = report.get("quality") or {}, t.get("level_sigma_K") or {}
    degC = t.get("percentiles_degC") or {}
    known = [s for s in levels.values() if s is not None]
    frames = (report.get("scan") or {}).get("frames") or {}
    found = {
        "depth_frames": frames.get("depth"),
        "thermal_frames": (report.get("mapping") or {}).get("used"),
        "tracked_fraction": quality.get("tracked_fraction"),
        "vertices": (report.get("surface") or {}).get("vertices"),
        "voxel_mm": (report.get("surface") or {}).get("voxel_mm"),
        "outline_residual_px": rig.get("residual_px_after"),
        "coverage": quality.get("coverage"),
        "median_degC": degC.get("50"),
        "p1_degC": degC.get("1"),
        "p99_degC": degC.get("99"),
        "median_sigma_K": quality.get("median_sigma_K"),
        "anchored": t.get("anchored"),
        "level_sigma_K": sum(s * s for s in known) ** 0.5 if t.get("anchored") and known else None,
        "moved_p95_mm": motion.get("p95_mm"),
        "diagnoses": len(report.get("diagnosis") or ()),
        "diagnosis": "; ".join(d["what"] for d in report.get("diagnosis") or ()),
        "run": report.get("run"),
    }
    return {k: v for k, v in plain(found).items() if v is not None}


# ---------------------------------------------------------------- what is remembered of a scan


def remember(job: Job, row: Row) -> None:
    """Store a scan's row with the hash of its inputs. Raises ResourceError."""
    text = to_json({"software": f"thermofusion {__version__}", "inputs": job.inputs, "row": asdict(row)})
    put(job.out, _row_name(job), text, whatever=True)


def remembered(job: Job) -> Row | None:
    """The row of a finished result that came of the same inputs and still stands; else None."""
    from ..results.claim import REPORT, complete

    if is_address(job.out):
        store = Store(job.out)
        text = store.read(_row_name(job)) or b""
        there = bool(text) and store.read(f"{job.source.name}/{REPORT}") is not None
    else:
        there = complete(Path(job.folder))
    if not there:
        return None
    try:
        known = json.loads(text) if is_address(job.out) else read_json(Path(job.out) / _row_name(job))
        row = Row(**{f.name: known["row"][f.name] for f in fields(Row)})
    except (ScanError, ValueError, KeyError, TypeError):
        return None
    return replace(row, reused=True) if known.get("inputs") == job.inputs and row.status in DONE else None


def _row_name(job: Job) -> str:
    return f"{ROWS}/{job.source.name}.json"


# ---------------------------------------------------------------- the worker's machine


def _bound_threads(threads: int) -> None:
    """OpenCV's own; what OpenMP and BLAS take is fixed before they are loaded."""
    import cv2

    if cv2.getNumThreads() != threads:
        cv2.setNumThreads(threads)


def _peak_GiB() -> float:
    """Largest memory of this process so far; 0 where the system does not say."""
    try:
        import resource
    except ImportError:
        return 0.0
    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30, 2)
