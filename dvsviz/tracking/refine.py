"""Edge bundle adjustment: all keyframe poses and the plane's normal from the edges they share.

Landmarks are ridge pixels of the map with one parameter each, the offset along the edge's normal. The residual of an
event is its distance to the landmark's line; the offsets are eliminated by the Schur complement, all poses and the
normal are solved together. Gauge: the first keyframe's pose and the plane's distance are held (section 2.2.3 has
12k - 4 parameters; the velocities are taken from neighbouring poses instead).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

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
from dvsviz.tracking.edges import associate, bounds, find_ridges
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


def _to_cells(bearings: Array, T: Array, plane: Plane, scale: float) -> Array:
    """Return plane coordinates (N, 2) in cells from the map frame's origin."""
    H = homography_map_camera(T, plane)
    q = bearings @ H[:, :2].T + H[:, 2]
    return scale * q[:, :2] / q[:, 2:]


def _shown(
    bearings: list[Array], Ts: Array, plane: Plane, scale: float, is_face: bool
) -> tuple[list[int], list[Array], list[Array]]:
    """Return which views show something of a plane, their bearings there and the cells of those.

    All of all views, but on a face of a panorama, which is a part of what is seen.
    """
    if not is_face:
        cells = [_to_cells(b, T, plane, scale) for b, T in zip(bearings, Ts, strict=True)]
        return list(range(len(bearings))), bearings, cells
    views: list[int] = []
    shown: list[Array] = []
    found: list[Array] = []
    for k, (b, T) in enumerate(zip(bearings, Ts, strict=True)):
        n_camera = plane.normal @ T[:3, :3]
        ahead = b[b @ n_camera[:2] + n_camera[2] < -1e-3]
        cells = _to_cells(ahead, T, plane, scale)
        near = np.abs(cells).max(axis=1, initial=0.0) < c.FACE_REFINED * scale
        if near.any():
            views.append(k)
            shown.append(np.ascontiguousarray(ahead[near]))
            found.append(cells[near])
    return views, shown, found


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
    gate = c.REFINE_JUDGE_GATE_PX
    for face in faces or (plane,):
        _, shown, cells = _shown(bearings, Ts, face, scale, bool(faces))
        if len(cells) < 2:
            continue
        low, shape = bounds(cells)
        ridges = find_ridges(cells, low, shape, gate)
        if ridges is None:
            continue
        count = np.zeros((len(cells), len(ridges.xy)))
        mean = np.zeros_like(count)
        for k, points in enumerate(cells):
            sums = np.zeros((len(ridges.xy), 4))
            associate(points - low, shown[k], ridges.label, ridges.xy, ridges.normal, gate, sums)
            seen = sums[:, 0] >= c.REFINE_MIN_EVENTS
            count[k] = np.where(seen, np.minimum(sums[:, 0], c.REFINE_MAX_EVENTS), 0.0)
            mean[k] = np.where(seen, sums[:, 1] / np.maximum(sums[:, 0], 1.0), 0.0)
        shared = (count > 0).sum(axis=0) >= 2
        weight = count[:, shared]
        value = mean[:, shared]
        if not shared.any():
            continue
        centre = (weight * value).sum(axis=0) / weight.sum(axis=0)
        squares += float((weight * (value - centre) ** 2).sum())
        weights += float(weight.sum())
    if weights <= 0:
        return float("inf")
    nearness = plane.distance / float(np.mean(plane.distance + Ts[:, :3, 3] @ plane.normal))
    return float(np.sqrt(squares / weights)) * nearness


def _observations(
    bearings: list[Array],
    Ts: Array,
    plane: Plane,
    scale: float,
    gate: float,
    free: NDArray[np.bool_],
    is_face: bool,
) -> tuple[int, list[tuple[NDArray[Any], ...]]]:
    """Return the number of landmarks on a plane, and for each view (view, landmark, weight, residual, Jacobian)."""
    R_map_world = rotation_to_map(plane.normal)
    views, shown, cells = _shown(bearings, Ts, plane, scale, is_face)
    columns: list[tuple[NDArray[Any], ...]] = []
    if len(cells) < 2:
        return 0, columns
    low, shape = bounds(cells)
    ridges = find_ridges(cells, low, shape, gate)
    if ridges is None:
        return 0, columns
    L = len(ridges.xy)
    d_normal = turn_normal_derivative(plane.normal, np.zeros(2))
    for k, seen_by_k, points in zip(views, shown, cells, strict=True):
        sums = np.zeros((L, 4))
        associate(points - low, seen_by_k, ridges.label, ridges.xy, ridges.normal, gate, sums)
        seen = np.flatnonzero(sums[:, 0] >= c.REFINE_MIN_EVENTS)
        if len(seen) == 0:
            continue
        count = sums[seen, 0]
        mean = sums[seen, 1:] / count[:, None]
        J = np.empty((len(seen), 8))
        landmark_jacobians(
            np.ascontiguousarray(mean[:, 1:]),
            np.ascontiguousarray(Ts[k, :3, :3]),
            np.ascontiguousarray(Ts[k, :3, 3]),
            plane.normal,
            plane.distance,
            R_map_world,
            scale,
            ridges.normal[seen],
            d_normal,
            J,
        )
        J[:, :6][:, ~free] = 0.0
        weight = np.minimum(count, c.REFINE_MAX_EVENTS)
        # Huber on the mean residual of a landmark in a view.
        huber = 0.5 * gate
        weight = weight * np.where(np.abs(mean[:, 0]) > huber, huber / np.maximum(np.abs(mean[:, 0]), 1e-9), 1.0)
        columns.append((np.full(len(seen), k), seen, weight, mean[:, 0], J))
    return L, columns


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
    K, total = len(Ts), 0
    columns: list[tuple[NDArray[Any], ...]] = []
    for face in faces or (plane,):
        L, found = _observations(bearings, Ts, face, scale, gate, free, bool(faces))
        columns += [(k, seen + total, *rest) for k, seen, *rest in found]
        total += L
    if len(columns) < 2:
        return None
    view, landmark, weight, residual = (np.concatenate([col[i] for col in columns]) for i in range(4))
    J = np.concatenate([col[4] for col in columns])
    order = np.argsort(landmark, kind="stable")
    size = 6 * K + 2
    A, g = np.zeros((size, size)), np.zeros(size)
    reduce_normal_equations(
        view[order].astype(np.int64),
        landmark[order].astype(np.int64),
        weight[order],
        residual[order],
        np.ascontiguousarray(J[order]),
        A,
        g,
    )
    fixed = np.zeros(size, dtype=bool)
    fixed[: 6 * held] = True
    fixed[:-2] |= np.tile(~free, K)
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
    Ts = Ts.copy()
    for k in range(K):
        dx = x[6 * k : 6 * k + 6]
        R = Ts[k, :3, :3]
        Ts[k, :3, 3] += R @ dx[3:]
        Ts[k, :3, :3] = R @ se3.exp_so3(dx[:3])
    plane = Plane(normal=turn_normal(plane.normal, x[-2:]), distance=plane.distance)
    rms = float(np.sqrt(np.average(residual**2, weights=weight)))
    return Ts, plane, rms, total, float(limit)


def _offset(start: tuple[Array, Plane], Ts: Array, plane: Plane) -> Array:
    """Return how far (6 K + 2,) poses and normal have moved from the start, in the current tangent spaces."""
    R = Ts[:, :3, :3]
    R_start_now = np.swapaxes(start[0][:, :3, :3], 1, 2) @ R
    shift = np.einsum("kji,kj->ki", R, Ts[:, :3, 3] - start[0][:, :3, 3])
    tilt = tangent_basis(plane.normal).T @ (plane.normal - start[1].normal)
    return np.concatenate([np.concatenate([se3.log_so3(R_start_now), shift], axis=1).ravel(), tilt])
