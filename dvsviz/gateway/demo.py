"""The demo: ten seconds of a wall with shapes, seen by a hand-held event camera; made once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

SECONDS = 10.0


def demo_path(sessions_dir: Path) -> Path:
    """Return where the demo recording lies, beside the sessions but not among them."""
    return sessions_dir / "recordings" / "demo.h5"


def demo_recording(path: Path, progress: Callable[[float], None] | None = None) -> None:
    """Simulate the demo recording where it is not there yet.

    Args:
        path: where it lies.
        progress: called with the share (0 to 1) that is done.
    """
    if path.exists():
        return
    # Its kernels take seconds to import: not before they are needed.
    from dvsviz.simulate.simulate import simulate

    path.parent.mkdir(parents=True, exist_ok=True)
    simulate(path, scene="shapes", motion="handheld", seconds=SECONDS, seed=1, progress=progress)
