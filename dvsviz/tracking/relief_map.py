"""The relief map: pieces of edge in space, each with its inverse depth, that a camera is tracked by.

It is the memory that odometry from window to window lacks: a landmark keeps its depth as long as it is in view, and is
found again when it comes back. A window is aligned with it (point to line), the last views and their landmarks are
solved together (`relief_adjust`), and what is seen for the first time takes its depth from its neighbours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import vote
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.tracking import constants as c
from dvsviz.tracking.edges import ridge_pixels
from dvsviz.tracking.relief_adjust import Sightings, adjust
from dvsviz.tracking.relief_kernels import (
    RAY_COLUMNS,
    SEEN_COLUMNS,
    associate,
    by_landmark,
    place_variances,
    pose_equations,
    see,
)
from dvsviz.tracking.relief_sweep import image_flow, sweep

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """Events of a window, by the time of its pose.

    Attributes:
        bearings: (N, 2) float32, in time order.
        t_s: times (N,) since the time of the pose.
        is_positive: polarities (N,).
        mid_us: time of the pose.
        duration_s: length of the window.
    """

    bearings: NDArray[np.float32]
    t_s: Array
    is_positive: NDArray[np.bool_]
    mid_us: int
    duration_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReliefView:
    """A view of the lag window: pose, time, and what it saw of the landmarks (M)."""

    T_world_camera: Array
    mid_us: int
    landmark: NDArray[np.int64]
    normal: Array
    place_px: Array
    weight: Array


class ReliefMap:
    """Landmarks and last views of one tracker.

    Args:
        camera: of the windows.
        free: mask (6,) of rotation and position.
    """

    def __init__(self, camera: Camera, free: NDArray[np.bool_]) -> None:
        self.camera, self.free = camera, free
        self.rays: Array = np.zeros((0, RAY_COLUMNS))
        self.states: Array = np.zeros((0, 2))
        self.prior_states: Array = np.zeros((0, 2))
        self.prior_information: Array = np.zeros((0, 2, 2))
        self.information: Array = np.zeros((0, 2, 2))
        self.sides: Array = np.zeros(0)
        # Columns: windows that saw it, windows in a row that should have and did not.
        self.counts: NDArray[np.int64] = np.zeros((0, 2), dtype=np.int64)
        self.views: list[ReliefView] = []
        self.velocity: Array = np.zeros(3)
        self.omega: Array = np.zeros(3)
        self.windows = 0
        self.explained = 0.0
        self.rms_px = 0.0

    # --- a window ------------------------------------------------------------------------------------------

    def begin(self, sample: Sample, velocity: Array, log_inverse_depth: Array) -> None:
        """Make the first landmarks: the first view is the world's origin, inverse depths are those of a grid."""
        self.velocity = velocity.copy()
        self._add_view(np.eye(4), sample, np.full(len(sample.t_s), -1, np.int32), np.zeros(len(sample.t_s)))
        self._bear(sample, self.inverse_depths(np.eye(4), sample))
        self.windows = 1

    def follow(self, sample: Sample) -> Array:
        """Return the pose (4, 4) of the next window, and take it into the map."""
        last = self.views[-1]
        dt = (sample.mid_us - last.mid_us) * 1e-6
        T_predicted = self._predict(sample, last.T_world_camera, min(dt, c.RELIEF_GAP_S))
        T, owner, residual = self._align(sample, T_predicted, last.T_world_camera, dt)
        self._add_view(T, sample, owner, residual)
        self._adjust()
        for _ in range(c.RELIEF_AGAIN):
            # Landmarks moved: their events are others now.
            self._learn_velocity()
            T = self.views.pop().T_world_camera
            self._associate(sample, T, c.RELIEF_GATES_PX[-1], owner, residual)
            self._add_view(T, sample, owner, residual)
            self._adjust()
        self._fold()
        self._learn_velocity()
        T = self.views[-1].T_world_camera
        self.counts[np.unique(owner[owner >= 0]), 0] += 1
        self._forget(sample, owner)
        self._bear(sample, self.inverse_depths(T, sample))
        self.windows += 1
        return T

    def _predict(self, sample: Sample, T_last: Array, dt: float) -> Array:
        """Return the pose (4, 4) to start from: the camera goes on as it did, at half the speed, or stopped.

        A window lasts longer where fewer events come, which is what happens when a camera slows down.
        """
        omega, velocity = self.omega, self.velocity
        owner, residual = np.full(len(sample.t_s), -1, np.int32), np.zeros(len(sample.t_s))
        best, gate = (np.inf, np.eye(4), omega, velocity), c.RELIEF_GATES_PX[1]
        for share in c.RELIEF_SPEEDS:
            self.omega, self.velocity = share * omega, share * velocity
            T = se3.propagate(T_last, self.omega, self.velocity, dt)
            self._associate(sample, T, gate, owner, residual, told_px=np.inf)
            off = np.where(owner >= 0, np.minimum(np.abs(residual), gate), gate)
            cost = float((off * off).mean())
            if cost < c.RELIEF_LEAD * best[0]:
                best = (cost, T, self.omega, self.velocity)
        _, T, self.omega, self.velocity = best
        return T

    def _align(
        self, sample: Sample, T_predicted: Array, T_last: Array, dt: float
    ) -> tuple[Array, NDArray[np.int32], Array]:
        """Return the pose (4, 4), the owners (N,) of the events and their distances (N,), px."""
        focal, T = self.camera.focal_px, T_predicted.copy()
        owner = np.full(len(sample.t_s), -1, np.int32)
        residual = np.zeros(len(sample.t_s))
        index = np.flatnonzero(self.free)
        scale_px = focal * float(np.median(self.states[:, 1])) if len(self.states) else focal
        sigma = c.RELIEF_PREDICTED_PX + c.RELIEF_PREDICTED_SHARE * scale_px * float(
            np.linalg.norm(T_predicted[:3, 3] - T_last[:3, 3])
        )
        prior = np.diag(np.r_[np.full(3, focal**2), np.full(3, scale_px**2)]) / sigma**2
        for gate in c.RELIEF_GATES_PX:
            for _ in range(c.RELIEF_ITERATIONS):
                seen = self._associate(sample, T, gate, owner, residual)
                lines, mean, weight, _ = self._mean_by_landmark(sample, owner, residual)
                variances = np.empty(len(self.rays))
                R, p = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
                place_variances(self.rays, self.states, self.information, seen, R, p, focal, variances)
                off = np.r_[se3.log_so3(T[:3, :3].T @ T_predicted[:3, :3]), T_predicted[:3, 3] - T[:3, 3]]
                H, g = prior.copy(), prior @ off
                pose_equations(
                    self.rays, self.states, variances, seen, R, p, focal, lines, mean, weight,
                    c.RELIEF_ROBUST_PX, H, g,
                )  # fmt: skip
                step = np.zeros(6)
                step[index] = np.linalg.solve(H[np.ix_(index, index)], g[index])
                T[:3, :3] = T[:3, :3] @ se3.exp_so3(step[:3])
                T[:3, 3] += step[3:]
                if dt < c.RELIEF_GAP_S:
                    self.omega = se3.log_so3(T_last[:3, :3].T @ T[:3, :3]) / dt
                    self.velocity = T[:3, :3].T @ (T[:3, 3] - T_last[:3, 3]) / dt
        self._associate(sample, T, c.RELIEF_GATES_PX[-1], owner, residual)
        self.explained = float((owner >= 0).mean())
        self.rms_px = float(np.sqrt(np.mean(residual[owner >= 0] ** 2))) if (owner >= 0).any() else 0.0
        return T, owner, residual

    def _associate(
        self,
        sample: Sample,
        T: Array,
        gate_px: float,
        owner: NDArray[np.int32],
        residual: Array,
        told_px: float = c.RELIEF_SIGNED_PX,
    ) -> Array:
        """Write which landmark each event belongs to; return how they are seen (L, 5) at the pose."""
        bounds = np.linspace(sample.t_s[0], sample.t_s[-1] + 1e-6, c.RELIEF_SLICES + 1)
        seen = np.empty((len(bounds), len(self.rays), SEEN_COLUMNS))
        for k, t in enumerate(bounds):
            at = se3.propagate(T, self.omega, self.velocity, float(t))
            see(self.rays, self.states, np.ascontiguousarray(at[:3, :3]), at[:3, 3].copy(), seen[k])
        associate(
            sample.bearings, sample.t_s, sample.is_positive, bounds, seen, self.sides, self.camera.matrix,
            np.array([self.camera.width, self.camera.height]), gate_px, c.RELIEF_REACH_PX, told_px, owner,
            residual,
        )  # fmt: skip
        return self._seen(T)

    def _seen(self, T: Array) -> Array:
        seen = np.empty((len(self.rays), SEEN_COLUMNS))
        see(self.rays, self.states, np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), seen)
        return seen

    def _mean_by_landmark(
        self, sample: Sample, owner: NDArray[np.int32], residual: Array
    ) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Return landmarks with events (M,), their mean distance (M,), weights (M,) and mean times (M,)."""
        count, total, squares, when = (np.zeros(len(self.rays)) for _ in range(4))
        by_landmark(owner, residual, sample.t_s, count, total, squares, when)
        lines = np.flatnonzero(count > 0)
        n = count[lines]
        return lines, total[lines] / n, np.minimum(n, c.RELIEF_MOST) / c.RELIEF_VARIANCE_PX2, when[lines] / n

    def _add_view(self, T: Array, sample: Sample, owner: NDArray[np.int32], residual: Array) -> None:
        """Keep what a window saw of the landmarks."""
        lines, mean, weight, _ = self._mean_by_landmark(sample, owner, residual)
        seen = self._seen(T)[lines]
        place = self.camera.focal_px * (seen[:, 2] * seen[:, 0] + seen[:, 3] * seen[:, 1]) + mean
        self.views.append(
            ReliefView(
                T_world_camera=T,
                mid_us=sample.mid_us,
                landmark=lines.astype(np.int64),
                normal=np.ascontiguousarray(seen[:, 2:4]),
                place_px=place,
                weight=weight,
            )
        )

    # --- the lag window ------------------------------------------------------------------------------------

    def _sightings(self, views: list[ReliefView]) -> Sightings:
        return Sightings(
            landmark=np.concatenate([v.landmark for v in views]),
            view=np.concatenate([np.full(len(v.landmark), k) for k, v in enumerate(views)]),
            normal=np.concatenate([v.normal for v in views]),
            place_px=np.concatenate([v.place_px for v in views]),
            weight=np.concatenate([v.weight for v in views]),
        )

    def _adjust(self) -> None:
        """Solve the last views and their landmarks together; what leaves the lag window becomes a prior."""
        Ts = np.stack([v.T_world_camera for v in self.views])
        held = np.zeros(len(Ts), dtype=np.bool_)
        held[0] = self.windows < c.RELIEF_LAG
        Ts, self.states, self.information = adjust(
            self.rays, self.states, self.prior_states, self.prior_information, Ts, held, self.free,
            self._sightings(self.views), (np.zeros((6 * len(Ts), 6 * len(Ts))), np.zeros(6 * len(Ts))),
            self.camera.focal_px, rounds=c.RELIEF_ROUNDS, scale_px=c.RELIEF_ROBUST_PX,
        )  # fmt: skip
        self.views = [replace(v, T_world_camera=T) for v, T in zip(self.views, Ts, strict=True)]

    def _fold(self) -> None:
        while len(self.views) > c.RELIEF_LAG:
            old = self.views.pop(0)
            _, told, known = adjust(
                self.rays, self.states, self.prior_states, self.prior_information, old.T_world_camera[None],
                np.ones(1, dtype=np.bool_), self.free, self._sightings([old]), (np.zeros((6, 6)), np.zeros(6)),
                self.camera.focal_px, rounds=1, scale_px=c.RELIEF_ROBUST_PX,
            )  # fmt: skip
            i = old.landmark
            self.prior_states[i], self.prior_information[i] = told[i], known[i]

    def _learn_velocity(self) -> None:
        a, b = self.views[-2], self.views[-1]
        dt = (b.mid_us - a.mid_us) * 1e-6
        if 0 < dt < c.RELIEF_GAP_S:
            R = b.T_world_camera[:3, :3]
            self.velocity = R.T @ (b.T_world_camera[:3, 3] - a.T_world_camera[:3, 3]) / dt
            self.omega = se3.log_so3(a.T_world_camera[:3, :3].T @ R) / dt

    # --- landmarks -----------------------------------------------------------------------------------------

    def inverse_depths(self, T: Array, sample: Sample) -> Array:
        """Return the inverse depths (height, width) seen from a pose, from the landmarks in view."""
        seen = self._seen(T)
        K, rows, cols = self.camera.matrix, self.camera.height, self.camera.width
        step = c.RELIEF_CELL_PX
        shape = (rows // step + 1, cols // step + 1)
        good = (seen[:, 4] > 0) & (self.counts[:, 0] >= 2)
        x = (K[0, 0] * seen[good, 0] + K[0, 2]) / step
        y = (K[1, 1] * seen[good, 1] + K[1, 2]) / step
        inside = (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
        cell = y[inside].astype(np.int64) * shape[1] + x[inside].astype(np.int64)
        rho = seen[good, 4][inside]
        told = self.information[good, 1, 1][inside] * rho * rho
        weight = told / (told + 1.0 / c.RELIEF_DEPTH_SHARE**2)
        total = np.bincount(cell, weight * rho, shape[0] * shape[1]).reshape(shape)
        known = np.bincount(cell, weight, shape[0] * shape[1]).reshape(shape)
        middle = float(np.median(rho)) if len(rho) else 1.0
        swept, clear = sweep(
            sample.bearings, sample.t_s, sample.is_positive, self.camera, self.omega, self.velocity,
            np.geomspace(middle / c.RELIEF_SWEEP_RANGE, middle * c.RELIEF_SWEEP_RANGE, c.RELIEF_SWEEP_STEPS),
        )  # fmt: skip
        total = total + c.RELIEF_SWEEP_WEIGHT * clear * swept
        known = known + c.RELIEF_SWEEP_WEIGHT * clear
        mean = float(total.sum() / max(known.sum(), 1e-9)) if known.sum() > 0 else float(np.median(self.states[:, 1]))
        # From coarse to fine: where a finer neighbourhood knows little, the coarser one is taken.
        out = np.full(shape, mean)
        for sigma in (8.0, 4.0, 2.0, 1.0):
            a, b = cv2.GaussianBlur(total, (0, 0), sigma), cv2.GaussianBlur(known, (0, 0), sigma)
            least = 1.0 / (2 * np.pi * sigma * sigma)
            out = (a + least * out) / (b + least)
        return cv2.resize(out, (cols, rows), interpolation=cv2.INTER_LINEAR)

    def _bear(self, sample: Sample, rho: Array) -> None:
        """Make landmarks of the edges that none explains yet, with inverse depths of an image (height, width)."""
        view, K = self.views[-1], self.camera.matrix
        R, p = view.T_world_camera[:3, :3], view.T_world_camera[:3, 3]
        rows, cols = self.camera.height, self.camera.width
        x = np.clip(np.rint(sample.bearings[:, 0] * K[0, 0] + K[0, 2]).astype(np.int64), 0, cols - 1)
        y = np.clip(np.rint(sample.bearings[:, 1] * K[1, 1] + K[1, 2]).astype(np.int64), 0, rows - 1)
        points = _deskewed(sample, rho[y, x], self.omega, self.velocity)
        px = (points * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]).astype(np.float32)
        seen = self._seen(view.T_world_camera)
        later = se3.propagate(view.T_world_camera, self.omega, self.velocity, 0.5 * sample.duration_s)
        ahead = self._seen(later)
        flow = np.einsum("ij,ij->i", ahead[:, :2] - seen[:, :2], seen[:, 2:4])
        made, focal = [], self.camera.focal_px
        for polarity in (1.0, -1.0):
            mine = sample.is_positive == (polarity > 0)
            votes = vote(px[mine], None, (rows, cols))
            occupied = votes[votes > 0]
            if len(occupied) == 0:
                continue
            level = max(1.0, float(np.percentile(occupied, 90)))
            edge = cv2.GaussianBlur((1 - np.exp(-c.MAP_SATURATION * votes / level)), (0, 0), c.REFINE_RIDGE_BLUR_PX)
            found = ridge_pixels(edge.astype(np.float32), c.REFINE_RIDGE_LEVEL)
            if len(found) == 0:
                continue
            taken = np.zeros((rows, cols), dtype=np.uint8)
            told = 2 * focal * np.abs(flow) > c.RELIEF_SIGNED_PX
            near = (seen[:, 4] > 0) & (~told | (self.sides * np.sign(flow) * polarity >= 0))
            u = np.rint(seen[near, 0] * K[0, 0] + K[0, 2]).astype(np.int64)
            v = np.rint(seen[near, 1] * K[1, 1] + K[1, 2]).astype(np.int64)
            inside = (u >= 0) & (v >= 0) & (u < cols) & (v < rows)
            taken[v[inside], u[inside]] = 1
            taken = cv2.dilate(taken, np.ones((c.RELIEF_SPACING_PX, c.RELIEF_SPACING_PX), np.uint8))
            found = found[taken[found[:, 1].astype(np.int64), found[:, 0].astype(np.int64)] == 0]
            keep = _spaced(found, (rows, cols))
            made.append(np.column_stack([found[keep], np.full(len(keep), polarity)]))
        if not made:
            return
        new = np.concatenate(made)
        xy = (new[:, :2] + new[:, 2:3] * new[:, 3:5] - [K[0, 2], K[1, 2]]) / [K[0, 0], K[1, 1]]
        normal = new[:, 3:5]
        count, zero = len(new), np.zeros((len(new), 1))
        depth = rho[new[:, 1].astype(np.int64), new[:, 0].astype(np.int64)]
        rays = np.column_stack(
            [
                np.tile(p, (count, 1)),
                np.column_stack([xy, np.ones(count)]) @ R.T,
                np.column_stack([normal, zero]) @ R.T,
                np.column_stack([-normal[:, 1], normal[:, 0], np.zeros(count)]) @ R.T,
            ]
        )
        # The tangent (-n_y, n_x) has the normal (n_x, n_y): as `see` turns it.
        states = np.column_stack([np.zeros(count), depth])
        focal = self.camera.focal_px
        known = np.zeros((count, 2, 2))
        known[:, 0, 0] = (focal / c.RELIEF_OFFSET_PX) ** 2
        known[:, 1, 1] = 1.0 / (c.RELIEF_DEPTH_SHARE * depth) ** 2
        index = np.arange(len(self.rays), len(self.rays) + count)
        self.rays = np.concatenate([self.rays, rays])
        self.states = np.concatenate([self.states, states])
        self.prior_states = np.concatenate([self.prior_states, states])
        self.prior_information = np.concatenate([self.prior_information, known])
        self.information = np.concatenate([self.information, known])
        self.counts = np.concatenate([self.counts, np.tile([1, 0], (count, 1))])
        flow = image_flow(xy, depth, self.omega, self.velocity)
        across = np.einsum("ij,ij->i", flow, normal)
        told = focal * np.abs(across) * sample.duration_s > c.RELIEF_SIGNED_PX
        self.sides = np.concatenate([self.sides, np.where(told, np.sign(across) * new[:, 5], 0.0)])
        self.views[-1] = replace(
            view,
            landmark=np.concatenate([view.landmark, index]),
            normal=np.concatenate([view.normal, normal]),
            place_px=np.concatenate([view.place_px, focal * (normal * xy).sum(axis=1)]),
            weight=np.concatenate([view.weight, np.full(count, 0.5 * c.RELIEF_MOST / c.RELIEF_VARIANCE_PX2)]),
        )

    def _forget(self, sample: Sample, owner: NDArray[np.int32]) -> None:
        """Leave out landmarks that should have been seen and were not."""
        T = self.views[-1].T_world_camera
        half = 0.5 * sample.duration_s
        a = self._seen(se3.propagate(T, self.omega, self.velocity, -half))
        b = self._seen(se3.propagate(T, self.omega, self.velocity, half))
        K, focal = self.camera.matrix, self.camera.focal_px
        middle = 0.5 * (a[:, :2] + b[:, :2])
        px, py = middle[:, 0] * K[0, 0] + K[0, 2], middle[:, 1] * K[1, 1] + K[1, 2]
        across = focal * np.abs(np.einsum("ij,ij->i", b[:, :2] - a[:, :2], a[:, 2:4]))
        edge = c.RELIEF_BORDER_PX
        in_view = (a[:, 4] > 0) & (px > edge) & (py > edge)
        in_view &= (px < self.camera.width - edge) & (py < self.camera.height - edge)
        was_seen = np.zeros(len(self.rays), dtype=np.bool_)
        was_seen[owner[owner >= 0]] = True
        self.counts[was_seen, 1] = 0
        self.counts[in_view & ~was_seen & (across > c.RELIEF_TOLD_PX), 1] += 1
        far = (a[:, 4] <= 0) | (px < -edge) | (py < -edge)
        far |= (px > self.camera.width + edge) | (py > self.camera.height + edge)
        dead = (self.counts[:, 1] >= c.RELIEF_MISSED) | (far & (self.counts[:, 0] < c.RELIEF_SEEN))
        dead |= (self.counts[:, 1] >= 2) & (self.counts[:, 0] < c.RELIEF_SEEN)
        if dead.any():
            self._keep(~dead)

    def _keep(self, alive: NDArray[np.bool_]) -> None:
        number = np.cumsum(alive) - 1
        self.rays, self.states, self.sides = self.rays[alive], self.states[alive], self.sides[alive]
        self.prior_states, self.prior_information = self.prior_states[alive], self.prior_information[alive]
        self.information, self.counts = self.information[alive], self.counts[alive]
        kept = []
        for v in self.views:
            m = alive[v.landmark]
            kept.append(
                replace(
                    v, landmark=number[v.landmark[m]].astype(np.int64), normal=v.normal[m],
                    place_px=v.place_px[m], weight=v.weight[m],
                )  # fmt: skip
            )
        self.views = kept


def _deskewed(sample: Sample, rho: Array, omega: Array, velocity: Array) -> Array:
    """Return the bearings (N, 2) of events with inverse depths (N,) moved to the time of the pose."""
    b = np.asarray(sample.bearings, dtype=np.float64)
    return b - image_flow(b, rho, omega, velocity) * sample.t_s[:, None]


def _spaced(found: Array, shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return which ridge pixels to take: one of each block of pixels."""
    block = c.RELIEF_SPACING_PX
    cell = (found[:, 1] // block).astype(np.int64) * (shape[1] // block + 1) + (found[:, 0] // block).astype(np.int64)
    return np.sort(np.unique(cell, return_index=True)[1])
