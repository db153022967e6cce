"""Noise: which events of a window have company, and whether the window shows anything but noise.

An edge that moves fires pixels side by side, one after the other. Noise and hot pixels fire alone.
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.events.events import Events
from dvsviz.events.windows import EventWindow
from dvsviz.tracking import constants as c

# Events of a pixel that count when it is compared with the one beside it: a hot pixel counts no more than an edge.
_MOST = 2


def without_noise(window: EventWindow, width: int, height: int) -> tuple[EventWindow, float]:
    """Return a window without the events of lonely pixels, and how alike its neighbouring pixels are.

    A pixel is lonely whose eight neighbours together fire less than half as often as it does.

    Args:
        window: as recorded.
        width: sensor columns.
        height: sensor rows.

    Returns:
        The window of the events that are kept, of the same time; all events where none would be. And the correlation of
        the counts of neighbouring pixels: 0 for noise alone, at most 1.
    """
    keep = np.empty(len(window), dtype=np.bool_)
    # A margin of one pixel saves the tests for the border.
    counts = np.zeros((height + 2, width + 2), dtype=np.int32)
    # A kernel is compiled for one kind of array, whoever made it.
    x_px, y_px = window.events.x_px.view(), window.events.y_px.view()
    x_px.flags.writeable = y_px.flags.writeable = False
    kept, alike = find_company(x_px, y_px, counts, c.NOISE_COMPANY, keep)
    if kept in (0, len(window)):
        return window, alike
    events = window.events
    return (
        replace(
            window,
            events=Events(
                t_us=events.t_us[keep],
                x_px=events.x_px[keep],
                y_px=events.y_px[keep],
                is_positive=events.is_positive[keep],
            ),
            bearings=window.bearings[keep],
        ),
        alike,
    )


@numba.njit(cache=True, nogil=True)
def find_company(
    x_px: NDArray[np.uint16],
    y_px: NDArray[np.uint16],
    counts: NDArray[np.int32],
    least: float,
    keep: NDArray[np.bool_],
) -> tuple[int, float]:
    """Write which events (N,) have company; return how many, and the correlation of neighbouring pixels' counts.

    Args:
        x_px: columns (N,).
        y_px: rows (N,).
        counts: zeros (height + 2, width + 2), filled with the events a pixel.
        least: events of the eight neighbours that an event needs, by those of its own pixel.
        keep: (N,), written.
    """
    for i in range(x_px.shape[0]):
        counts[np.int64(y_px[i]) + 1, np.int64(x_px[i]) + 1] += 1
    kept = 0
    for i in range(x_px.shape[0]):
        q, r = np.int64(x_px[i]), np.int64(y_px[i])
        own = counts[r + 1, q + 1]
        around = -own
        for dr in range(3):
            for dq in range(3):
                around += counts[r + dr, q + dq]
        keep[i] = around > 0 and around >= least * own
        kept += keep[i]
    rows, cols = counts.shape[0] - 2, counts.shape[1] - 2
    total = squares = pairs = 0
    for r in range(1, rows):
        for q in range(1, cols):
            a = min(counts[r, q], _MOST)
            total += a
            squares += a * a
            pairs += a * (min(counts[r, q + 1], _MOST) + min(counts[r + 1, q], _MOST))
    n = max(1, (rows - 1) * (cols - 1))
    mean = total / n
    variance = squares / n - mean * mean
    return kept, (0.5 * pairs / n - mean * mean) / variance if variance > 0.0 else 1.0
