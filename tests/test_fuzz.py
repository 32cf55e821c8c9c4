"""Changed inputs through every reader (tests/fuzz): a sentence or a result, never a traceback, a hang, or gigabytes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

FUZZ = Path(__file__).resolve().parent / "fuzz"
SECONDS = float(os.environ.get("FUZZ_SECONDS", "30"))


def run(*options):
    command = [sys.executable, FUZZ / "run.py", *map(str, options)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
    return done.returncode, done.stdout


def test_what_was_found_stays_mended():
    code, text = run("--again", FUZZ / "finds")
    assert code == 0, text
    assert len(list((FUZZ / "finds").iterdir())) >= 20


def test_changed_inputs(tmp_path):
    """For `FUZZ_SECONDS` (30); a find lies in the test's folder and belongs into tests/fuzz/finds once it is mended."""
    code, text = run("--seconds", SECONDS, "--finds", tmp_path)
    assert code == 0, text
