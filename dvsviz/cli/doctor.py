"""`dvsviz doctor`: what is found on this machine, and what would go wrong."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from dvsviz import __version__
from dvsviz.cli.arguments import Doctor
from dvsviz.cli.console import print_fields, print_json, sessions_folder

_PACKAGES = ("numpy", "scipy", "numba", "h5py", "opencv-python-headless", "viser", "rerun-sdk", "starlette", "tyro")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox")
_FEW_BYTES = 1 << 30


def doctor(command: Doctor) -> int:
    """Print what was found; the exit code is 0 even where something is missing, since nothing was asked for yet."""
    found = examine()
    if command.json:
        print_json(found)
        return 0
    packages: dict[str, str] = found["packages"]
    print_fields(
        {
            "dvsviz": found["dvsviz"],
            "python": f"{found['python']} on {found['system']}",
            "packages": ", ".join(f"{name} {version}" for name, version in packages.items()),
            "processors": f"{found['processors']}, {found['threads']} threads for kernels",
            "browser": found["browser"] or "none found on the PATH",
            "cache": found["cache"],
            "sessions": f"{found['sessions']}, {found['free_bytes'] / 1e9:.1f} GB free",
        }
    )
    for problem in found["problems"]:
        print(f"problem: {problem}")
    return 0


def examine() -> dict[str, Any]:
    """Return what is found on this machine as the object of `dvsviz doctor --json`."""
    import numba

    from dvsviz.formats.cache import cache_folder

    problems: list[str] = []
    packages = {name: _version(name, problems) for name in _PACKAGES}
    folder = sessions_folder().absolute()
    there = _existing(folder)
    free = shutil.disk_usage(there).free
    if not os.access(there, os.W_OK):
        problems.append(f"{there} cannot be written: sessions go there; set DVSVIZ_SESSIONS or use --out")
    if free < _FEW_BYTES:
        problems.append(f"only {free / 1e6:.0f} MB are free in {there}")
    cache = cache_folder().absolute()
    if not os.access(_existing(cache), os.W_OK):
        problems.append(f"{cache} cannot be written: foreign recordings are converted there; set DVSVIZ_CACHE")
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    return {
        "dvsviz": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "executable": sys.executable,
        "packages": packages,
        "processors": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": numba.get_num_threads(),
        "browser": browser,
        "cache": str(cache),
        "sessions": str(folder),
        "free_bytes": free,
        "problems": problems,
    }


def _version(name: str, problems: list[str]) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        problems.append(f"the package {name} is missing: install dvsviz again")
        return None


def _existing(folder: Path) -> Path:
    """Return the folder, or the first of its parents that is there."""
    return next((path for path in (folder, *folder.parents) if path.exists()), Path.cwd())
