"""Compilation of the tracker's kernels before the clock starts."""

from __future__ import annotations

import functools
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.config import Mode, Motion, TrackerConfig
from dvsviz.events.events import Events
from dvsviz.events.windows import EventWindow, make_window
from dvsviz.geometry.camera import Camera
from dvsviz.tracking.constants import CONTRAST_EVENTS
from dvsviz.tracking.tracker import Tracker

# The most that are tracked until a refinement has come: mostly after six to eight.
_WINDOWS = 12
_WINDOW_EVENTS = 1000
_WINDOW_US = 30_000
# In eight windows a third of the image: enough for five keyframes and a refinement.
_SPEED_PX_PER_S = 160.0
# Small: only the kinds of the arrays matter.
_CAMERA = Camera(width=120, height=90, fx=100.0, fy=100.0, cx=59.5, cy=44.5)


def warm_up(config: TrackerConfig) -> float:
    """Run a throw-away tracker over a few windows of moving dots and return the seconds it took.

    Kernels are compiled once a machine and read from numba's cache afterwards; either way the time is not the
    tracker's, and is reported apart.

    Args:
        config: the motion to track, and the mode.
    """
    start = time.perf_counter()
    _run(config.motion, config.mode)
    return time.perf_counter() - start


@functools.cache
def _run(motion: Motion, mode: Mode) -> None:
    """Do it once a process: a live stream does not wait for a second time."""
    config = TrackerConfig(motion=motion, mode=mode)
    rng = np.random.default_rng(0)
    dots = rng.uniform((-_CAMERA.width, 0), (_CAMERA.width, _CAMERA.height), (150, 2))
    tracker = Tracker(_CAMERA, replace(config, window=_WINDOW_EVENTS))
    for index in range(_WINDOWS):
        tracker.step(_window(index, _WINDOW_EVENTS, dots, rng))
        if tracker.take_updates().refined:
            break
    # A large window is thinned before its contrast is maximised: strided arrays are another kind of array.
    Tracker(_CAMERA, config).step(_window(0, 2 * CONTRAST_EVENTS, dots, rng))


def _window(index: int, count: int, dots: NDArray[np.float64], rng: np.random.Generator) -> EventWindow:
    """Return a window of dots (N, 2), px, that move to the right."""
    t_us = index * _WINDOW_US + np.sort(rng.integers(0, _WINDOW_US, count))
    middle_px = dots[:, 0] + (index + 0.5) * _WINDOW_US * 1e-6 * _SPEED_PX_PER_S
    seen = dots[(middle_px > 0) & (middle_px < _CAMERA.width - 1)]
    p = seen[rng.integers(0, len(seen), count)]
    x = np.clip(np.round(p[:, 0] + t_us * 1e-6 * _SPEED_PX_PER_S), 0, _CAMERA.width - 1)
    events = Events(
        t_us=t_us,
        x_px=x.astype(np.uint16),
        y_px=np.minimum(np.round(p[:, 1]), _CAMERA.height - 1).astype(np.uint16),
        is_positive=rng.random(count) < 0.5,
    )
    return make_window(_CAMERA, events, index=index, first_event=index * count, end_us=(index + 1) * _WINDOW_US)
