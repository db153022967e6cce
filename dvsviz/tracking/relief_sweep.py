"""Inverse depth by plane sweep: at which depth the events of a window, moved back along their motion, are sharpest.

Space sweep of one window of known motion: its events are warped as if all lay at one inverse depth, for each of a
range of them, and every cell of the image takes the one at which its own image of warped events has the largest mean
square. It needs no start and no match of edges, and is what new landmarks begin from.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import vote
from dvsviz.geometry.camera import Camera
from dvsviz.tracking import relief_constants as rc

Array = NDArray[np.float64]


def image_flow(bearings: Array, inverse_depth: Array, omega: Array, velocity: Array) -> Array:
    """Return the image velocity (N, 2), bearings per second, of points at rest before a moving camera.

    Args:
        bearings: (N, 2).
        inverse_depth: (N,).
        omega: angular velocity (3,), camera frame.
        velocity: linear velocity (3,), camera frame.
    """
    x, y, rho = bearings[:, 0], bearings[:, 1], inverse_depth
    dx = -rho * velocity[0] - omega[1] + omega[2] * y
    dy = -rho * velocity[1] - omega[2] * x + omega[0]
    dz = -rho * velocity[2] - omega[0] * y + omega[1] * x
    return np.column_stack([dx - x * dz, dy - y * dz])


def sweep(
    bearings: NDArray[np.float32],
    t_s: Array,
    is_positive: NDArray[np.bool_],
    camera: Camera,
    omega: Array,
    velocity: Array,
    inverse_depths: Array,
) -> tuple[Array, Array]:
    """Return the inverse depth of each cell (rows, columns) and how clearly it is the sharpest one (rows, columns).

    Args:
        bearings: (N, 2).
        t_s: times (N,) since the reference time.
        is_positive: polarities (N,).
        camera: of the events.
        omega: angular velocity (3,), camera frame.
        velocity: linear velocity (3,), camera frame.
        inverse_depths: to try (K,), a geometric sequence.
    """
    K, shape = camera.matrix, (camera.height, camera.width)
    cells = (camera.height // rc.RELIEF_CELL_PX + 1, camera.width // rc.RELIEF_CELL_PX + 1)
    b = np.asarray(bearings, dtype=np.float64)
    sign = np.where(is_positive, np.float32(1), np.float32(-1))
    still = image_flow(b, np.zeros(len(b)), omega, velocity)
    moved = image_flow(b, np.ones(len(b)), omega, velocity) - still
    scores = np.empty((len(inverse_depths), *cells))
    for k, rho in enumerate(inverse_depths):
        points = b - t_s[:, None] * (still + rho * moved)
        px = (points * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]).astype(np.float32)
        image = cv2.GaussianBlur(vote(px, sign, shape), (0, 0), rc.RELIEF_SWEEP_BLUR_PX)
        small = cv2.resize(image * image, cells[::-1], interpolation=cv2.INTER_AREA)
        scores[k] = cv2.GaussianBlur(small, (0, 0), rc.RELIEF_SWEEP_CELLS)
    best = np.clip(np.argmax(scores, axis=0), 1, len(inverse_depths) - 2)
    before, at, after = (np.take_along_axis(scores, (best + d)[None], 0)[0] for d in (-1, 0, 1))
    curvature = before - 2 * at + after
    # Steps are equal in the logarithm: the summit of a parabola through three of them.
    offset = np.where(curvature < 0, 0.5 * (before - after) / np.where(curvature < 0, curvature, 1.0), 0.0)
    step = np.log(inverse_depths[1] / inverse_depths[0])
    rho = inverse_depths[best] * np.exp(step * np.clip(offset, -1.0, 1.0))
    clear = at / np.maximum(np.median(scores, axis=0), 1e-9) - 1.0
    return rho, np.where((at > rc.RELIEF_SWEEP_LEAST) & (curvature < 0), np.clip(clear, 0.0, 1.0), 0.0)
