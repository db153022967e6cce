"""Edges that several views share: ridge pixels of their joint image, and which events belong to them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.kernels import project, vote
from dvsviz.tracking import constants as c
from dvsviz.tracking.planar_map import edge_block, occupied_percentile

Array = NDArray[np.float64]

_ONE = np.ones(1, dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """What several views show of one plane.

    Attributes:
        views: their numbers (V,).
        first: index of each one's first event (V + 1,).
        bearings: (N, 2), one view after the other.
        cells: where they lie on the plane (N, 2); NaN behind the camera.
    """

    views: NDArray[np.int64]
    first: NDArray[np.int64]
    bearings: Array
    cells: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ridges:
    """Ridge pixels.

    Attributes:
        xy: sub-pixel cells (L, 2).
        normal: unit normals of the edges (L, 2).
        label: nearest ridge pixel of each cell (rows, columns), -1 where none is near.
    """

    xy: Array
    normal: Array
    label: NDArray[np.int32]


def bounds(cells: Array) -> tuple[Array, tuple[int, int]]:
    """Return the low corner (2,) and (rows, columns) of a grid that holds nearly all points (N, 2)."""
    points = cells[:: max(1, len(cells) // 10_000)]
    points = points[np.isfinite(points[:, 0])]
    if len(points) == 0:
        return np.zeros(2), (1, 1)
    low, high = np.percentile(points, 0.2, axis=0) - 40, np.percentile(points, 99.8, axis=0) + 40
    size = np.minimum(high - low, 6000)
    return np.floor(low), (int(size[1]) + 1, int(size[0]) + 1)


def find_ridges(cells: Array, shape: tuple[int, int], gate: float) -> Ridges | None:
    """Return the ridge pixels of the joint edge image, sub-pixel, with their normals.

    Args:
        cells: of all events (N, 2), on the grid.
        shape: of the grid (rows, columns).
        gate: how far from a ridge pixel, cells, it is still the nearest.
    """
    votes = np.zeros(shape, dtype=np.float32)
    vote(cells, _ONE, votes)
    ones = np.ones((1, 1), dtype=np.float32)
    p90 = occupied_percentile(votes, ones, max(shape), 0.9)
    if p90 <= 0:
        return None
    edge = np.empty_like(votes)
    edge_block(votes, ones, max(shape), 0, 0, c.MAP_SATURATION / p90, edge)
    smooth = cv2.GaussianBlur(edge, (0, 0), c.REFINE_RIDGE_BLUR_PX)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    xx, yy = cv2.Sobel(gx, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(gy, cv2.CV_32F, 0, 1, scale=1 / 8)
    xy = cv2.Sobel(gx, cv2.CV_32F, 0, 1, scale=1 / 8)
    found = ridge_pixels(smooth, gx, gy, xx, yy, xy, c.REFINE_RIDGE_LEVEL)
    if len(found) < 50:
        return None
    found = found[:: max(1, len(found) // c.REFINE_LANDMARKS)]
    label = nearest_pixel(found, shape[0], shape[1], gate + 1.5)
    return Ridges(
        xy=found[:, :2] + found[:, 2:3] * found[:, 3:],
        normal=np.ascontiguousarray(found[:, 3:]),
        label=label,
    )


@numba.njit(cache=True, nogil=True)
def ridge_pixels(smooth, gx, gy, xx, yy, xy, level):
    """Return the ridge pixels (L, 5) of a smooth image: column, row, offset to the ridge along its normal, normal.

    Steger's ridge: the second derivative across the line is most negative, the first one vanishes within the pixel. A
    line, not a blob or noise: curved across much more than along, and high enough.

    Args:
        smooth: image (rows, columns).
        gx: its first derivatives (rows, columns), along the columns.
        gy: along the rows.
        xx: its second derivatives (rows, columns).
        yy: the same.
        xy: the same.
        level: least value.
    """
    rows, cols = smooth.shape
    out = np.empty((1024, 5))
    n = 0
    for r in range(4, rows - 4):
        for q in range(4, cols - 4):
            if not smooth[r, q] > level:
                continue
            half, diff = 0.5 * (xx[r, q] + yy[r, q]), 0.5 * (xx[r, q] - yy[r, q])
            root = np.sqrt(diff * diff + xy[r, q] * xy[r, q])
            curvature = half - root
            if curvature >= 0.0 or abs(half + root) >= 0.5 * abs(curvature):
                continue
            angle = 0.5 * np.arctan2(-xy[r, q], -diff)
            nx, ny = np.cos(angle), np.sin(angle)
            along = -(gx[r, q] * nx + gy[r, q] * ny) / min(curvature, -1e-6)
            if abs(along * nx) > 0.6 or abs(along * ny) > 0.6:
                continue
            if n == out.shape[0]:
                grown = np.empty((2 * n, 5))
                grown[:n] = out
                out = grown
            out[n, 0], out[n, 1], out[n, 2], out[n, 3], out[n, 4] = q, r, along, nx, ny
            n += 1
    return out[:n]


@numba.njit(cache=True, nogil=True)
def nearest_pixel(found, rows, cols, limit):
    """Return which of pixels (L, 2 or more: column, row) is nearest to each cell (rows, columns); -1 beyond a limit."""
    label = np.full((rows, cols), -1, dtype=np.int32)
    square = np.full((rows, cols), np.float32(limit * limit))
    reach = int(limit)
    for j in range(found.shape[0]):
        q, r = int(found[j, 0]), int(found[j, 1])
        for y in range(max(0, r - reach), min(rows, r + reach + 1)):
            for x in range(max(0, q - reach), min(cols, q + reach + 1)):
                d = np.float32((x - q) * (x - q) + (y - r) * (y - r))
                if d < square[y, x]:
                    square[y, x] = d
                    label[y, x] = j
    return label


@numba.njit(cache=True, nogil=True)
def to_cells(bearings, first, homographies, cells):
    """Write where homographies (V, 3, 3) put the bearings (N, 2) of V views, from `first[k]` on; NaN behind."""
    for k in range(homographies.shape[0]):
        H = homographies[k]
        for i in range(first[k], first[k + 1]):
            cells[i, 0], cells[i, 1] = project(H, bearings[i, 0], bearings[i, 1])


@numba.njit(cache=True, nogil=True)
def associate(cells, bearings, first, label, xy, normal, gate, sums):
    """Sum, for each view and landmark, count, residual and bearing of the events within the gate of its line.

    Args:
        cells: of the events (N, 2).
        bearings: of the events (N, 2).
        first: index of each view's first event (V + 1,).
        label: nearest landmark of each cell (rows, columns), or -1.
        xy: landmarks (L, 2).
        normal: of their lines (L, 2).
        gate: largest distance to the line.
        sums: (L, V, 4), added to in place.
    """
    rows, cols = label.shape
    for k in range(sums.shape[1]):
        for i in range(first[k], first[k + 1]):
            x, y = cells[i, 0], cells[i, 1]
            if not (x >= 0.0 and y >= 0.0 and x < cols - 1 and y < rows - 1):
                continue
            j = label[int(y + 0.5), int(x + 0.5)]
            if j < 0:
                continue
            r = normal[j, 0] * (x - xy[j, 0]) + normal[j, 1] * (y - xy[j, 1])
            if abs(r) > gate:
                continue
            sums[j, k, 0] += 1.0
            sums[j, k, 1] += r
            sums[j, k, 2] += bearings[i, 0]
            sums[j, k, 3] += bearings[i, 1]


@numba.njit(cache=True, nogil=True)
def means(sums, least):
    """Return what views saw of landmarks with at least `least` events, sorted by landmark, then view.

    Args:
        sums: (L, V, 4) of `associate`.
        least: events.

    Returns:
        Landmark (M,), view (M,), and (M, 4) events, mean residual and mean bearing.
    """
    n = 0
    for j in range(sums.shape[0]):
        for k in range(sums.shape[1]):
            n += sums[j, k, 0] >= least
    landmark, view, mean = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty((n, 4))
    n = 0
    for j in range(sums.shape[0]):
        for k in range(sums.shape[1]):
            count = sums[j, k, 0]
            if count >= least:
                landmark[n], view[n], mean[n, 0] = j, k, count
                for i in range(1, 4):
                    mean[n, i] = sums[j, k, i] / count
                n += 1
    return landmark, view, mean
