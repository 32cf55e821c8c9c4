"""Shared fixtures: where local recordings lie, and the demo scan."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_data():
    """`shared_data("torso-dev")` is the folder of a local recording; the test is skipped where it is absent."""
    base = Path(os.environ.get("THERMOFUSION_SHARED", ROOT.parent / "shared")) / "data"

    def folder(name: str) -> Path:
        path = base / name
        if not path.exists():
            pytest.skip(f"the recording '{name}' is not on this machine (set THERMOFUSION_SHARED)")
        return path

    return folder
