"""Edges that several views share: ridge pixels of their joint image, and which events belong to them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast import kernels
from dvsviz.tracking import constants as c
from dvsviz.tracking.planar_map import occupied_percentile

Array = NDArray[np.float64]

_ONE = np.ones(1, dtype=np.float32)


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


def bounds(cells: list[Array]) -> tuple[Array, tuple[int, int]]:
    """Return the low corner (2,) and (rows, columns) of a grid that holds nearly all points."""
    points = np.concatenate([p[:: max(1, len(p) // 200)] for p in cells])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = np.percentile(points, 0.2, axis=0) - 40, np.percentile(points, 99.8, axis=0) + 40
    size = np.minimum(high - low, 6000)
    return np.floor(low), (int(size[1]) + 1, int(size[0]) + 1)


def find_ridges(cells: list[Array], low: Array, shape: tuple[int, int], gate: float) -> Ridges | None:
    """Return the ridge pixels of the joint edge image, sub-pixel, with their normals."""
    votes = np.zeros(shape, dtype=np.float32)
    for points in cells:
        kernels.vote(points - low, _ONE, votes)
    ones = np.ones((1, 1), dtype=np.float32)
    p90 = occupied_percentile(votes, ones, max(shape), 0.9)
    if p90 <= 0:
        return None
    # `occupied_percentile` divides by exposure + 1 = 2.
    edge = 1.0 - np.exp(-c.MAP_SATURATION * votes / (2.0 * p90))
    smooth = cv2.GaussianBlur(edge.astype(np.float32), (0, 0), c.REFINE_RIDGE_BLUR_PX)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    xx, yy = cv2.Sobel(gx, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(gy, cv2.CV_32F, 0, 1, scale=1 / 8)
    xy = cv2.Sobel(gx, cv2.CV_32F, 0, 1, scale=1 / 8)
    # Steger's ridge: the second derivative across the line is most negative, the first one vanishes within the pixel.
    half, diff = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = np.sqrt(diff * diff + xy * xy)
    curvature = half - root
    angle = 0.5 * np.arctan2(-2 * xy, -(xx - yy))
    nx, ny = np.cos(angle), np.sin(angle)
    along = -(gx * nx + gy * ny) / np.where(curvature < -1e-6, curvature, -1e-6)
    is_ridge = (np.abs(along * nx) <= 0.6) & (np.abs(along * ny) <= 0.6) & (curvature < 0)
    # A line, not a blob or noise: curved across much more than along, and high enough.
    is_ridge &= (smooth > c.REFINE_RIDGE_LEVEL) & (np.abs(half + root) < 0.5 * np.abs(curvature))
    is_ridge[:4], is_ridge[-4:], is_ridge[:, :4], is_ridge[:, -4:] = False, False, False, False
    rows, cols = np.nonzero(is_ridge)
    if len(rows) < 50:
        return None
    keep = slice(None, None, max(1, len(rows) // c.REFINE_LANDMARKS))
    rows, cols = rows[keep], cols[keep]
    index = np.full(shape, -1, dtype=np.int32)
    index[rows, cols] = np.arange(len(rows), dtype=np.int32)
    mask = np.full(shape, 255, dtype=np.uint8)
    mask[rows, cols] = 0
    distance, label = cv2.distanceTransformWithLabels(mask, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    # OpenCV numbers the zero pixels itself: translate its numbers to ours.
    table = np.full(int(label.max()) + 1, -1, dtype=np.int32)
    label = np.asarray(label, dtype=np.int32)
    table[label[rows, cols]] = index[rows, cols]
    nearest = table[label]
    nearest[distance > gate + 1.5] = -1
    offset = along[rows, cols]
    normal = np.stack([nx[rows, cols], ny[rows, cols]], axis=-1).astype(np.float64)
    xy_px = np.stack([cols, rows], axis=-1) + offset[:, None] * normal
    return Ridges(xy=xy_px, normal=normal, label=nearest)


@numba.njit(cache=True, nogil=True)
def associate(points, bearings, label, xy, normal, gate, sums):
    """Sum, for each landmark, count, residual and bearing of the events within the gate of its line."""
    rows, cols = label.shape
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        if not (x >= 0.0 and y >= 0.0 and x < cols - 1 and y < rows - 1):
            continue
        j = label[int(y + 0.5), int(x + 0.5)]
        if j < 0:
            continue
        r = normal[j, 0] * (x - xy[j, 0]) + normal[j, 1] * (y - xy[j, 1])
        if abs(r) > gate:
            continue
        sums[j, 0] += 1.0
        sums[j, 1] += r
        sums[j, 2] += bearings[i, 0]
        sums[j, 3] += bearings[i, 1]
