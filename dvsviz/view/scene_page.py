"""The 3-D scene as one HTML page: map, trajectory, keyframes, truth, and the camera flying along it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from dvsviz.errors import DvsvizError
from dvsviz.view.scene import TabScene
from dvsviz.view.shown import ShownSession

# The camera is moved this often: 20 times a second is smooth, and 60 s are 1,200 poses.
_STEP_S = 0.05
_MOST_STEPS = 4000


def write_scene_page(
    shown: ShownSession, out: Path, progress: Callable[[float], None] = lambda share: None
) -> None:
    """Write the scene of a session; replaced where it exists.

    The page can be turned, and played: the camera moves as it did, at the recording's own pace.

    Args:
        shown: the session.
        out: the HTML file.
        progress: called with the share that is done, 0 to 1.

    Raises:
        DvsvizError: there are no windows, or the file cannot be written.
    """
    count = shown.window_count
    if count == 0:
        raise DvsvizError("has no windows", path=shown.session.path, hint="there is nothing to show")
    columns = shown.session.columns()
    t_s = (columns["start_us"][:count] - columns["start_us"][0]) * 1e-6
    end_s = float(columns["end_us"][count - 1] - columns["start_us"][0]) * 1e-6
    step_s = max(_STEP_S, end_s / _MOST_STEPS)
    moments = np.arange(0.0, end_s, step_s)
    windows = np.maximum(0, np.searchsorted(t_s, moments, side="right") - 1)
    scene = TabScene(go_to=lambda window: None)
    try:
        scene.open(shown)
        page = scene.as_page(shown, windows.tolist(), step_s, progress)
    finally:
        scene.stop()
    try:
        out.write_text(page, encoding="utf-8")
    except OSError as error:
        raise DvsvizError(f"cannot be written: {error.strerror}", path=out, hint="check the folder") from error
    progress(1.0)
