"""The wheel: carries the page, and works from any folder after an install."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# What the build reads; the environment, sessions and caches stay where they are.
PARTS = ["dvsviz", "static", "pyproject.toml", "README.md", "LICENSE"]


def run(*command: str, cwd: Path, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    # COLUMNS keeps the help from being wrapped to the width of whatever runs the tests.
    environment = {**os.environ, "COLUMNS": "120"} | ({"PYTHONPATH": str(path)} if path else {})
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("source")
    for part in PARTS:
        origin = ROOT / part
        if origin.is_dir():
            shutil.copytree(origin, source / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(origin, source / part)
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), ".", cwd=source)
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("site")
    run(
        *(sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--no-index", "--no-deps"),
        *("--target", str(target), str(wheel)),
        cwd=target,
    )
    return target


def test_wheel_holds_every_module_and_the_whole_page(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    modules = {str(p.relative_to(ROOT)) for p in (ROOT / "dvsviz").rglob("*.py")}
    page = {f"dvsviz/{p.relative_to(ROOT)}" for p in (ROOT / "static").rglob("*") if p.is_file()}
    assert "dvsviz/static/index.html" in page
    assert modules | page <= names
    foreign = {name for name in names if not name.startswith(("dvsviz/", "dvsviz-"))}
    assert not foreign


def test_wheel_says_what_it_is(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    fields = Parser().parsestr(archive.read(metadata).decode())
    assert fields["Name"] == "dvsviz"
    assert fields["License-Expression"] == "Apache-2.0"
    assert fields["Requires-Python"] == ">=3.11"
    (licence,) = (name for name in archive.namelist() if name.endswith("licenses/LICENSE"))
    assert archive.read(licence) == (ROOT / "LICENSE").read_bytes()
    (entry,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
    assert "dvsviz = dvsviz.cli:main" in archive.read(entry).decode()


def test_installed_command_works_from_another_folder(installed: Path, tmp_path: Path) -> None:
    where = run(sys.executable, "-c", "import dvsviz; print(dvsviz.__file__)", cwd=tmp_path, path=installed)
    assert Path(where.stdout.strip()).is_relative_to(installed)
    helped = run(sys.executable, "-m", "dvsviz", "--help", cwd=tmp_path, path=installed)
    for command in ("info", "simulate", "track", "evaluate", "export", "serve"):
        assert command in helped.stdout
