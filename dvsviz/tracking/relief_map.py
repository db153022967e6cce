"""The relief map: pieces of edge in space, each with its inverse depth, that a camera is tracked by.

It is the memory that odometry from window to window lacks: a landmark keeps its depth as long as it is in view, and is
found again when it comes back. A window is aligned with it (`relief_align`), the last views and their landmarks are
solved together (`relief_adjust`), and what is seen for the first time takes its depth from its surroundings
(`relief_birth`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.camera import Camera
from dvsviz.tracking import relief_constants as rc
from dvsviz.tracking.relief_adjust import Sightings, adjust
from dvsviz.tracking.relief_align import Moving, Owned, Sample, align_relief, between, own, start
from dvsviz.tracking.relief_birth import deskewed, inverse_depths, new_landmarks
from dvsviz.tracking.relief_landmarks import Landmarks

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReliefView:
    """A view of the lag window.

    Attributes:
        T_world_camera: pose (4, 4).
        mid_us: its time.
        landmark: what it saw (M,).
        normal: of their lines in the image (M, 2).
        place_px: of the lines along their normals (M,).
        weight: of each (M,), 1 / px².
    """

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

    Attributes:
        landmarks: all that are remembered, in the frame of the map: that of its first view.
        T_world_map: pose (4, 4) of that frame.
        views: of the lag window, the last one last.
        moving: pose and velocities of the last window; unit: the middle distance of what the first one saw.
        windows: seen so far.
        explained: share of the last window's events on landmarks that several windows saw.
        gain: contrast of the last window by its contrast without motion.
        displacement_px: mean image displacement within it.
    """

    def __init__(self, camera: Camera, free: NDArray[np.bool_]) -> None:
        self.camera, self.free = camera, free
        self.landmarks = Landmarks.none()
        self.T_world_map: Array = np.eye(4)
        self.views: list[ReliefView] = []
        self.moving = Moving(T_world_camera=np.eye(4), omega=np.zeros(3), velocity=np.zeros(3))
        self.windows = 0
        self.explained = 1.0
        self.gain = 1.0
        self.displacement_px = 0.0

    def begin(self, sample: Sample, velocity: Array) -> None:
        """Make the first landmarks before a camera of known velocity (3,): its view is the world's origin."""
        self.moving = replace(self.moving, velocity=velocity)
        nothing = np.full(len(sample.t_s), -1, np.int32)
        self.views = [self._view(Owned(owner=nothing, residual_px=np.zeros(len(nothing))), sample, self.landmarks)]
        self._grow(sample, self.landmarks)
        self.windows = 1

    def follow(self, sample: Sample) -> Array:
        """Return the pose (4, 4) of the next window, and take it into the map."""
        last = replace(self.moving, T_world_camera=self.views[-1].T_world_camera)
        dt = (sample.mid_us - self.views[-1].mid_us) * 1e-6
        index = self._near(last)
        near = self.landmarks.take(index)
        self.moving = self._place(sample, near, last, dt)
        owned = own(near, sample, self.moving, self.camera, rc.RELIEF_GATES_PX[-1])
        held = near.counts[owned.owner, 0] >= rc.RELIEF_SEEN
        self.explained = float(((owned.owner >= 0) & held).mean()) if self.windows > rc.RELIEF_SEEN else 1.0
        # From the landmarks near the view to all of them.
        owned = replace(owned, owner=np.where(owned.owner >= 0, index[owned.owner], -1).astype(np.int32))
        self.views.append(self._view(owned, sample, self.landmarks))
        self._adjust()
        T = self.views[-1].T_world_camera
        last = replace(last, T_world_camera=self.views[-2].T_world_camera)
        self.moving = between(last, T, dt) or replace(self.moving, T_world_camera=T)
        self._fold()
        self._count(owned, sample)
        self._grow(sample, self.landmarks.take(self._near(self.moving)))
        self.windows += 1
        return T

    def views_before(self, samples: Sequence[Sample], first: Moving, mid_us: int) -> list[Array]:
        """Return the poses (4, 4) of windows before the first view, the last one first, by the landmarks as they are.

        Args:
            samples: the windows, the last one first.
            first: pose and velocities of the first view.
            mid_us: its time.
        """
        poses, following, next_us = [], first, mid_us
        for sample in samples:
            near = self.landmarks.take(self._near(following))
            following = self._place(sample, near, following, (sample.mid_us - next_us) * 1e-6)
            next_us = sample.mid_us
            poses.append(following.T_world_camera)
        return poses

    def _place(self, sample: Sample, near: Landmarks, other: Moving, dt: float) -> Moving:
        """Return the pose of a window a time after (or before) another one, aligned with landmarks near the view."""
        few = sample.thinned(rc.RELIEF_ALIGN_EVENTS)
        predicted = start(near, few, other, float(np.clip(dt, -rc.RELIEF_GAP_S, rc.RELIEF_GAP_S)), self.camera)
        seen = near.seen_from(other.T_world_camera)[:, 4]
        scale_px = self.camera.focal_px * (float(np.median(seen)) if len(seen) else 1.0)
        return align_relief(near, few, predicted, other, dt, self.camera, self.free, scale_px)

    def in_view(self) -> tuple[Landmarks, Array]:
        """Return the landmarks in the last view, and how it sees them (L, 5)."""
        near = self.landmarks.take(self._near(self.moving))
        return near, near.seen_from(self.moving.T_world_camera)

    def mean_velocity(self) -> Array:
        """Return the mean velocity (3,) over the lag window in the axes of the last view; 0 of one view."""
        a, b = self.views[0], self.views[-1]
        if b.mid_us <= a.mid_us:
            return np.zeros(3)
        moved = b.T_world_camera[:3, 3] - a.T_world_camera[:3, 3]
        return b.T_world_camera[:3, :3].T @ moved / ((b.mid_us - a.mid_us) * 1e-6)

    # --- the lag window ------------------------------------------------------------------------------------

    def _view(self, owned: Owned, sample: Sample, landmarks: Landmarks) -> ReliefView:
        """Return what a window saw of the landmarks."""
        lines, mean, weight = owned.means(len(landmarks))
        seen = landmarks.seen_from(self.moving.T_world_camera)[lines]
        place = self.camera.focal_px * (seen[:, 2] * seen[:, 0] + seen[:, 3] * seen[:, 1]) + mean
        return ReliefView(
            T_world_camera=self.moving.T_world_camera,
            mid_us=sample.mid_us,
            landmark=lines.astype(np.int64),
            normal=np.ascontiguousarray(seen[:, 2:4]),
            place_px=place,
            weight=weight,
        )

    def _adjust(self) -> None:
        """Solve the last views and their landmarks together. While all views are in the lag window, the first holds."""
        Ts = np.stack([v.T_world_camera for v in self.views])
        held = np.zeros(len(Ts), dtype=np.bool_)
        held[0] = self.windows < rc.RELIEF_LAG
        m = self.landmarks
        Ts, states, information = adjust(
            m.rays, m.states, m.prior_states, m.prior_information, Ts, held, self.free, _sightings(self.views),
            self.camera.focal_px, rounds=rc.RELIEF_ROUNDS, scale_px=rc.RELIEF_ROBUST_PX,
        )  # fmt: skip
        self.landmarks = replace(m, states=states, information=information)
        self.views = [replace(v, T_world_camera=T) for v, T in zip(self.views, Ts, strict=True)]

    def _fold(self) -> None:
        """Let what the oldest view saw become a prior of the landmarks, once the lag window is full."""
        if len(self.views) <= rc.RELIEF_LAG:
            return
        old, m = self.views.pop(0), self.landmarks
        _, told, known = adjust(
            m.rays, m.states, m.prior_states, m.prior_information, old.T_world_camera[None],
            np.ones(1, dtype=np.bool_), self.free, _sightings([old]), self.camera.focal_px, rounds=1,
            scale_px=rc.RELIEF_ROBUST_PX,
        )  # fmt: skip
        prior_states, prior_information = m.prior_states.copy(), m.prior_information.copy()
        prior_states[old.landmark], prior_information[old.landmark] = told[old.landmark], known[old.landmark]
        self.landmarks = replace(m, prior_states=prior_states, prior_information=prior_information)

    # --- landmarks -----------------------------------------------------------------------------------------

    def _near(self, moving: Moving) -> NDArray[np.int64]:
        """Return the landmarks that lie in view or not far from it."""
        seen, camera = self.landmarks.seen_from(moving.T_world_camera), self.camera
        x, y = seen[:, 0] * camera.fx + camera.cx, seen[:, 1] * camera.fy + camera.cy
        edge = rc.RELIEF_NEAR_PX
        inside = (x > -edge) & (y > -edge) & (x < camera.width + edge) & (y < camera.height + edge)
        return np.flatnonzero((seen[:, 4] > 0) & inside)

    def _grow(self, sample: Sample, near: Landmarks) -> None:
        """Take in landmarks of the edges that none near the view explains yet."""
        camera, moving = self.camera, self.moving
        rho = inverse_depths(near, sample, moving, camera)
        px = deskewed(sample, rho, moving, camera)
        self._measure(sample, px)
        fresh, normal, place = new_landmarks(near, sample, px, rho, moving, camera)
        view, first = self.views[-1], len(self.landmarks)
        self.landmarks = self.landmarks.joined(fresh)
        weight = rc.RELIEF_FRESH_EVENTS / rc.RELIEF_VARIANCE_PX2
        self.views[-1] = replace(
            view,
            landmark=np.concatenate([view.landmark, np.arange(first, first + len(fresh))]),
            normal=np.concatenate([view.normal, normal]),
            place_px=np.concatenate([view.place_px, place]),
            weight=np.concatenate([view.weight, np.full(len(fresh), weight)]),
        )

    def _measure(self, sample: Sample, px: NDArray[np.float32]) -> None:
        """Find how much sharper the window is with its motion than without, and how far its image moved."""
        self.gain = sample.gain(px, self.camera)
        # Between the first and the last event: twice the mean over a window of evenly spread times, twice.
        self.displacement_px = 4.0 * float(np.nanmedian(np.linalg.norm(px - sample.pixels(self.camera), axis=1)))

    def _count(self, owned: Owned, sample: Sample) -> None:
        """Count who saw which landmark, and leave out those that should have been seen and were not."""
        m, moving, camera, half_s = self.landmarks, self.moving, self.camera, 0.5 * sample.duration_s
        a, b = m.seen_from(moving.at(-half_s)), m.seen_from(moving.at(half_s))
        x, y = 0.5 * (a[:, 0] + b[:, 0]) * camera.fx + camera.cx, 0.5 * (a[:, 1] + b[:, 1]) * camera.fy + camera.cy
        across = camera.focal_px * np.abs(np.einsum("ij,ij->i", b[:, :2] - a[:, :2], a[:, 2:4]))
        edge = rc.RELIEF_BORDER_PX
        in_view = (a[:, 4] > 0) & (np.minimum(x, y) > edge)
        in_view &= (x < camera.width - edge) & (y < camera.height - edge)
        far = (a[:, 4] <= 0) | (np.minimum(x, y) < -edge)
        far |= (x > camera.width + edge) | (y > camera.height + edge)
        counts, seen = m.counts.copy(), np.unique(owned.owner[owned.owner >= 0])
        counts[seen, 0] += 1
        missed = in_view & (across > rc.RELIEF_TOLD_PX)
        missed[seen] = False
        counts[missed, 1] += 1
        counts[seen, 1] = 0
        fresh = counts[:, 0] < rc.RELIEF_SEEN
        dead = (counts[:, 1] >= rc.RELIEF_MISSED) | (fresh & (far | (counts[:, 1] >= rc.RELIEF_MISSED_FRESH)))
        self.landmarks = replace(m, counts=counts).take(~dead)
        number = np.cumsum(~dead) - 1
        self.views = [_without(v, dead, number) for v in self.views]

    # --- checkpoints ---------------------------------------------------------------------------------------

    def pack(self) -> dict[str, np.ndarray]:
        """Return the state as arrays that `unpack` reads."""
        seen = _sightings(self.views)
        return self.landmarks.pack() | {
            "relief_map_origin": self.T_world_map,
            "relief_map_views": np.stack([v.T_world_camera for v in self.views]),
            "relief_map_times": np.array([v.mid_us for v in self.views], dtype=np.int64),
            "relief_map_moving": self.moving.T_world_camera,
            "relief_map_velocities": np.stack([self.moving.omega, self.moving.velocity]),
            "relief_map_numbers": np.array([self.windows, self.explained, self.gain, self.displacement_px]),
            "relief_map_sightings": np.column_stack([seen.landmark, seen.view]).astype(np.int64),
            "relief_map_lines": np.column_stack([seen.normal, seen.place_px, seen.weight]),
        }

    def unpack(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a packed state."""
        self.landmarks = Landmarks.unpack(state)
        self.T_world_map = np.array(state["relief_map_origin"])
        omega, velocity = np.array(state["relief_map_velocities"])
        self.moving = Moving(T_world_camera=np.array(state["relief_map_moving"]), omega=omega, velocity=velocity)
        windows, self.explained, self.gain, self.displacement_px = (float(v) for v in state["relief_map_numbers"])
        self.windows = int(windows)
        landmark, view = np.array(state["relief_map_sightings"]).T
        lines = np.array(state["relief_map_lines"])
        self.views = [
            ReliefView(
                T_world_camera=np.array(T),
                mid_us=int(t),
                landmark=landmark[view == k],
                normal=np.ascontiguousarray(lines[view == k, :2]),
                place_px=lines[view == k, 2],
                weight=lines[view == k, 3],
            )
            for k, (T, t) in enumerate(
                zip(state["relief_map_views"], state["relief_map_times"].tolist(), strict=True)
            )
        ]


def _sightings(views: list[ReliefView]) -> Sightings:
    return Sightings(
        landmark=np.concatenate([v.landmark for v in views]),
        view=np.concatenate([np.full(len(v.landmark), k) for k, v in enumerate(views)]),
        normal=np.concatenate([v.normal for v in views]),
        place_px=np.concatenate([v.place_px for v in views]),
        weight=np.concatenate([v.weight for v in views]),
    )


def _without(view: ReliefView, dead: NDArray[np.bool_], number: NDArray[np.int64]) -> ReliefView:
    """Return a view without the landmarks that were left out, the others by their new numbers."""
    m = ~dead[view.landmark]
    return replace(
        view,
        landmark=number[view.landmark[m]].astype(np.int64),
        normal=view.normal[m],
        place_px=view.place_px[m],
        weight=view.weight[m],
    )
