"""Edge bundle adjustment: all poses and the plane's normal from the edges they share, and from their smooth motion.

Landmarks are ridge pixels of the map with one parameter each, the offset along the edge's normal. The residual of an
event is its distance to the landmark's line; the offsets are eliminated, all poses and the normal are solved together.
Gauge: the first view's pose and the plane's distance are held (section 2.2.3 has 12k - 4 parameters; the velocities are
taken from neighbouring poses instead).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

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
from dvsviz.tracking.edges import Ridges, Seen, Shown, ViewEvents, associate, find_ridges, show
from dvsviz.tracking.halves import ONE_CORE, Halves
from dvsviz.tracking.normal_equations import landmark_jacobians, solve_views
from dvsviz.tracking.sensor_distance import cells_per_unit, on_the_sensor, weigh
from dvsviz.tracking.smooth_motion import SmoothMotion

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A window as the refinement sees it: de-skewed bearings at one pose.

    Attributes:
        bearings: (N, 2) float32, all events moved to the time of the pose.
        T_world_camera: pose (4, 4).
        t_s: its time; views of one time are not tied to each other.
    """

    bearings: NDArray[np.float32]
    T_world_camera: Array
    t_s: float = 0.0


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
        """True where the held-out disagreement fell; where windows are few, where it hardly rose."""
        worse = c.REFINE_EARLY_WORSE if len(self.Ts_world_camera) < c.REFINE_EARLY_VIEWS else 1.0
        return self.after_px < worse * self.before_px


def refine(
    views: list[View],
    plane: Plane,
    px_per_unit: float,
    *,
    free: NDArray[np.bool_],
    solve_normal: bool = True,
    held: int = 1,
    rounds: int = c.REFINE_ROUNDS,
    closing: int = c.REFINE_CLOSING,
    faces: Sequence[Plane] = (),
    rounds_with_all: int = 0,
    is_anchored: bool = False,
    stop: Callable[[], bool] | None = None,
    halves: Halves = ONE_CORE,
) -> Refinement:
    """Return the poses of the views and the plane that bring the views' edges together.

    Args:
        views: in time order; half of each one's events are held out to judge the result.
        plane: start, in the world.
        px_per_unit: the sensor's pixels per unit of a bearing.
        free: mask (6,) of rotation and position to refine.
        solve_normal: also refine the normal.
        held: how many of the first views keep their pose (at least 1, the gauge).
        rounds: association and solving, repeated.
        closing: rounds over which the gate closes; the rest converge with it closed.
        faces: of a panorama: the planes on which edges are looked for instead, all poses solved together; the normal is
            then not refined.
        rounds_with_all: more rounds, with the events that were held out too, once they have judged the result.
        is_anchored: poses are pulled to the world's origin, not to where they start, and no events are held out.
        stop: asked before each round: no more rounds where it is true.
        halves: on how many cores.
    """
    Ts = np.stack([v.T_world_camera for v in views])
    train, test = (ViewEvents.of([v.bearings[k::2] for v in views]) for k in (0, 1))
    if is_anchored:
        train = ViewEvents.of([v.bearings for v in views])
    motion = SmoothMotion.between(np.array([v.t_s for v in views]), Ts)
    start = _Start(Ts_world_camera=Ts, deviation=c.REFINE_PRIOR_POSE, plane=plane, motion=motion)
    if is_anchored:
        start = replace(start, Ts_world_camera=np.tile(np.eye(4), (len(Ts), 1, 1)), deviation=c.SETTLE_PRIOR_POSE)
    before = disagreement(test, Ts, plane, px_per_unit, faces, halves)
    gates = np.geomspace(c.REFINE_GATE_START_PX, c.REFINE_GATE_END_PX, closing)
    residual, landmarks, done = float("nan"), 0, 0
    for i in range(rounds):
        if stop is not None and stop():
            break
        gate = float(gates[min(i, closing - 1)])
        step = _round(train, Ts, plane, start, px_per_unit, gate, free, solve_normal, held, faces, halves)
        if step is None:
            break
        Ts, plane, residual, landmarks, size = step
        done += 1
        if i >= closing and size < c.REFINE_STEP:
            break
    after = disagreement(test, Ts, plane, px_per_unit, faces, halves)
    everything = ViewEvents.of([v.bearings for v in views]) if rounds_with_all and after < before else train
    for _ in range(rounds_with_all if after < before else 0):
        gate = c.REFINE_GATE_END_PX
        step = _round(everything, Ts, plane, start, px_per_unit, gate, free, solve_normal, held, faces, halves)
        if step is None:
            break
        Ts, plane, residual, landmarks, _ = step
        done += 1
    return Refinement(
        Ts_world_camera=Ts,
        plane=plane,
        before_px=before,
        after_px=after,
        residual_px=residual,
        landmarks=landmarks,
        rounds=done,
    )


def _shown(events: ViewEvents, Ts: Array, plane: Plane, scale: float, is_face: bool, halves: Halves) -> Shown:
    """Return what the views show of a plane: all of all views, but on a face of a panorama what is near to it."""
    views = np.arange(len(Ts))
    if is_face:
        near = [_on_face(events.of_view(k), T, plane) for k, T in enumerate(Ts)]
        seen = [k for k, some in enumerate(near) if some.any()]
        views, events = np.array(seen, dtype=np.int64), ViewEvents.of([events.of_view(k)[near[k]] for k in seen])
    H = np.array([homography_map_camera(Ts[k], plane) for k in views]).reshape(-1, 3, 3)
    return show(events, views, np.array([[scale], [scale], [1.0]]) * H, halves)


def _on_face(bearings: NDArray[np.float32], T: Array, plane: Plane) -> NDArray[np.bool_]:
    """Return which bearings (N, 2) of a view lie on a face of a panorama."""
    n_camera = plane.normal @ T[:3, :3]
    ahead = bearings @ n_camera[:2] + n_camera[2] < -1e-3
    H = homography_map_camera(T, plane)
    q = bearings @ H[:, :2].T + H[:, 2]
    return ahead & (np.abs(q[:, :2]) < c.FACE_REFINED * q[:, 2:]).all(axis=1)


def _landmarks(shown: Shown, gate: float, halves: Halves) -> tuple[Ridges, Seen] | None:
    """Return the ridges that views show together, and what each view saw of them."""
    if len(shown.views) < 2:
        return None
    ridges = find_ridges(shown, gate, halves)
    return None if ridges is None else (ridges, associate(shown, ridges, gate, halves))


def disagreement(
    events: ViewEvents,
    Ts: Array,
    plane: Plane,
    scale: float,
    faces: Sequence[Plane] = (),
    halves: Halves = ONE_CORE,
) -> float:
    """Return how far (sensor px, RMS) the views disagree on where their shared edges lie.

    A view that draws near to the plane, or faces it squarely, becomes smaller on the map and disagrees less there for
    that reason alone: the map is made with cells as large as the sensor's pixels are on it, and distances are taken
    back to the sensor. Each view's mean distance to a landmark is compared with the landmark's mean over all views;
    landmarks and views are those of a fixed gate, so that what is judged does not depend on how it was found.
    """
    squares, weights = 0.0, 0.0
    for face in faces or (plane,):
        cells = scale if faces else cells_per_unit(events, Ts, face, scale)
        shown = _shown(events, Ts, face, cells, bool(faces), halves)
        found = _landmarks(shown, c.REFINE_JUDGE_GATE_PX, halves)
        if found is None:
            continue
        ridges, seen = found
        shared = np.diff(seen.first)[seen.landmark] >= 2
        landmark, view, mean = seen.landmark[shared], shown.views[seen.view[shared]], seen.mean[shared]
        weight, value = np.minimum(mean[:, 0], c.REFINE_MAX_EVENTS), mean[:, 1]
        px_per_cell, _ = on_the_sensor(mean, view, Ts, face, cells, ridges.normal[landmark], scale, halves)
        off_px = px_per_cell * (value - _centres(landmark, weight * px_per_cell**2, value)[landmark])
        squares += float((weight * off_px**2).sum())
        weights += float(weight.sum())
    return float(np.sqrt(squares / weights)) if weights > 0 else float("inf")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Start:
    """What a refinement leaves only for good reason.

    Attributes:
        Ts_world_camera: poses (K, 4, 4).
        deviation: how far from them, standard deviation, rad and plane distances.
        plane: and its normal.
        motion: how even the poses' motion is.
    """

    Ts_world_camera: Array
    deviation: float
    plane: Plane
    motion: SmoothMotion


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Observations:
    """Landmarks as views saw them.

    Attributes:
        first: of each landmark its first observation (L + 1,).
        view: of each observation (M,).
        weight: the same (M,) float32.
        residual: distance (M,) float32, map px.
        J: its derivative (M, 8) float32 by the view's pose, moved in the world, and the plane's normal.
    """

    first: NDArray[np.int64]
    view: NDArray[np.int64]
    weight: NDArray[np.float32]
    residual: NDArray[np.float32]
    J: NDArray[np.float32]


def _observations(
    events: ViewEvents, Ts: Array, plane: Plane, focal_px: float, gate: float, is_face: bool, halves: Halves
) -> _Observations | None:
    scale = focal_px if is_face else cells_per_unit(events, Ts, plane, focal_px)
    shown = _shown(events, Ts, plane, scale, is_face, halves)
    found = _landmarks(shown, gate, halves)
    if found is None:
        return None
    ridges, seen = found
    view, mean = shown.views[seen.view], seen.mean
    normals = ridges.normal[seen.landmark]
    # What is read in each iteration of the solver, in half the bytes.
    J = np.empty((len(view), 8), dtype=np.float32)
    landmark_jacobians(
        np.ascontiguousarray(mean[:, 2:]),
        view,
        np.ascontiguousarray(Ts[:, :3, :3]),
        np.ascontiguousarray(Ts[:, :3, 3]),
        plane.normal,
        plane.distance,
        rotation_to_map(plane.normal),
        scale,
        normals,
        turn_normal_derivative(plane.normal, np.zeros(2)),
        J,
    )
    weight, residual = np.minimum(mean[:, 0], c.REFINE_MAX_EVENTS), np.ascontiguousarray(mean[:, 1])
    px_per_cell, d_log = on_the_sensor(mean, view, Ts, plane, scale, normals, focal_px, halves)
    # What is brought down is the distance on the sensor. On the map all views together would draw near to the plane to
    # make their distances smaller: poster textures were flown into by a quarter of their distance. Huber on the mean
    # residual of a landmark in a view.
    weigh(seen.first, px_per_cell, d_log, 0.5 * gate, weight, residual, J)
    return _Observations(
        first=seen.first, view=view, weight=weight.astype(np.float32), residual=residual.astype(np.float32), J=J
    )


def _centres(landmark: NDArray[np.int64], weight: Array, value: Array) -> Array:
    """Return the weighted mean (L,) of the values (M,) of each landmark's observations."""
    return np.bincount(landmark, weight * value) / np.maximum(np.bincount(landmark, weight), 1e-9)


def _together(parts: list[_Observations]) -> _Observations:
    """Return the observations of several faces as one."""
    if len(parts) == 1:
        return parts[0]
    before = np.cumsum([0, *(len(p.view) for p in parts)])
    return _Observations(
        first=np.concatenate([*(p.first[:-1] + k for p, k in zip(parts, before, strict=False)), before[-1:]]),
        view=np.concatenate([p.view for p in parts]),
        weight=np.concatenate([p.weight for p in parts]),
        residual=np.concatenate([p.residual for p in parts]),
        J=np.concatenate([p.J for p in parts]),
    )


def _round(
    events: ViewEvents,
    Ts: Array,
    plane: Plane,
    start: _Start,
    scale: float,
    gate: float,
    free: NDArray[np.bool_],
    solve_normal: bool,
    held: int,
    faces: Sequence[Plane],
    halves: Halves,
) -> tuple[Array, Plane, float, int, float] | None:
    parts = [_observations(events, Ts, face, scale, gate, bool(faces), halves) for face in faces or (plane,)]
    seen = _together([p for p in parts if p is not None]) if any(p is not None for p in parts) else None
    if seen is None or not seen.weight.sum() > 0:
        return None
    residual_px = float(np.sqrt(seen.weight @ seen.residual**2 / seen.weight.sum()))
    live = np.concatenate([np.tile(free, len(Ts)), [solve_normal] * 2])
    live[: 6 * held] = False
    # In units of an observation's variance.
    strength = c.REFINE_CORRELATED * c.REFINE_VARIANCE_PX2
    prior = np.full(len(live), strength / start.deviation**2 * min(1.0, c.REFINE_PRIOR_VIEWS / len(Ts)))
    prior[-2:] = strength / c.REFINE_PRIOR_NORMAL_RAD**2
    gradient = prior * _offset(start.Ts_world_camera, start.plane, Ts, plane)
    motion = start.motion
    gradient[:-2] += strength * motion.gradient(Ts)
    x = solve_views(
        seen.first,
        seen.view,
        seen.weight,
        seen.residual,
        seen.J,
        prior,
        gradient,
        motion.middle,
        motion.tie,
        strength * motion.information,
        live,
        c.REFINE_ITERATIONS,
        c.REFINE_TOLERANCE,
    )
    limit = np.abs(x).max()
    if limit > 0.2:
        x *= 0.2 / limit
    dx = x[:-2].reshape(-1, 6)
    Ts = Ts.copy()
    Ts[:, :3, 3] += dx[:, 3:]
    Ts[:, :3, :3] = se3.exp_so3(dx[:, :3]) @ Ts[:, :3, :3]
    plane = Plane(normal=turn_normal(plane.normal, x[-2:]), distance=plane.distance)
    return Ts, plane, residual_px, len(seen.first) - 1, float(limit)


def _offset(Ts_start: Array, plane_start: Plane, Ts: Array, plane: Plane) -> Array:
    """Return how far (6 K + 2,), in the world, poses and normal have moved from the start."""
    turned = se3.log_so3(Ts[:, :3, :3] @ np.swapaxes(Ts_start[:, :3, :3], 1, 2))
    tilt = tangent_basis(plane.normal).T @ (plane.normal - plane_start.normal)
    return np.concatenate([np.concatenate([turned, Ts[:, :3, 3] - Ts_start[:, :3, 3]], axis=1).ravel(), tilt])
