"""dvsviz: planar event-camera tracking, and a browser dashboard to understand it.

The Python interface in a loop of five lines:

    recording = dvsviz.open_recording("r.h5")
    tracker = dvsviz.Tracker(recording.camera, dvsviz.TrackerConfig(motion="planar"))
    for window in dvsviz.windows(recording, lambda: tracker.window_size):
        result = tracker.step(window)
        print(result.status, result.T_world_camera)

`dvsviz.open_session` reads what `dvsviz track` wrote, `dvsviz.evaluate` compares it with the truth. The rooms of the
package are importable too; only the names below are the interface that does not change without notice.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dvsviz.config import TrackerConfig as TrackerConfig
    from dvsviz.evaluate.evaluate import evaluate as evaluate
    from dvsviz.events.windows import windows as windows
    from dvsviz.formats.open import open_recording as open_recording
    from dvsviz.session.store import open_session as open_session
    from dvsviz.tracking.tracker import Tracker as Tracker

__version__ = "0.1.0"

# Our systems have tens of unknowns: BLAS threads wait for each other longer than they compute (4 ms instead of 0.05 ms
# a call, beside one other process on two cores). It counts where numpy is not loaded yet; a user's own setting wins.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Loaded when first used: `import dvsviz` and `dvsviz --help` stay quick.
_HOMES = {
    "Tracker": "dvsviz.tracking.tracker",
    "TrackerConfig": "dvsviz.config",
    "evaluate": "dvsviz.evaluate.evaluate",
    "open_recording": "dvsviz.formats.open",
    "open_session": "dvsviz.session.store",
    "windows": "dvsviz.events.windows",
}

__all__ = ["Tracker", "TrackerConfig", "__version__", "evaluate", "open_recording", "open_session", "windows"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'dvsviz' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
