"""Contrast maximization of one window: the velocity (and, at first, the plane) that makes its IWE sharpest.

The reference mode of seed 000 (sections 2.1 and 2.2.3): it starts tracking, de-skews windows and draws the contrast
landscape. Aligning with a map is the tracker's (`tracking.align`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from dvsviz.contrast import kernels
from dvsviz.contrast.iwe import vote, warp_points
from dvsviz.contrast.objectives import Image, Objective, ObjectiveName, objective
from dvsviz.contrast.warp import window_warp
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, turn_normal, turn_normal_derivative

Array = NDArray[np.float64]

# Blurs (px) of the coarse-to-fine stages: 4 px bridges the standard one-window test from a zero start; the last one
# takes its error from 0.2 to 0.07 px.
_BLURS_PX = (4.0, 2.0, 1.0, 0.5)
# At blurs of this or more the sharpest image is one whose events are drawn together (v_z too large by a unit a
# second, seen on the standard test): a ridge holds the coarse stages near the start.
_COARSE_PX = 2.0
_COARSE_RIDGE = 1e-3
# Largest correction a stage may make, in px of displacement by px of its blur; what a blur cannot bridge
# is not found by it anyway.
_REACH = 10.0
# The same for the normal, in units of `_NORMAL_SCALE`: about 34 degrees a stage.
_TILT_REACH = 12.0
# Step of the normal (rad) that counts as one unit: it shows only through the change of depth across the image.
_NORMAL_SCALE = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContrastProblem:
    """Value and gradient of the contrast of one window as a function of its motion.

    Alone, a window is warped onto its camera's image, a blank canvas. With a map it is warped onto the map's grid
    (eq. 2.11) and added to its texture: the joint contrast of map and window (section 2.2.2).

    Attributes:
        bearings: (N, 2) float32.
        t_s: seconds since the first event (N,).
        weights: s_k (N,) float32, ±1 or (1,) for one weight.
        camera: gives the image grid and the size of a step.
        duration_s: length of the window.
        target: projection P (3, 3) from bearings at the first event to the pixels of `texture`; K where None.
        texture: what the events are added to (rows, columns); a blank image of the camera's size where None.
    """

    bearings: NDArray[np.float32]
    t_s: Array
    weights: NDArray[np.float32]
    camera: Camera
    duration_s: float
    target: Array | None = None
    texture: Image | None = None

    def evaluate(
        self, omega: Array, velocity: Array, plane: Plane, cost: Objective, *, d_normal: Array | None = None
    ) -> tuple[float, Array]:
        """Return the contrast and its gradient (6,) by omega and velocity, (8,) with the normal's parameters."""
        warp = window_warp(omega, velocity, plane, self.duration_s, self._projection, d_normal=d_normal)
        points = warp_points(self.bearings, self.t_s, warp)
        value, adjoint_image = cost(self._image(points))
        adjoint = np.zeros_like(warp.nodes)
        kernels.gather(
            self.bearings, self.t_s, self.weights, points, adjoint_image, warp.nodes, warp.scale, adjoint
        )
        return value, np.einsum("mrc,pmrc->p", adjoint, warp.d_nodes)

    def contrast(self, omega: Array, velocity: Array, plane: Plane, cost: Objective) -> float:
        """Return the contrast alone."""
        warp = window_warp(omega, velocity, plane, self.duration_s, self._projection, derivatives=False)
        return cost(self._image(warp_points(self.bearings, self.t_s, warp)))[0]

    @property
    def _projection(self) -> Array:
        return self.camera.matrix if self.target is None else self.target

    def _image(self, points: NDArray[np.float32]) -> Image:
        if self.texture is None:
            return vote(points, self.weights, (self.camera.height, self.camera.width))
        image = self.texture.copy()
        kernels.vote(points, self.weights, image)
        return image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContrastSolution:
    """The motion of one window by contrast maximization.

    Attributes:
        omega: angular velocity (3,), rad/s.
        velocity: linear velocity (3,), units of the plane's distance per second.
        normal: plane normal (3,) in the camera frame.
        contrast_before: contrast without motion, at the finest blur.
        contrast_after: contrast at the solution, at the finest blur.
        iterations: evaluations of value and gradient.
        converged: False where the solver stopped at its limit.
    """

    omega: Array
    velocity: Array
    normal: Array
    contrast_before: float
    contrast_after: float
    iterations: int
    converged: bool


def maximize_contrast(
    problem: ContrastProblem,
    plane: Plane,
    *,
    omega: Array | None = None,
    velocity: Array | None = None,
    free: NDArray[np.bool_] | None = None,
    with_normal: bool = False,
    name: ObjectiveName = "variance",
    blurs_px: tuple[float, ...] = _BLURS_PX,
    max_evaluations: int = 60,
    ridge: float = 0.0,
    prior: Array | None = None,
) -> ContrastSolution:
    """Return the motion that maximises the contrast, coarse to fine, by L-BFGS on scaled parameters.

    Args:
        problem: the window.
        plane: in the camera frame at the first event; its distance is kept.
        omega: start (3,), zero unless given.
        velocity: start (3,), zero unless given.
        free: mask (6,) over (omega, velocity) of the parameters to find; all unless given.
        with_normal: also find the normal (8 parameters, section 2.2.3).
        name: the objective.
        blurs_px: Gaussian blurs of the stages.
        max_evaluations: limit a stage.
        ridge: penalty of the motion per squared px of displacement, in units of the contrast without motion: decides
            between motions that look alike (rotation about y, motion along x) in favour of the smaller one. The normal
            is held as gently to its start.
        prior: motion (6,) from which the ridge counts; none unless given.
    """
    mask = np.ones(6, dtype=bool) if free is None else np.asarray(free, dtype=bool)
    x = np.concatenate([np.zeros(3) if omega is None else omega, np.zeros(3) if velocity is None else velocity])
    normal = np.asarray(plane.normal, dtype=np.float64)
    # One unit of every parameter moves the image's edge by about 1 px over the window.
    f = 0.5 * (problem.camera.fx + problem.camera.fy)
    duration = max(problem.duration_s, 1e-6)
    scale = np.full(6, 1.0 / (f * duration))
    scale[3:] *= plane.distance
    centre = np.zeros(6) if prior is None else np.asarray(prior, dtype=np.float64)
    count = int(mask.sum())
    evaluations, converged = 0, True
    tilted = np.zeros(2)
    for blur in blurs_px:
        cost = objective(name, blur)
        still, _ = problem.evaluate(np.zeros(3), np.zeros(3), plane, cost)
        reference = max(still, 1e-12)
        held = max(ridge, _COARSE_RIDGE) if blur >= _COARSE_PX else ridge

        def negative(
            z: Array,
            cost: Objective = cost,
            reference: float = reference,
            held: float = held,
            normal: Array = normal,
            x: Array = x,
            tilted: Array = tilted,
        ) -> tuple[float, Array]:
            trial = x.copy()
            trial[mask] += z[:count] * scale[mask]
            delta = z[count:] * _NORMAL_SCALE if with_normal else np.zeros(2)
            value, slope = problem.evaluate(
                trial[:3],
                trial[3:],
                Plane(normal=turn_normal(normal, delta), distance=plane.distance),
                cost,
                d_normal=turn_normal_derivative(normal, delta) if with_normal else None,
            )
            slope = np.concatenate([slope[:6][mask] * scale[mask], slope[6:] * _NORMAL_SCALE])
            motion = (trial - centre)[mask] / scale[mask]
            slope[:count] -= 2 * held * reference * motion
            penalty = held * float(motion @ motion)
            if with_normal and ridge > 0:
                # Turning by delta after a turn by `tilted`: their sum, to first order.
                tilt = tilted + z[count:]
                slope[count:] -= 2 * ridge * reference * tilt
                penalty += ridge * float(tilt @ tilt)
            return -value / reference + penalty, -slope / reference

        found = minimize(
            negative,
            np.zeros(count + (2 if with_normal else 0)),
            # Without a bound a line search can leap to where all events fall on one pixel: the sharpest image of all.
            bounds=[(-_REACH * blur, _REACH * blur)] * count + [(-_TILT_REACH, _TILT_REACH)] * (2 * with_normal),
            jac=True,
            method="L-BFGS-B",
            options={"maxfun": max_evaluations, "ftol": 1e-7, "gtol": 1e-5},
        )
        evaluations += int(found.nfev)
        converged = bool(found.success)
        x = x.copy()
        x[mask] += found.x[:count] * scale[mask]
        if with_normal:
            normal = turn_normal(normal, found.x[count:] * _NORMAL_SCALE)
            tilted = tilted + found.x[count:]
    final = objective(name, blurs_px[-1])
    solved = Plane(normal=normal, distance=plane.distance)
    return ContrastSolution(
        omega=x[:3],
        velocity=x[3:],
        normal=normal,
        contrast_before=problem.contrast(np.zeros(3), np.zeros(3), plane, final),
        contrast_after=problem.contrast(x[:3], x[3:], solved, final),
        iterations=evaluations,
        converged=converged,
    )
