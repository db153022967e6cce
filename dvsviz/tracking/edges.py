"""Edges that several views share: ridge pixels of their joint image, and which events belong to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.kernels import project, vote
from dvsviz.tracking import constants as c
from dvsviz.tracking.halves import Halves, middle_of
from dvsviz.tracking.map_kernels import edge_block, occupied_percentile

Array = NDArray[np.float64]

_ONE = np.ones(1, dtype=np.float32)
# Sobel's two factors, each with itself or with the other: of the stencils of second derivatives.
_SMOOTH_5 = np.array([1.0, 4.0, 6.0, 4.0, 1.0])
_FIRST_5 = np.array([-1.0, -2.0, 0.0, 2.0, 1.0])
_SECOND_5 = np.array([1.0, 0.0, -2.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewEvents:
    """Events of several views.

    Attributes:
        bearings: (N, 2) float32, one view after the other.
        first: index of each one's first event (V + 1,).
    """

    bearings: NDArray[np.float32]
    first: NDArray[np.int64]

    @classmethod
    def of(cls, bearings: Sequence[NDArray[np.float32]]) -> ViewEvents:
        """Return the bearings (N, 2) of views as one."""
        together = np.concatenate([np.zeros((0, 2), dtype=np.float32), *bearings], dtype=np.float32)
        return cls(bearings=together, first=np.cumsum([0, *map(len, bearings)]))

    def of_view(self, k: int) -> NDArray[np.float32]:
        """Return the bearings (N, 2) of one view."""
        return self.bearings[self.first[k] : self.first[k + 1]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """What several views show of one plane.

    Attributes:
        views: their numbers (V,).
        events: theirs.
        cells: where they lie on the plane (N, 2) float32, on a grid that holds nearly all of them; NaN behind the
            camera.
        shape: of the grid (rows, columns).
    """

    views: NDArray[np.int64]
    events: ViewEvents
    cells: NDArray[np.float32]
    shape: tuple[int, int]


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
    label: NDArray[np.int16]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """Landmarks as views saw them, sorted by landmark, then view.

    Attributes:
        first: of each landmark its first row (L + 1,).
        landmark: of each row (M,).
        view: of each row (M,), counted among the views that were shown.
        mean: (M, 4): events, their mean distance to the landmark's line and mean bearing.
    """

    first: NDArray[np.int64]
    landmark: NDArray[np.int64]
    view: NDArray[np.int64]
    mean: Array


# Events that tell how large the grid must be.
_BOUNDED_BY = 10_000


def show(events: ViewEvents, views: NDArray[np.int64], homographies: Array, halves: Halves) -> Shown:
    """Return what views (V,) show on the grid of a plane, to which homographies (V, 3, 3) take their bearings."""
    H = np.ascontiguousarray(homographies)
    some = np.empty((-(-len(events.bearings) // (step := max(1, len(events.bearings) // _BOUNDED_BY))), 2))
    to_cells(events.bearings, events.first, H, np.zeros(2), step, 0, len(H), some)
    low, shape = bounds(some)
    cells = np.empty_like(events.bearings)

    def work(start: int, end: int) -> None:
        to_cells(events.bearings, events.first, H, low, 1, start, end, cells)

    halves.both(work, middle_of(events.first), len(H))
    return Shown(views=views, events=events, cells=cells, shape=shape)


def bounds(points: Array) -> tuple[Array, tuple[int, int]]:
    """Return the low corner (2,) and (rows, columns) of a grid that holds nearly all points (N, 2)."""
    points = points[np.isfinite(points[:, 0])]
    if len(points) == 0:
        return np.zeros(2), (1, 1)
    low, high = np.percentile(points, 0.2, axis=0) - 40, np.percentile(points, 99.8, axis=0) + 40
    size = np.minimum(high - low, 6000)
    return np.floor(low), (int(size[1]) + 1, int(size[0]) + 1)


def find_ridges(shown: Shown, gate: float, halves: Halves) -> Ridges | None:
    """Return the ridge pixels of the joint edge image, sub-pixel, with their normals.

    Args:
        shown: the views.
        gate: how far from a ridge pixel, cells, it is still the nearest.
        halves: does the voting.
    """
    cells, shape = shown.cells, shown.shape

    def voted(start: int, end: int) -> NDArray[np.float32]:
        image = np.zeros(shape, dtype=np.float32)
        vote(cells[start:end], _ONE, image)
        return image

    votes, others = halves.both(voted, len(cells) // 2, len(cells))
    votes += others
    ones = np.ones((1, 1), dtype=np.float32)
    p90 = occupied_percentile(votes, ones, max(shape), 0.9)
    if p90 <= 0:
        return None
    edge = np.empty_like(votes)
    edge_block(votes, ones, max(shape), 0, 0, c.MAP_SATURATION / p90, edge)
    smooth = cv2.GaussianBlur(edge, (0, 0), c.REFINE_RIDGE_BLUR_PX)
    found = ridge_pixels(smooth, c.REFINE_RIDGE_LEVEL)
    if len(found) < 50:
        return None
    # Fewer than twice as many: a label has 16 bits, so that more of the grid fits the cache.
    found = found[:: max(1, len(found) // c.REFINE_LANDMARKS)]
    label = nearest_pixel(found, shape[0], shape[1], gate + 1.5)
    return Ridges(
        xy=found[:, :2] + found[:, 2:3] * found[:, 3:],
        normal=np.ascontiguousarray(found[:, 3:]),
        label=label,
    )


@numba.njit(cache=True, nogil=True)
def first_derivatives(image, r, q):
    """Return d/dx and d/dy of an image at a pixel: Sobel's, by 8."""
    # Its eight neighbours, by the points of the compass.
    nw, n, ne = image[r - 1, q - 1], image[r - 1, q], image[r - 1, q + 1]
    w, e = image[r, q - 1], image[r, q + 1]
    sw, s, se = image[r + 1, q - 1], image[r + 1, q], image[r + 1, q + 1]
    return (ne - nw + 2.0 * (e - w) + se - sw) / 8.0, (sw - nw + 2.0 * (s - n) + se - ne) / 8.0


@numba.njit(cache=True, nogil=True)
def second_derivatives(image, r, q):
    """Return the second derivatives xx, yy, xy of an image at a pixel: Sobel's by 8, twice."""
    xx = yy = xy = 0.0
    for k in range(5):
        row = image[r + k - 2]
        a, b, m, d, e = row[q - 2], row[q - 1], row[q], row[q + 1], row[q + 2]
        xx += _SMOOTH_5[k] * (a - 2.0 * m + e)
        yy += _SECOND_5[k] * (a + 4.0 * (b + d) + 6.0 * m + e)
        xy += _FIRST_5[k] * (e - a + 2.0 * (d - b))
    return xx / 64.0, yy / 64.0, xy / 64.0


@numba.njit(cache=True, nogil=True)
def ridge_pixels(smooth, level):
    """Return the ridge pixels (L, 5) of a smooth image: column, row, offset to the ridge along its normal, normal.

    Steger's ridge: the second derivative across the line is most negative, the first one vanishes within the pixel. A
    line, not a blob or noise: curved across much more than along, and high enough. Derivatives are Sobel's, the second
    ones Sobel's twice, and taken only where they are asked for.

    Args:
        smooth: image (rows, columns).
        level: least value.
    """
    rows, cols = smooth.shape
    out = np.empty((1024, 5))
    n = 0
    for r in range(4, rows - 4):
        for q in range(4, cols - 4):
            if not smooth[r, q] > level:
                continue
            xx, yy, xy = second_derivatives(smooth, r, q)
            half, diff = 0.5 * (xx + yy), 0.5 * (xx - yy)
            root = np.sqrt(diff * diff + xy * xy)
            curvature = half - root
            if curvature >= 0.0 or abs(half + root) >= 0.5 * abs(curvature):
                continue
            angle = 0.5 * np.arctan2(-xy, -diff)
            nx, ny = np.cos(angle), np.sin(angle)
            gx, gy = first_derivatives(smooth, r, q)
            along = -(gx * nx + gy * ny) / min(curvature, -1e-6)
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
    label = np.full((rows, cols), -1, dtype=np.int16)
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
def to_cells(bearings, first, homographies, low, step, start, end, cells):
    """Write where homographies put the bearings of views, from a corner on; NaN behind.

    Args:
        bearings: (N, 2).
        first: index of each view's first event (V + 1,).
        homographies: (V, 3, 3).
        low: corner (2,).
        step: every so manieth event is taken.
        start: first view.
        end: the one after the last.
        cells: (N / step, 2).
    """
    for k in range(start, end):
        H = homographies[k]
        for i in range(-(-first[k] // step), -(-first[k + 1] // step)):
            u, v = project(H, bearings[i * step, 0], bearings[i * step, 1])
            cells[i, 0], cells[i, 1] = u - low[0], v - low[1]


def associate(shown: Shown, ridges: Ridges, gate: float, halves: Halves) -> Seen:
    """Return what views saw of landmarks: the means over the events within the gate of its line.

    Args:
        shown: the views.
        ridges: the landmarks.
        gate: largest distance to the line.
        halves: does the work.
    """
    lines = np.column_stack([ridges.xy, ridges.normal]).astype(np.float32)
    events = shown.events

    def work(start: int, end: int) -> tuple[NDArray[np.int64], Array]:
        return seen_by(
            shown.cells, events.bearings, events.first, start, end, ridges.label, lines, gate, c.REFINE_MIN_EVENTS
        )

    earlier, later = halves.both(work, middle_of(events.first), len(shown.views))
    first, landmark, view, mean = by_landmark(len(lines), earlier, later)
    return Seen(first=first, landmark=landmark, view=view, mean=mean)


@numba.njit(cache=True, nogil=True)
def seen_by(cells, bearings, first, start, end, label, lines, gate, least):
    """Return landmark and view (M, 2) and mean (M, 4) of what some views saw, one view after the other.

    Args:
        cells: of the events (N, 2).
        bearings: of the events (N, 2).
        first: index of each view's first event (V + 1,).
        start: first view.
        end: the one after the last.
        label: nearest landmark of each cell (rows, columns), or -1.
        lines: landmarks (L, 4): a point and the normal.
        gate: largest distance to the line.
        least: events, with which a view has seen a landmark.
    """
    rows, cols = label.shape
    right, bottom, half = np.float32(cols - 1), np.float32(rows - 1), np.float32(0.5)
    gate, zero, one = np.float32(gate), np.float32(0.0), np.float32(1.0)
    # One view after the other: what is summed stays in the cache.
    sums = np.zeros((lines.shape[0], 4), dtype=np.float32)
    touched = np.empty(lines.shape[0], dtype=np.int32)
    seen, mean, n = np.empty((4096, 2), dtype=np.int64), np.empty((4096, 4)), 0
    for k in range(start, end):
        t = 0
        for i in range(first[k], first[k + 1]):
            x, y = cells[i, 0], cells[i, 1]
            if not (x >= zero and y >= zero and x < right and y < bottom):
                continue
            j = label[int(y + half), int(x + half)]
            if j < 0:
                continue
            r = lines[j, 2] * (x - lines[j, 0]) + lines[j, 3] * (y - lines[j, 1])
            if abs(r) > gate:
                continue
            if sums[j, 0] == zero:
                touched[t] = j
                t += 1
            sums[j, 0] += one
            sums[j, 1] += r
            sums[j, 2] += bearings[i, 0]
            sums[j, 3] += bearings[i, 1]
        while n + t > mean.shape[0]:
            seen, mean = np.concatenate((seen, seen)), np.concatenate((mean, mean))
        for i in range(t):
            j = touched[i]
            if sums[j, 0] >= least:
                seen[n, 0], seen[n, 1], mean[n, 0] = j, k, sums[j, 0]
                for q in range(1, 4):
                    mean[n, q] = sums[j, q] / sums[j, 0]
                n += 1
            sums[j] = zero
    return seen[:n], mean[:n]


@numba.njit(cache=True, nogil=True)
def by_landmark(count, earlier, later):
    """Return first row of each landmark (L + 1,), landmark (M,), view (M,) and mean (M, 4) of what two halves saw."""
    first = np.zeros(count + 1, dtype=np.int64)
    for seen, _ in (earlier, later):
        for i in range(seen.shape[0]):
            first[seen[i, 0] + 1] += 1
    for j in range(count):
        first[j + 1] += first[j]
    at, n = first[:-1].copy(), first[-1]
    landmark, view, sorted_mean = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty((n, 4))
    for seen, mean in (earlier, later):
        for i in range(seen.shape[0]):
            k = at[seen[i, 0]]
            at[seen[i, 0]] += 1
            landmark[k], view[k] = seen[i, 0], seen[i, 1]
            sorted_mean[k] = mean[i]
    return first, landmark, view, sorted_mean
