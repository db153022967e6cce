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
_MOST = np.int32(2)


def without_noise(window: EventWindow, width: int, height: int) -> tuple[EventWindow, float]:
    """Return a window without the events of lonely pixels, and how alike its neighbouring pixels are.

    A pixel is lonely whose eight neighbours together fire less than half as often as it does.

    Args:
        window: as recorded.
        width: sensor columns.
        height: sensor rows.

    Returns:
        The window of the events that are kept, of the same time; all events where few would be. And the correlation of
        the counts of neighbouring pixels: 0 for noise alone, at most 1.
    """
    events = window.events
    keep = np.empty(len(window), dtype=np.int64)
    # A kernel is compiled for one kind of array, whoever made it.
    x_px, y_px = events.x_px.view(), events.y_px.view()
    x_px.flags.writeable = y_px.flags.writeable = False
    kept, alike = find_company(x_px, y_px, width, height, c.NOISE_COMPANY, keep)
    if kept < c.NOISE_HEARD or kept == len(window):
        return window, alike
    keep = keep[:kept]
    bearings = np.ascontiguousarray(window.bearings).reshape(-1).view(np.int64).take(keep)
    return (
        replace(
            window,
            events=Events(
                t_us=events.t_us.take(keep),
                x_px=events.x_px.take(keep),
                y_px=events.y_px.take(keep),
                is_positive=events.is_positive.take(keep),
            ),
            # x and y of a bearing are taken as one number of 8 bytes: a third of the time.
            bearings=bearings.view(np.float32).reshape(-1, 2),
        ),
        alike,
    )


@numba.njit(cache=True, nogil=True)
def find_company(
    x_px: NDArray[np.uint16],
    y_px: NDArray[np.uint16],
    width: int,
    height: int,
    least: float,
    keep: NDArray[np.int64],
) -> tuple[int, float]:
    """Write which events have company; return how many, and the correlation of neighbouring pixels' counts.

    Args:
        x_px: columns (N,).
        y_px: rows (N,).
        width: sensor columns.
        height: sensor rows.
        least: events of the eight neighbours that an event needs, by those of its own pixel.
        keep: numbers of the events that are kept (N,), written.
    """
    # A margin of one pixel saves the tests for the border.
    counts = np.zeros((height + 2, width + 2), dtype=np.int32)
    for i in range(x_px.shape[0]):
        counts[np.int64(y_px[i]) + 1, np.int64(x_px[i]) + 1] += 1
    # Sums of three in a row, then of three rows: each is read once.
    three = np.zeros((height + 2, width + 2), dtype=np.int32)
    total = squares = pairs = 0
    for r in range(1, height + 1):
        row, into = counts[r], three[r]
        for q in range(1, width + 1):
            into[q] = row[q - 1] + row[q] + row[q + 1]
    for r in range(1, height):
        row, below = counts[r], counts[r + 1]
        row_total = row_squares = row_pairs = np.int32(0)
        for q in range(1, width):
            a = min(row[q], _MOST)
            row_total += a
            row_squares += a * a
            row_pairs += a * (min(row[q + 1], _MOST) + min(below[q], _MOST))
        total += row_total
        squares += row_squares
        pairs += row_pairs
    kept = 0
    for i in range(x_px.shape[0]):
        q, r = np.int64(x_px[i]) + 1, np.int64(y_px[i]) + 1
        own = counts[r, q]
        around = three[r - 1, q] + three[r, q] + three[r + 1, q] - own
        keep[kept] = i
        kept += around > 0 and around >= least * own
    n = max(1, (height - 1) * (width - 1))
    mean = total / n
    variance = squares / n - mean * mean
    return kept, (0.5 * pairs / n - mean * mean) / variance if variance > 0.0 else 1.0
