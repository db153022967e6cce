"""The numbered examples run, in their order, as a reader would run them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("[0-9][0-9]_*.py"))
SAID = {
    "00_make_a_recording": "wrote example.h5",
    "01_track_a_file": "tracking",
    "02_session": "keyframes were made of windows [0",
    "03_evaluate": "position (ATE, RMSE)",
    "04_registration_study": "kabsch-weighted",
    "05_events_and_frames": "events ",
}
# What takes long has a short version.
OPTIONS = {
    "04_registration_study": ["--quick", "--methods", "none", "essential", "kabsch-weighted", "pnp-iterative"],
    "05_events_and_frames": ["--motion", "handheld", "--seconds", "0.4", "--skips", "3"],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which all of them run: later ones read what earlier ones wrote."""
    return tmp_path_factory.mktemp("examples")


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example: Path, folder: Path) -> None:
    told = subprocess.run(
        [sys.executable, "-W", "error", str(example), *OPTIONS.get(example.stem, [])],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(example.parents[1])},
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert told.returncode == 0, told.stderr
    assert SAID[example.stem] in told.stdout


def test_every_numbered_example_is_checked() -> None:
    assert {path.stem for path in EXAMPLES} == set(SAID)
