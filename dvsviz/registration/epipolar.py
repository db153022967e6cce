"""The essential matrix fitted to all of its inliers: RANSAC's best is the fit of five points and their noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.registration.records import MatchedPoints, homogeneous

Array = NDArray[np.float64]

_STEPS = 15
_DIFFERENCE = 1e-6


def refine_essential(T_b_a: Array, matched: MatchedPoints, huber_px: float) -> Array:
    """Return the motion (4, 4) with a unit translation whose Sampson distances are least, by Levenberg-Marquardt.

    Five parameters: a turn, and the direction of the translation on its sphere; derivatives by central differences.

    Args:
        T_b_a: where to start; its translation has length 1.
        matched: the inliers.
        huber_px: distance from which weights fall.
    """
    a, b = homogeneous(matched.bearings_a), homogeneous(matched.bearings_b)
    f = matched.focal_px
    r: Array = sampson_px(T_b_a, a, b, f)
    cost, damping = _cost(r, huber_px), 1e-3
    for _ in range(_STEPS):
        J = np.empty((len(r), 5))
        for k in range(5):
            step = np.zeros(5)
            step[k] = _DIFFERENCE
            ahead, behind = sampson_px(_moved(T_b_a, step), a, b, f), sampson_px(_moved(T_b_a, -step), a, b, f)
            J[:, k] = (ahead - behind) / (2 * _DIFFERENCE)
        weight = np.minimum(1.0, huber_px / np.maximum(np.abs(r), 1e-12))
        normal, gradient = (J * weight[:, None]).T @ J, (J * weight[:, None]).T @ r
        solved = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), gradient)
        step = np.asarray(-solved, dtype=np.float64)
        moved = _moved(T_b_a, step)
        r_new = sampson_px(moved, a, b, f)
        new = _cost(r_new, huber_px)
        if new < cost:
            is_settled = cost - new < 1e-9 * cost
            T_b_a, r, cost, damping = moved, r_new, new, damping / 10
            if is_settled:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return T_b_a


def sampson_px(T_b_a: Array, rays_a: Array, rays_b: Array, focal_px: float) -> Array:
    """Return signed distances (M,) in px of matches from their epipolar lines, to first order."""
    E = se3.hat(T_b_a[:3, 3]) @ T_b_a[:3, :3]
    line_b, line_a = rays_a @ E.T, rays_b @ E
    error = (rays_b * line_b).sum(axis=1)
    slope = np.sqrt((line_b[:, :2] ** 2).sum(axis=1) + (line_a[:, :2] ** 2).sum(axis=1))
    return np.asarray(focal_px * error / np.maximum(slope, 1e-12), dtype=np.float64)


def _moved(T_b_a: Array, step: Array) -> Array:
    """Return a motion turned by `step[:3]`, its translation moved along its sphere by `step[3:]`."""
    t = T_b_a[:3, 3]
    # Two directions across t: the rows of a rotation that brings it to an axis.
    across = np.linalg.svd(t[None])[2][1:]
    direction = t + step[3:] @ across
    return se3.pose(se3.exp_so3(step[:3]) @ T_b_a[:3, :3], direction / np.linalg.norm(direction))


def _cost(r: Array, huber: float) -> float:
    size = np.abs(r)
    return float(np.where(size < huber, 0.5 * size**2, huber * (size - 0.5 * huber)).sum())
