"""Edge bundle adjustment: all keyframe poses and the plane's normal from the edges they share.

Landmarks are ridge pixels of the map with one parameter each, the offset along the edge's normal. The residual of an
event is its distance to the landmark's line; the offsets are eliminated by the Schur complement, all poses and the
normal are solved together. Gauge: the first keyframe's pose and the plane's distance are held (section 2.2.3 has
12k - 4 parameters; the velocities are taken from neighbouring poses instead).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.plane import (
    Plane,
    homography_map_camera,
    rotation_to_map,
    tangent_basis,
    turn_normal,
    turn_normal_derivative,
)
from dvsviz.tracking import constants as c
from dvsviz.tracking.edges import Ridges, Shown, associate, bounds, find_ridges, means, to_cells
from dvsviz.tracking.normal_equations import landmark_jacobians, reduce_normal_equations, solve_positive

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A keyframe as the refinement sees it: de-skewed bearings at one pose.

    Attributes:
        bearings: (N, 2), all events moved to the time of the pose.
        T_world_camera: pose (4, 4).
    """

    bearings: Array
    T_world_camera: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement:
    """Refined poses and plane.

    Attributes:
        Ts_world_camera: poses (K, 4, 4) of the views.
        plane: the refined plane in the world.
        before_px: disagreement of the views on held-out events at the start, px RMS.
        after_px: the same after refinement.
        residual_px: RMS distance of events to their edges in the last round, map px.
        landmarks: ridge pixels used in the last round.
        rounds: rounds done.
    """

    Ts_world_camera: Array
    plane: Plane
    before_px: float
    after_px: float
    residual_px: float
    landmarks: int
    rounds: int

    @property
    def accepted(self) -> bool:
        """True where the held-out disagreement fell."""
        return self.after_px < self.before_px


def refine(
    views: list[View],
    plane: Plane,
    px_per_unit: float,
    *,
    free: NDArray[np.bool_],
    solve_normal: bool = True,
    held: int = 1,
    rounds: int = c.REFINE_ROUNDS,
    faces: Sequence[Plane] = (),
    stop: Callable[[], bool] | None = None,
) -> Refinement:
    """Return the poses of the views and the plane that bring the views' edges together.

    Args:
        views: keyframes; half of each one's events are held out to judge the result.
        plane: start, in the world.
        px_per_unit: resolution of the map, cells per unit.
        free: mask (6,) of rotation and position to refine.
        solve_normal: also refine the normal.
        held: how many of the first views keep their pose (at least 1, the gauge).
        rounds: association and solving, repeated.
        faces: of a panorama: the planes on which edges are looked for instead, all poses solved together; the normal is
            then not refined.
        stop: asked before each round: no more rounds where it is true.
    """
    Ts = np.stack([v.T_world_camera for v in views])
    train = [np.ascontiguousarray(v.bearings[0::2]) for v in views]
    test = [np.ascontiguousarray(v.bearings[1::2]) for v in views]
    start = (Ts, plane)
    before = disagreement(test, Ts, plane, px_per_unit, faces)
    # The gate closes over the first rounds; the rest converge with it closed.
    gates = np.geomspace(c.REFINE_GATE_START_PX, c.REFINE_GATE_END_PX, 4)
    residual, landmarks, done = float("nan"), 0, 0
    for i in range(rounds):
        if stop is not None and stop():
            break
        gate = float(gates[min(i, 3)])
        step = _round(train, Ts, plane, start, px_per_unit, gate, free, solve_normal, held, faces)
        if step is None:
            break
        Ts, plane, residual, landmarks, size = step
        done += 1
        if i >= 4 and size < c.REFINE_STEP:
            break
    return Refinement(
        Ts_world_camera=Ts,
        plane=plane,
        before_px=before,
        after_px=disagreement(test, Ts, plane, px_per_unit, faces),
        residual_px=residual,
        landmarks=landmarks,
        rounds=done,
    )


def _shown(bearings: list[Array], Ts: Array, plane: Plane, scale: float, is_face: bool) -> Shown:
    """Return what the views show of a plane: all of all views, but on a face of a panorama what is near to it."""
    views = list(range(len(bearings)))
    if is_face:
        near = [_on_face(b, T, plane) for b, T in zip(bearings, Ts, strict=True)]
        views = [k for k in views if near[k].any()]
        bearings = [bearings[k][near[k]] for k in views]
    together = np.concatenate([np.zeros((0, 2)), *bearings])
    first = np.cumsum([0, *map(len, bearings)])
    cells = np.empty_like(together)
    H = np.array([homography_map_camera(Ts[k], plane) for k in views]).reshape(-1, 3, 3)
    to_cells(together, first, np.array([[scale], [scale], [1.0]]) * H, cells)
    return Shown(views=np.array(views, dtype=np.int64), first=first, bearings=together, cells=cells)


def _on_face(bearings: Array, T: Array, plane: Plane) -> NDArray[np.bool_]:
    """Return which bearings (N, 2) of a view lie on a face of a panorama."""
    n_camera = plane.normal @ T[:3, :3]
    ahead = bearings @ n_camera[:2] + n_camera[2] < -1e-3
    H = homography_map_camera(T, plane)
    q = bearings @ H[:, :2].T + H[:, 2]
    return ahead & (np.abs(q[:, :2]) < c.FACE_REFINED * q[:, 2:]).all(axis=1)


def _landmarks(shown: Shown, gate: float) -> tuple[Ridges, Array] | None:
    """Return the ridges that views show together, and for each ridge and view (L, V, 4) what `associate` sums."""
    if len(shown.views) < 2:
        return None
    low, shape = bounds(shown.cells)
    cells = shown.cells - low
    ridges = find_ridges(cells, shape, gate)
    if ridges is None:
        return None
    sums = np.zeros((len(ridges.xy), len(shown.views), 4))
    associate(cells, shown.bearings, shown.first, ridges.label, ridges.xy, ridges.normal, gate, sums)
    return ridges, sums


def disagreement(
    bearings: list[Array], Ts: Array, plane: Plane, scale: float, faces: Sequence[Plane] = ()
) -> float:
    """Return how far (sensor px, RMS) the views disagree on where their shared edges lie.

    A view that draws near to the plane becomes smaller on the map, and disagrees less there for that reason alone:
    map px are taken back to the sensor's by the views' mean distance. Each view's mean distance to a landmark is
    compared with the landmark's mean over all views; landmarks and views are those of a fixed gate, so that what is
    judged does not depend on how it was found.
    """
    squares, weights = 0.0, 0.0
    for face in faces or (plane,):
        found = _landmarks(_shown(bearings, Ts, face, scale, bool(faces)), c.REFINE_JUDGE_GATE_PX)
        if found is None:
            continue
        landmark, _, mean = means(found[1], c.REFINE_MIN_EVENTS)
        shared = np.bincount(landmark)[landmark] >= 2
        landmark, weight, value = (
            landmark[shared],
            np.minimum(mean[shared, 0], c.REFINE_MAX_EVENTS),
            mean[shared, 1],
        )
        total = np.bincount(landmark, weight)
        centre = np.bincount(landmark, weight * value) / np.maximum(total, 1e-9)
        squares += float((weight * (value - centre[landmark]) ** 2).sum())
        weights += float(weight.sum())
    if weights <= 0:
        return float("inf")
    nearness = plane.distance / float(np.mean(plane.distance + Ts[:, :3, 3] @ plane.normal))
    return float(np.sqrt(squares / weights)) * nearness


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Observations:
    """Landmarks as views saw them.

    Attributes:
        view: of each observation (M,).
        landmark: the same (M,), increasing.
        weight: the same (M,).
        residual: distance (M,), map px.
        J: its derivative (M, 8) by the view's pose and the plane's normal.
        landmarks: how many there are.
    """

    view: NDArray[np.int64]
    landmark: NDArray[np.int64]
    weight: Array
    residual: Array
    J: Array
    landmarks: int


def _observations(
    bearings: list[Array],
    Ts: Array,
    plane: Plane,
    scale: float,
    gate: float,
    free: NDArray[np.bool_],
    is_face: bool,
) -> _Observations | None:
    shown = _shown(bearings, Ts, plane, scale, is_face)
    found = _landmarks(shown, gate)
    if found is None:
        return None
    ridges, sums = found
    landmark, row, mean = means(sums, c.REFINE_MIN_EVENTS)
    view = shown.views[row]
    J = np.empty((len(view), 8))
    landmark_jacobians(
        np.ascontiguousarray(mean[:, 2:]),
        view,
        np.ascontiguousarray(Ts[:, :3, :3]),
        np.ascontiguousarray(Ts[:, :3, 3]),
        plane.normal,
        plane.distance,
        rotation_to_map(plane.normal),
        scale,
        ridges.normal[landmark],
        turn_normal_derivative(plane.normal, np.zeros(2)),
        J,
    )
    J[:, :6][:, ~free] = 0.0
    weight, residual = np.minimum(mean[:, 0], c.REFINE_MAX_EVENTS), np.ascontiguousarray(mean[:, 1])
    # Huber on the mean residual of a landmark in a view.
    huber, off = 0.5 * gate, np.abs(residual)
    weight *= np.where(off > huber, huber / np.maximum(off, 1e-9), 1.0)
    return _Observations(
        view=view, landmark=landmark, weight=weight, residual=residual, J=J, landmarks=len(ridges.xy)
    )


def _round(
    bearings: list[Array],
    Ts: Array,
    plane: Plane,
    start: tuple[Array, Plane],
    scale: float,
    gate: float,
    free: NDArray[np.bool_],
    solve_normal: bool,
    held: int,
    faces: Sequence[Plane],
) -> tuple[Array, Plane, float, int, float] | None:
    size = 6 * len(Ts) + 2
    A, g = np.zeros((size, size)), np.zeros(size)
    squares, weights, total = 0.0, 0.0, 0
    for face in faces or (plane,):
        seen = _observations(bearings, Ts, face, scale, gate, free, bool(faces))
        if seen is None:
            continue
        reduce_normal_equations(seen.view, seen.landmark, seen.weight, seen.residual, seen.J, seen.landmarks, A, g)
        squares += float(seen.weight @ seen.residual**2)
        weights += float(seen.weight.sum())
        total += seen.landmarks
    if weights <= 0:
        return None
    fixed = np.zeros(size, dtype=bool)
    fixed[: 6 * held] = True
    fixed[:-2] |= np.tile(~free, len(Ts))
    fixed[-2:] = not solve_normal
    strength = c.REFINE_CORRELATED * c.REFINE_VARIANCE_PX2
    prior = np.full(size, strength / c.REFINE_PRIOR_POSE**2)
    prior[-2:] = strength / c.REFINE_PRIOR_NORMAL_RAD**2
    A[np.diag_indices(size)] += prior
    g += prior * _offset(start, Ts, plane)
    live = ~fixed
    x = np.zeros(size)
    x[live] = solve_positive(A[np.ix_(live, live)], -g[live])
    limit = np.abs(x).max()
    if limit > 0.2:
        x *= 0.2 / limit
    dx = x[:-2].reshape(-1, 6)
    Ts, R = Ts.copy(), Ts[:, :3, :3]
    Ts[:, :3, 3] += np.einsum("kij,kj->ki", R, dx[:, 3:])
    Ts[:, :3, :3] = R @ se3.exp_so3(dx[:, :3])
    plane = Plane(normal=turn_normal(plane.normal, x[-2:]), distance=plane.distance)
    return Ts, plane, float(np.sqrt(squares / weights)), total, float(limit)


def _offset(start: tuple[Array, Plane], Ts: Array, plane: Plane) -> Array:
    """Return how far (6 K + 2,) poses and normal have moved from the start, in the current tangent spaces."""
    R = Ts[:, :3, :3]
    R_start_now = np.swapaxes(start[0][:, :3, :3], 1, 2) @ R
    shift = np.einsum("kji,kj->ki", R, Ts[:, :3, 3] - start[0][:, :3, 3])
    tilt = tangent_basis(plane.normal).T @ (plane.normal - start[1].normal)
    return np.concatenate([np.concatenate([se3.log_so3(R_start_now), shift], axis=1).ravel(), tilt])
