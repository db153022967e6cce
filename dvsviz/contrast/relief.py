"""Contrast maximization of a translating camera before a scene that is not a plane.

The inverse depth is a coarse grid over the image, interpolated bilinearly and kept smooth by a small penalty: a first
step past the planar homography of seed 000, chapter 3. The warp of an event at time t, with inverse depth rho:

    x' = (x + rho t v_xy) / (1 + rho t v_z)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from dvsviz.contrast.iwe import vote
from dvsviz.contrast.objectives import Objective, objective
from dvsviz.geometry.camera import Camera

Array = NDArray[np.float64]

# Columns of the depth grid; rows by the sensor's shape. 40 px cells on a 240 px sensor hold a thousand events each.
_COLUMNS = 7
# Penalty of a squared step of the log inverse depth between neighbours, in units of the contrast without motion:
# 0.1 left slider_depth's layers in one plane, 0.02 parted them (direction of travel 9 and 4 degrees off).
_SMOOTH = 0.02
_ZERO_MEAN = 0.2
# Penalty of a squared unit of displacement by forward motion, in units of the contrast without motion, at blurs of this
# or more: they are sharpest where events are drawn together, and a slope of depth looks like moving forward. On
# slider_depth 0 drifted sideways by 21 % of the path, 0.01 by 1.9, 0.03 by 1.2.
_FORWARD = 0.02
_COARSE_PX = 2.0
# Log inverse depth that counts as one unit of the solver.
_DEPTH_SCALE = 0.3
# Largest correction a stage may make: units of `_MOTION_SCALE_PX` by px of blur, and units of `_DEPTH_SCALE`.
_REACH = 5.0
# Displacement, px, that counts as one unit.
_MOTION_SCALE_PX = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Relief:
    """A translation before a relief.

    Attributes:
        velocity: (3,), camera frame, units of the mean distance per second.
        log_inverse_depth: (rows, columns) on a grid over the image.
        contrast_before: contrast without motion.
        contrast_after: contrast at the solution.
        evaluations: of value and gradient.
    """

    velocity: Array
    log_inverse_depth: Array
    contrast_before: float
    contrast_after: float
    evaluations: int


def grid_shape(camera: Camera) -> tuple[int, int]:
    """Return rows and columns of the depth grid."""
    return max(3, round(_COLUMNS * camera.height / camera.width)), _COLUMNS


class ReliefProblem:
    """Value and gradient of one window's contrast by velocity and log inverse depth.

    Args:
        bearings: (N, 2) float32.
        t_s: times (N,) relative to the reference time, s.
        weights: (N,) float32, polarity ±1.
        camera: gives the grid.
    """

    def __init__(
        self, bearings: NDArray[np.float32], t_s: Array, weights: NDArray[np.float32], camera: Camera
    ) -> None:
        self.bearings, self.t_s, self.weights, self.camera = bearings, t_s, weights, camera
        rows, cols = grid_shape(camera)
        x = (bearings[:, 0] * camera.fx + camera.cx) / (camera.width - 1) * (cols - 1)
        y = (bearings[:, 1] * camera.fy + camera.cy) / (camera.height - 1) * (rows - 1)
        # Undistorted events may lie a little outside the image: they take the border's depth.
        x, y = np.clip(x, 0, cols - 1.001), np.clip(y, 0, rows - 1.001)
        c, r = x.astype(np.int32), y.astype(np.int32)
        self.corner = (r * cols + c).astype(np.int32)
        self.fraction = np.stack([x - c, y - r], axis=-1).astype(np.float32)
        self.columns = cols
        self.size = rows * cols
        self._points = np.empty((len(bearings), 2), dtype=np.float32)

    def evaluate(self, velocity: Array, log_rho: Array, cost: Objective) -> tuple[float, Array, Array]:
        """Return the contrast, its gradient (3,) by velocity and (rows * columns,) by log inverse depth."""
        rho = np.exp(log_rho.ravel())
        k = np.array([self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy])
        _warp(self.bearings, self.t_s, velocity, self.corner, self.fraction, rho, self.columns, k, self._points)
        value, adjoint = cost(vote(self._points, self.weights, (self.camera.height, self.camera.width)))
        by_velocity, by_rho = np.zeros(3), np.zeros(self.size)
        _gather(
            self.bearings,
            self.t_s,
            velocity,
            self.corner,
            self.fraction,
            rho,
            self.columns,
            k,
            self._points,
            self.weights,
            adjoint,
            by_velocity,
            by_rho,
        )
        return value, by_velocity, by_rho * rho


def maximize_relief_contrast(
    problem: ReliefProblem,
    duration_s: float,
    *,
    velocity: Array,
    log_inverse_depth: Array,
    prior: Array | None = None,
    blurs_px: tuple[float, ...] = (4.0, 2.0, 1.0),
    max_evaluations: int = 30,
) -> Relief:
    """Return the velocity and relief that make a window sharpest, from a start.

    Args:
        problem: the window.
        duration_s: its length, for scaling.
        velocity: start (3,).
        log_inverse_depth: start (rows, columns).
        prior: relief (rows, columns) of the window before, which carries the scale; the mean is held at 0 where None.
        blurs_px: Gaussian blurs of the stages.
        max_evaluations: limit a stage.
    """
    shape = log_inverse_depth.shape
    scale = _MOTION_SCALE_PX / (problem.camera.fx * max(duration_s, 1e-6))
    v, depth, evaluations = velocity.copy(), log_inverse_depth.copy(), 0
    before = after = 0.0
    for blur in blurs_px:
        cost = objective("variance", blur)
        ridge = _FORWARD if blur >= _COARSE_PX else 0.0
        before = problem.evaluate(np.zeros(3), depth, cost)[0]
        reference = max(before, 1e-12)

        def negative(
            z: Array,
            cost: Objective = cost,
            reference: float = reference,
            v: Array = v,
            depth: Array = depth,
            ridge: float = ridge,
        ) -> tuple[float, Array]:
            trial = depth + _DEPTH_SCALE * z[3:].reshape(shape)
            value, by_velocity, by_depth = problem.evaluate(v + scale * z[:3], trial, cost)
            penalty, slope = _penalty(trial, prior)
            forward = v[2] / scale + z[2]
            penalty += ridge * forward * forward
            by_velocity[2] -= 2 * ridge * forward * reference / scale
            slopes = [-scale * by_velocity / reference, _DEPTH_SCALE * (slope.ravel() - by_depth / reference)]
            return penalty - value / reference, np.concatenate(slopes)

        found: Any = minimize(
            negative,
            np.zeros(3 + problem.size),
            bounds=[(-_REACH * blur, _REACH * blur)] * 3 + [(-_REACH, _REACH)] * problem.size,
            jac=True,
            method="L-BFGS-B",
            options={"maxfun": max_evaluations, "ftol": 1e-6},
        )
        evaluations += int(found.nfev)
        v = v + scale * found.x[:3]
        depth = depth + _DEPTH_SCALE * found.x[3:].reshape(shape)
        after = problem.evaluate(v, depth, cost)[0]
    return Relief(
        velocity=v, log_inverse_depth=depth, contrast_before=before, contrast_after=after, evaluations=evaluations
    )


def _penalty(relief: Array, prior: Array | None) -> tuple[float, Array]:
    """Return the penalty of a relief that is rough or far from its prior, and its derivative."""
    dx, dy = np.diff(relief, axis=1), np.diff(relief, axis=0)
    slope = np.zeros_like(relief)
    slope[:, 1:] += dx
    slope[:, :-1] -= dx
    slope[1:] += dy
    slope[:-1] -= dy
    value = _SMOOTH * float((dx * dx).sum() + (dy * dy).sum())
    slope *= 2 * _SMOOTH
    if prior is None:
        mean = float(relief.mean())
        return value + _ZERO_MEAN * mean * mean, slope + 2 * _ZERO_MEAN * mean / relief.size
    offset = relief - prior
    return value + 0.5 * _SMOOTH * float((offset * offset).sum()), slope + _SMOOTH * offset


@numba.njit(cache=True, nogil=True)
def _inverse_depth(corner, fx, fy, rho, columns):
    return (1 - fy) * ((1 - fx) * rho[corner] + fx * rho[corner + 1]) + fy * (
        (1 - fx) * rho[corner + columns] + fx * rho[corner + columns + 1]
    )


@numba.njit(cache=True, nogil=True)
def _warp(bearings, t_s, v, corner, fraction, rho, columns, k, out):
    """Write the warped pixels (N, 2)."""
    for i in range(bearings.shape[0]):
        s = t_s[i] * _inverse_depth(corner[i], fraction[i, 0], fraction[i, 1], rho, columns)
        z = 1.0 + s * v[2]
        if z < 1e-3:
            out[i, 0] = np.nan
            out[i, 1] = np.nan
            continue
        out[i, 0] = k[0] * (bearings[i, 0] + s * v[0]) / z + k[2]
        out[i, 1] = k[1] * (bearings[i, 1] + s * v[1]) / z + k[3]


@numba.njit(cache=True, nogil=True)
def _gather(bearings, t_s, v, corner, fraction, rho, columns, k, points, weights, adjoint, by_velocity, by_rho):
    """Add the derivatives of the cost by velocity (3,) and inverse depth (cells,)."""
    rows, cols = adjoint.shape
    for i in range(bearings.shape[0]):
        px, py = points[i, 0], points[i, 1]
        if not (px >= 0.0 and py >= 0.0 and px < cols - 1 and py < rows - 1):
            continue
        c, r = int(px), int(py)
        ax, ay = px - c, py - r
        v00, v01 = adjoint[r, c], adjoint[r, c + 1]
        v10, v11 = adjoint[r + 1, c], adjoint[r + 1, c + 1]
        gx = weights[i] * k[0] * ((1 - ay) * (v01 - v00) + ay * (v11 - v10))
        gy = weights[i] * k[1] * ((1 - ax) * (v10 - v00) + ax * (v11 - v01))
        fx, fy, q = fraction[i, 0], fraction[i, 1], corner[i]
        s = t_s[i] * _inverse_depth(q, fx, fy, rho, columns)
        z = 1.0 + s * v[2]
        x, y = (bearings[i, 0] + s * v[0]) / z, (bearings[i, 1] + s * v[1]) / z
        by_velocity[0] += gx * s / z
        by_velocity[1] += gy * s / z
        by_velocity[2] -= (gx * x + gy * y) * s / z
        d = t_s[i] * (gx * (v[0] - x * v[2]) + gy * (v[1] - y * v[2])) / z
        by_rho[q] += (1 - fx) * (1 - fy) * d
        by_rho[q + 1] += fx * (1 - fy) * d
        by_rho[q + columns] += (1 - fx) * fy * d
        by_rho[q + columns + 1] += fx * fy * d
