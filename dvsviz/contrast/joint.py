"""Joint contrast of all keyframes: poses, velocities and the plane's normal that make their common image sharpest.

Section 2.2.3 of seed 000. For k keyframes the parameters are the poses of all but the first, the velocities of all and
the normal: 6 (k - 1) + 6 k + 2 = 12 k - 4. The first pose and the plane's distance are the gauge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from dvsviz.contrast import kernels
from dvsviz.contrast.iwe import warp_points
from dvsviz.contrast.objectives import Image, Objective, ObjectiveName, objective
from dvsviz.contrast.warp import Warp, keyframe_warp
from dvsviz.geometry import se3
from dvsviz.geometry.plane import Plane, turn_normal, turn_normal_derivative

Array = NDArray[np.float64]

# A view that comes nearer to the plane, or more oblique, shrinks on the map and so becomes sharper: without a counter
# weight keyframes draw together (contrast 0.28 to 200 in six refinements of 3 s of shapes). An edge of fixed width has
# a contrast that falls with the root of its length, so that events count by the root of their view's size. Five views
# of a wall, 3.1 px off at the start: with the power 0.25 they end 1.2 px off, 0.4: 0.5, 0.5: 0.4, 0.75: 1.7, 1: 6.
_AREA_POWER = 0.5
# Step of the normal (rad) that counts as one unit, as in `contrast.solve`.
_NORMAL_SCALE = 0.05
# Largest correction a stage may make: in px (RMS over the view) by px of its blur, and of the normal, in its units.
# Without them a line search can leap to a grazing plane, on which everything is sharp.
_REACH = 4.0
_TILT_REACH = 3.0
# Events of a keyframe that tell how its parameters move the image, and the change of a parameter (rad, plane
# distances) that counts as 1 px where the image hardly tells it.
_SHAPE_EVENTS = 200
_SHAPE_STEP = 0.05
# Cells around the views' common image.
_MARGIN_PX = 24.0
# Side of the largest common image, cells.
_LARGEST = 4000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyframeEvents:
    """A keyframe as the joint contrast sees it.

    Attributes:
        bearings: (N, 2) float32.
        t_s: seconds since its first event (N,).
        duration_s: length of its window.
        T_world_camera: pose (4, 4) at its first event.
        omega: angular velocity (3,) there, rad/s, camera frame.
        velocity: linear velocity (3,) there, camera frame.
    """

    bearings: NDArray[np.float32]
    t_s: Array
    duration_s: float
    T_world_camera: Array
    omega: Array
    velocity: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Canvas:
    """The grid on the map's plane that keyframes are projected to.

    Attributes:
        target: affine map (3, 3) from plane coordinates (u, v, 1) to cells.
        shape: (rows, columns).
    """

    target: Array
    shape: tuple[int, int]


def canvas_of(keyframes: Sequence[KeyframeEvents], plane: Plane, px_per_unit: float) -> Canvas:
    """Return a grid that holds nearly all events of the keyframes as they stand, with a margin."""
    s = np.diag([px_per_unit, px_per_unit, 1.0])
    points = np.concatenate([warp_points(k.bearings[::8], k.t_s[::8], _warp(k, plane, s)) for k in keyframes])
    points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    low, high = np.percentile(points, 0.2, axis=0) - _MARGIN_PX, np.percentile(points, 99.8, axis=0) + _MARGIN_PX
    size = np.minimum(np.ceil(high - low), _LARGEST).astype(int) + 1
    s[:2, 2] = -np.floor(low)
    return Canvas(target=s, shape=(int(size[1]), int(size[0])))


def _warp(keyframe: KeyframeEvents, plane: Plane, target: Array, d_normal: Array | None = None) -> Warp:
    return keyframe_warp(
        keyframe.T_world_camera,
        keyframe.omega,
        keyframe.velocity,
        plane,
        keyframe.duration_s,
        target,
        np.zeros((3, 0)) if d_normal is None else d_normal,
    )


def common_image(keyframes: Sequence[KeyframeEvents], plane: Plane, canvas: Canvas) -> Image:
    """Return the image (rows, columns) of all keyframes' events on the plane; polarities are dropped."""
    image = np.zeros(canvas.shape, dtype=np.float32)
    for k in keyframes:
        warp = _warp(k, plane, canvas.target)
        kernels.vote(warp_points(k.bearings, k.t_s, warp), _weight(warp, canvas)[0], image)
    return image


def _weight(warp: Warp, canvas: Canvas) -> tuple[NDArray[np.float32], Array]:
    """Return the weight (1,) of a keyframe's events and its derivatives (P,): the size of its view on the map.

    The area that the middle of the image takes on the map is det H / z³ for a homography H with z = H[2, 2].
    """
    H, dH = warp.nodes[0], warp.d_nodes[:, 0]
    area = max(float(np.linalg.det(H)) / float(H[2, 2]) ** 3 / canvas.target[0, 0] ** 2, 1e-6)
    slope = np.einsum("rc,pcr->p", np.linalg.inv(H), dH) - 3.0 * dH[:, 2, 2] / H[2, 2]
    power = 0.5 * _AREA_POWER
    weight = area**power
    return np.array([weight], dtype=np.float32), power * weight * slope


def joint_contrast(
    keyframes: Sequence[KeyframeEvents], plane: Plane, canvas: Canvas, cost: Objective, d_normal: Array
) -> tuple[float, Array, Array]:
    """Return the contrast of the common image and its gradient.

    Args:
        keyframes: their events, poses and velocities.
        plane: the map's.
        canvas: the grid.
        cost: the objective.
        d_normal: derivative (3, 2) of the normal by its parameters.

    Returns:
        The contrast; its derivatives (K, 12) by each keyframe's rotation and position (local, as in `map_warp`), omega
        and velocity; and (2,) by the normal's parameters.
    """
    image = np.zeros(canvas.shape, dtype=np.float32)
    warps = [_warp(k, plane, canvas.target, d_normal) for k in keyframes]
    points = [warp_points(k.bearings, k.t_s, w) for k, w in zip(keyframes, warps, strict=True)]
    weights = [_weight(w, canvas) for w in warps]
    for p, (weight, _) in zip(points, weights, strict=True):
        kernels.vote(p, weight, image)
    value, adjoint_image = cost(image)
    slopes, by_normal = np.empty((len(keyframes), 12)), np.zeros(2)
    for i, (k, w, p, (weight, d_weight)) in enumerate(zip(keyframes, warps, points, weights, strict=True)):
        adjoint = np.zeros_like(w.nodes)
        kernels.gather(k.bearings, k.t_s, weight, p, adjoint_image, w.nodes, w.scale, adjoint)
        slope = np.einsum("mrc,pmrc->p", adjoint, w.d_nodes)
        slope += float(kernels.sample(p, adjoint_image, np.float32(0)).sum(dtype=np.float64)) * d_weight
        slopes[i] = slope[:12]
        by_normal += slope[12:]
    return value, slopes, by_normal


def _steps(keyframe: KeyframeEvents, plane: Plane, canvas: Canvas, free: NDArray[np.bool_]) -> Array:
    """Return combinations (12, F) of a keyframe's free parameters that each move its image by 1 cell RMS, unlike.

    Turning about y and moving along x look nearly alike: searched one by one they take hundreds of evaluations.
    """
    stride = max(1, len(keyframe.bearings) // _SHAPE_EVENTS)
    b, t = keyframe.bearings[::stride].astype(np.float64), keyframe.t_s[::stride]
    warp = _warp(keyframe, plane, canvas.target)
    node = np.clip(np.rint(t * warp.scale).astype(int), 0, len(warp.nodes) - 1)
    x = np.column_stack([b, np.ones(len(b))])
    q = np.einsum("nij,nj->ni", warp.nodes[node], x)
    dq = np.einsum("pnij,nj->pni", warp.d_nodes[:, node], x)
    moved = (dq[:, :, :2] - dq[:, :, 2:] * (q[:, :2] / q[:, 2:])) / q[:, 2:]
    seen = np.einsum("pni,rni->pr", moved, moved) / len(b)
    index = np.flatnonzero(free)
    seen = seen[np.ix_(index, index)]
    # Velocities count by what they do within the window.
    least = np.where(index < 6, 1.0, max(keyframe.duration_s, 1e-6)) / _SHAPE_STEP
    out = np.zeros((12, len(index)))
    out[index] = np.linalg.inv(np.linalg.cholesky(seen + np.diag(least**2))).T
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointSolution:
    """Keyframes and plane at the largest joint contrast.

    Attributes:
        keyframes: the same events with new poses and velocities.
        plane: with the new normal.
        contrast_before: joint contrast at the start, finest blur.
        contrast_after: joint contrast at the solution.
        evaluations: of value and gradient.
    """

    keyframes: tuple[KeyframeEvents, ...]
    plane: Plane
    contrast_before: float
    contrast_after: float
    evaluations: int


def maximize_joint_contrast(
    keyframes: Sequence[KeyframeEvents],
    plane: Plane,
    px_per_unit: float,
    *,
    free: NDArray[np.bool_],
    solve_normal: bool,
    blurs_px: tuple[float, ...],
    max_evaluations: int,
    ridge: float,
    name: ObjectiveName = "variance",
) -> JointSolution:
    """Return the 12 k - 4 parameters that maximise the contrast of the keyframes' common image.

    Args:
        keyframes: start; the first one's pose is held.
        plane: start; its distance is held.
        px_per_unit: cells per unit on the plane.
        free: mask (6,) over rotation and translation, of poses and velocities alike.
        solve_normal: also find the normal.
        blurs_px: Gaussian blurs of the stages, cells.
        max_evaluations: limit a stage.
        ridge: penalty per squared px that a keyframe moves from its start, in units of its share of the contrast:
            decides where the events do not.
        name: the objective.
    """
    kept, count, evaluations = tuple(keyframes), len(keyframes), 0
    canvas = canvas_of(kept, plane, px_per_unit)
    masks = [np.tile(free, 2) for _ in kept]
    masks[0] = masks[0] & (np.arange(12) >= 6)
    ends = np.cumsum([0] + [int(m.sum()) for m in masks])
    size = int(ends[-1])
    final = objective(name, blurs_px[-1])
    before = final(common_image(kept, plane, canvas))[0]
    for blur in blurs_px:
        cost = objective(name, blur)
        reference = max(cost(common_image(kept, plane, canvas))[0], 1e-12)
        start, start_plane = kept, plane
        steps = [_steps(k, plane, canvas, m) for k, m in zip(kept, masks, strict=True)]

        def place(
            z: Array,
            start: tuple[KeyframeEvents, ...] = start,
            steps: list[Array] = steps,
        ) -> tuple[tuple[KeyframeEvents, ...], Array, Array]:
            """Return the keyframes, their changes (K, 12) and the turn of the normal (2,) at parameters."""
            x = np.stack([B @ z[ends[i] : ends[i + 1]] for i, B in enumerate(steps)])
            delta = z[size:] * _NORMAL_SCALE if solve_normal else np.zeros(2)
            return tuple(_moved(k, x[i]) for i, k in enumerate(start)), x, delta

        def negative(
            z: Array,
            cost: Objective = cost,
            reference: float = reference,
            start: tuple[KeyframeEvents, ...] = start,
            start_plane: Plane = start_plane,
            steps: list[Array] = steps,
            place: Callable[[Array], tuple[tuple[KeyframeEvents, ...], Array, Array]] = place,
        ) -> tuple[float, Array]:
            moved, x, delta = place(z)
            tilted = Plane(normal=turn_normal(start_plane.normal, delta), distance=start_plane.distance)
            d_normal = turn_normal_derivative(start_plane.normal, delta)
            value, slopes, by_normal = joint_contrast(moved, tilted, canvas, cost, d_normal)
            gradient = np.empty(len(z))
            for i, (k, B) in enumerate(zip(moved, steps, strict=True)):
                # From the local derivatives at the moved pose to those by its parameters at the start.
                slopes[i, :3] = se3.left_jacobian_so3(x[i, :3]) @ slopes[i, :3]
                slopes[i, 3:6] = start[i].T_world_camera[:3, :3].T @ k.T_world_camera[:3, :3] @ slopes[i, 3:6]
                gradient[ends[i] : ends[i + 1]] = -B.T @ slopes[i]
            gradient[size:] = -by_normal[: len(z) - size] * _NORMAL_SCALE
            weight = np.full(len(z), ridge / count)
            weight[size:] = ridge
            return -value / reference + float(weight @ (z * z)), gradient / reference + 2 * weight * z

        turns = 2 if solve_normal else 0
        found = minimize(
            negative,
            np.zeros(size + turns),
            bounds=[(-_REACH * blur, _REACH * blur)] * size + [(-_TILT_REACH, _TILT_REACH)] * turns,
            jac=True,
            method="L-BFGS-B",
            options={"maxfun": max_evaluations, "ftol": 1e-6, "gtol": 1e-6},
        )
        evaluations += int(found.nfev)
        kept, _, delta = place(found.x)
        plane = Plane(normal=turn_normal(plane.normal, delta), distance=plane.distance)
    return JointSolution(
        keyframes=kept,
        plane=plane,
        contrast_before=before,
        contrast_after=final(common_image(kept, plane, canvas))[0],
        evaluations=evaluations,
    )


def _moved(keyframe: KeyframeEvents, x: Array) -> KeyframeEvents:
    """Return a keyframe with its pose and velocities changed by (12,): rotation, position, omega, velocity."""
    T = keyframe.T_world_camera
    R = T[:3, :3]
    return KeyframeEvents(
        bearings=keyframe.bearings,
        t_s=keyframe.t_s,
        duration_s=keyframe.duration_s,
        T_world_camera=se3.pose(R @ se3.exp_so3(x[:3]), T[:3, 3] + R @ x[3:6]),
        omega=keyframe.omega + x[6:9],
        velocity=keyframe.velocity + x[9:],
    )
