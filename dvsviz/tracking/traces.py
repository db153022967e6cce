"""What the tracker remembers of past windows: sampled events and the pose, enough to rebuild the map and refine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from dvsviz.contrast.iwe import warp_points
from dvsviz.contrast.warp import Warp
from dvsviz.geometry import se3
from dvsviz.geometry.plane import Plane, homography_map_camera, points_to_map
from dvsviz.tracking import constants as c
from dvsviz.tracking.kernels import map_nodes, reach
from dvsviz.tracking.planar_map import PlanarMap

Array = NDArray[np.float64]

# Nodes a window: the homography is interpolated linearly between them; 4 intervals keep a turn of 0.1 rad in one
# window exact to 1e-4 rad.
_NODES = 5

# Longest time between two windows, s, across which the camera moved on: over a gap a difference is no velocity.
_JOINED_S = 0.4

HELD = -2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """A tracked window.

    Attributes:
        window: its number.
        first_event: index of its first event in the recording.
        start_us: time of its first event.
        mid_us: time of its pose.
        duration_s: its length.
        T_world_camera: pose (4, 4) at `mid_us`.
        omega: angular velocity (3,) at `mid_us`, camera frame.
        velocity: linear velocity (3,) at `mid_us`, camera frame.
        bearings: sampled events (N, 2) float32.
        t_s: their times (N,) since `start_us`.
        events: how many events the window had: what the sample stands for.
        heard: share of them that were no noise.
        keyframe: its keyframe number, or -1; `HELD` where it said nothing and its pose must not be asked of its events.
        is_trusted: True where it may write to the map.
    """

    window: int
    first_event: int
    start_us: int
    mid_us: int
    duration_s: float
    T_world_camera: Array
    omega: Array
    velocity: Array
    bearings: NDArray[np.float32]
    t_s: Array
    events: int
    heard: float = 1.0
    keyframe: int = -1
    is_trusted: bool = True

    @property
    def mid_s(self) -> float:
        """Time of the pose since `start_us`."""
        return (self.mid_us - self.start_us) * 1e-6

    @property
    def T_world_start(self) -> Array:
        """The pose (4, 4) at the first event: the pose of the window."""
        return se3.propagate(self.T_world_camera, self.omega, self.velocity, -self.mid_s)

    def warp(self, plane: Plane, target: Array) -> Warp:
        """Return the warp of its events onto a plane; `target` (3, 3) takes plane coordinates to pixels."""
        nodes = np.empty((_NODES, 3, 3))
        map_nodes(
            np.ascontiguousarray(self.T_world_camera[:3, :3]),
            np.ascontiguousarray(self.T_world_camera[:3, 3]),
            self.omega,
            self.velocity,
            plane.normal,
            plane.distance,
            target @ points_to_map(plane),
            -self.mid_s,
            max(self.duration_s, 1e-6),
            nodes,
        )
        scale = (_NODES - 1) / max(self.duration_s, 1e-6)
        return Warp(nodes=nodes, scale=scale, d_nodes=np.zeros((0, *nodes.shape)))

    def deskewed(self, plane: Plane, step: int = 1) -> NDArray[np.float32]:
        """Return every so manieth of the bearings (N, 2) float32, moved to the time of the pose."""
        back = np.asarray(np.linalg.inv(homography_map_camera(self.T_world_camera, plane)), dtype=np.float64)
        some, t_s = np.ascontiguousarray(self.bearings[::step]), np.ascontiguousarray(self.t_s[::step])
        bearings = warp_points(some, t_s, self.warp(plane, back))
        seen = np.isfinite(bearings[:, 0])
        return bearings if seen.all() else bearings[seen]


def correct(traces: Sequence[Trace], poses: dict[int, Array]) -> list[Trace]:
    """Return the traces re-expressed after some of them moved.

    A correction `T_new T_old^-1` is interpolated in time between windows that have one and held outside them. By how
    much one window alone was off is not its neighbours' error: what is handed on is the median of three corrections.
    Velocities follow from the corrected neighbours.

    Args:
        traces: in time order.
        poses: refined poses (4, 4) by window.
    """
    # Of windows at one time, as coarse clocks make them, the last one's correction holds.
    anchors = list({t.mid_us: t for t in traces if t.window in poses}.values())
    if not anchors:
        return list(traces)
    C = np.stack([poses[t.window] @ se3.inverse(t.T_world_camera) for t in anchors])
    # The correction's translation is taken where the camera is, not at the world's origin.
    shift = np.stack([poses[t.window][:3, 3] - t.T_world_camera[:3, 3] for t in anchors])
    s = np.array([(t.mid_us - traces[0].mid_us) * 1e-6 for t in anchors])
    at = np.array([(t.mid_us - traces[0].mid_us) * 1e-6 for t in traces])
    inside = np.clip(at, s[0], s[-1])
    turn = se3.log_so3(C[:, :3, :3])
    if len(anchors) > 1:
        R = Slerp(s, Rotation.from_rotvec(_medians(turn)))(inside).as_matrix()
    else:
        R = np.repeat(C[:, :3, :3], len(traces), axis=0)
    d = np.stack([np.interp(inside, s, column) for column in _medians(shift).T], axis=-1)
    Ts = np.stack([t.T_world_camera for t in traces])
    moved = se3.pose(R @ Ts[:, :3, :3], Ts[:, :3, 3] + d)
    own = {t.window for t in anchors}
    for i, trace in enumerate(traces):
        if trace.window in own:
            moved[i] = poses[trace.window]
    return with_poses(traces, moved)


def _medians(rows: Array) -> Array:
    """Return the medians of three neighbouring rows (N, 3), number by number; the first and the last stay."""
    if len(rows) < 3:
        return rows
    inner = np.median(np.stack([rows[:-2], rows[1:-1], rows[2:]]), axis=0)
    return np.concatenate([rows[:1], inner, rows[-1:]])


def with_poses(traces: Sequence[Trace], Ts_world_camera: Array) -> list[Trace]:
    """Return the traces with new poses (N, 4, 4) at their middles, their velocities by central differences."""
    if not traces:
        return []
    n = len(traces)
    a, b = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
    mid_us = np.array([t.mid_us for t in traces])
    dt = (mid_us[b] - mid_us[a]) * 1e-6
    # Over a gap what was tracked is kept.
    known = (dt > 0) & (dt < _JOINED_S)
    by_dt = 1.0 / np.where(known, dt, 1.0)[:, None]
    R, p = Ts_world_camera[:, :3, :3], Ts_world_camera[:, :3, 3]
    omega = se3.log_so3(np.swapaxes(R[a], 1, 2) @ R[b]) * by_dt
    velocity = np.einsum("kji,kj->ki", R, p[b] - p[a]) * by_dt
    return [
        replace(t, T_world_camera=Ts_world_camera[i], omega=omega[i], velocity=velocity[i])
        if known[i]
        else replace(t, T_world_camera=Ts_world_camera[i])
        for i, t in enumerate(traces)
    ]


def window_poses(traces: Sequence[Trace]) -> list[tuple[int, Array]]:
    """Return each trace's window and its pose (4, 4) at the window's start.

    A window begins where the one before ends, half way between two poses that were solved for: there the cubic through
    both with their velocities (Hermite) is taken, which an acceleration does not bend away as it does a step back from
    the middle. After a gap that step is all there is.
    """
    if not traces:
        return []
    Ts = np.stack([t.T_world_camera for t in traces])
    R, p = Ts[:, :3, :3], Ts[:, :3, 3]
    omega, velocity = np.stack([t.omega for t in traces]), np.stack([t.velocity for t in traces])
    velocity = np.einsum("kij,kj->ki", R, velocity)
    back = np.array([t.mid_s for t in traces])[:, None]
    starts = se3.pose(R @ se3.exp_so3(-back * omega), p - velocity * back)
    dt = np.diff([t.mid_us for t in traces])[:, None] * 1e-6
    joined = np.flatnonzero((dt[:, 0] > 0) & (dt[:, 0] < _JOINED_S) & (back[1:, 0] < dt[:, 0]))
    if len(joined):
        a, b, dt = joined, joined + 1, dt[joined]
        s = 1.0 - back[b] / dt
        turn = se3.log_so3(np.swapaxes(R[a], 1, 2) @ R[b])
        before, after = s * (1 - s) ** 2 * dt, s**2 * (s - 1) * dt
        share = s**2 * (3 - 2 * s)
        starts[b, :3, :3] = R[a] @ se3.exp_so3(share * turn + before * omega[a] + after * omega[b])
        starts[b, :3, 3] = p[a] + share * (p[b] - p[a]) + before * velocity[a] + after * velocity[b]
    return [(t.window, T) for t, T in zip(traces, starts, strict=True)]


def add_to_map(planar_map: PlanarMap, trace: Trace, sensor: tuple[int, int], K: Array) -> None:
    """Add a trace's events to the map, each standing for `heard * events / len(bearings)` events.

    Args:
        planar_map: grown where needed.
        trace: the window.
        sensor: (height, width).
        K: the camera's calibration (3, 3).
    """
    warp = trace.warp(planar_map.plane, np.eye(3))
    uv = warp_points(trace.bearings, trace.t_s, warp)
    # A few events tell how far the view reaches.
    low, high = reach(uv, max(1, len(uv) // c.COVER_EVENTS))
    if np.isnan(low[0]):
        return
    planar_map.cover(low, high)
    planar_map.add(
        uv, warp.nodes[0], warp.nodes[-1], sensor, K, weight=trace.heard * trace.events / max(1, len(uv))
    )
