"""The demo: ten seconds of a wall with shapes, seen by a hand-held event camera; made once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dvsviz.simulate.simulate import simulate

SECONDS = 10.0


def demo_path(sessions_dir: Path) -> Path:
    """Return where the demo recording lies, beside the sessions but not among them."""
    return sessions_dir / "recordings" / "demo.h5"


def demo_recording(sessions_dir: Path, progress: Callable[[float], None] | None = None) -> Path:
    """Return the demo recording's path; it is simulated where it is not there yet.

    Args:
        sessions_dir: where sessions are kept.
        progress: called with the share (0 to 1) that is done.
    """
    path = demo_path(sessions_dir)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        simulate(path, scene="shapes", motion="handheld", seconds=SECONDS, seed=1, progress=progress)
    return path
