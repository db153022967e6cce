"""Numba kernels of the planar map: votes, exposure, edge image, density."""

from __future__ import annotations

import numba
import numpy as np

from dvsviz.contrast.kernels import is_inside, splat
from dvsviz.tracking.kernels import adjugate


@numba.njit(cache=True, nogil=True)
def frozen_vote(points, px_per_unit, origin, votes, exposure, block, limit, weight):
    """Vote plane points (N, 2) bilinearly into `votes` where the block was swept by less than `limit` px.

    Returns:
        The box of cells that were written: first row, first column, end row, end column; empty where there are none.
    """
    rows, cols = votes.shape
    r0, c0, r1, c1 = rows, cols, 0, 0
    for i in range(points.shape[0]):
        x, y = (points[i, 0] - origin[0]) * px_per_unit, (points[i, 1] - origin[1]) * px_per_unit
        if is_inside(x, y, rows, cols) and exposure[int(y) // block, int(x) // block] <= limit:
            splat(votes, x, y, weight)
            r0, c0 = min(r0, int(y)), min(c0, int(x))
            r1, c1 = max(r1, int(y) + 2), max(c1, int(x) + 2)
    return r0, c0, r1, c1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_exposure(exposure, start, end, K, height, width, block, limit):
    """Add to each block the image displacement (px) between two views, where the block is in view.

    Args:
        exposure: (rows, columns) blocks, added to in place.
        start: homography (3, 3) from bearings in the first view to cells.
        end: the same of the second view.
        K: calibration (3, 3).
        height: sensor rows.
        width: sensor columns.
        block: cells a block.
        limit: a block swept by more, px, is frozen: neither votes nor exposure are added.

    Returns:
        The box of blocks in view: first row, first column, end row, end column; empty where there is none.
    """
    rows, cols = exposure.shape
    r0, c0, r1, c1 = rows, cols, 0, 0
    # Bounding box of the footprint: the sensor's corners in cells.
    to_start, to_end = adjugate(start), adjugate(end)
    lo_x, lo_y, hi_x, hi_y = 1e9, 1e9, -1e9, -1e9
    for cy in (0.0, float(height)):
        for cx in (0.0, float(width)):
            bx, by = (cx - K[0, 2]) / K[0, 0], (cy - K[1, 2]) / K[1, 1]
            z = start[2, 0] * bx + start[2, 1] * by + start[2, 2]
            sign = 1.0 if start[2, 2] > 0 else -1.0
            if z * sign <= 1e-9:
                lo_x, lo_y, hi_x, hi_y = 0.0, 0.0, float(cols * block), float(rows * block)
                continue
            px = (start[0, 0] * bx + start[0, 1] * by + start[0, 2]) / z
            py = (start[1, 0] * bx + start[1, 1] * by + start[1, 2]) / z
            lo_x, hi_x, lo_y, hi_y = min(lo_x, px), max(hi_x, px), min(lo_y, py), max(hi_y, py)
    for r in range(max(0, int(lo_y / block)), min(rows, int(hi_y / block) + 2)):
        for q in range(max(0, int(lo_x / block)), min(cols, int(hi_x / block) + 2)):
            if exposure[r, q] > limit:
                continue
            x, y = (q + 0.5) * block, (r + 0.5) * block
            z = to_start[2, 0] * x + to_start[2, 1] * y + to_start[2, 2]
            ax = (to_start[0, 0] * x + to_start[0, 1] * y + to_start[0, 2]) / z * K[0, 0] + K[0, 2]
            ay = (to_start[1, 0] * x + to_start[1, 1] * y + to_start[1, 2]) / z * K[1, 1] + K[1, 2]
            if not (ax >= 0 and ay >= 0 and ax < width and ay < height):
                continue
            z = to_end[2, 0] * x + to_end[2, 1] * y + to_end[2, 2]
            bx = (to_end[0, 0] * x + to_end[0, 1] * y + to_end[0, 2]) / z * K[0, 0] + K[0, 2]
            by = (to_end[1, 0] * x + to_end[1, 1] * y + to_end[1, 2]) / z * K[1, 1] + K[1, 2]
            # Never nothing: a block that was in view counts as seen even where the camera stood still.
            exposure[r, q] += max(0.05, np.sqrt((bx - ax) ** 2 + (by - ay) ** 2))
            r0, c0, r1, c1 = min(r0, r), min(c0, q), max(r1, r + 1), max(c1, q + 1)
    return r0, c0, r1, c1


# 1 - exp(-x) at steps of 1 / 256 up to 16, for linear interpolation: exact to 2e-6, and six times faster than exp.
_STEPS = 256
_SATURATED = (1.0 - np.exp(-np.arange(16 * _STEPS + 2) / _STEPS)).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def edge_block(votes, exposure, block, r0, c0, k, out):
    """Write M = 1 - exp(-k votes / (exposure + 1)) of the block of cells that starts at (r0, c0)."""
    rows, cols = out.shape
    last = 16 * _STEPS
    by_exposure = np.empty(cols, dtype=np.float32)
    for r in range(rows):
        if r == 0 or (r0 + r) % block == 0:
            row = exposure[(r0 + r) // block]
            for q in range(cols):
                if q == 0 or (c0 + q) % block == 0:
                    share = np.float32(_STEPS * k / (row[(c0 + q) // block] + 1.0))
                by_exposure[q] = share
        for q in range(cols):
            v = votes[r0 + r, c0 + q]
            if v > 0.0:
                x = min(v * by_exposure[q], last)
                i = int(x)
                out[r, q] = _SATURATED[i] + (x - i) * (_SATURATED[i + 1] - _SATURATED[i])
            else:
                out[r, q] = 0.0


@numba.njit(cache=True, nogil=True)
def occupied_percentile(votes, exposure, block, share):
    """Return a percentile (`share` 0 to 1) of the rates of the cells that hold at least one vote."""
    rows, cols = votes.shape
    # A histogram of log2(rate) in eighths, from 2^-16 to 2^16: 9 % wide bins are ample for a saturation.
    bins = np.zeros(256, dtype=np.int64)
    count = 0
    for r in range(rows):
        e_row = r // block
        for q in range(cols):
            v = votes[r, q]
            if v < 0.5:
                continue
            e = exposure[e_row, q // block]
            if e <= 0.0:
                continue
            i = int((np.log2(v / (e + 1.0)) + 16.0) * 8.0)
            bins[min(255, max(0, i))] += 1
            count += 1
    if count == 0:
        return 0.0
    seen = 0
    for i in range(256):
        seen += bins[i]
        if seen >= share * count:
            return 2.0 ** ((i + 0.5) / 8.0 - 16.0)
    return 1.0
