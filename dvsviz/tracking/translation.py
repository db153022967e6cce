"""Translation before a scene that is not a plane: is it one, and where is the camera before it.

Both, the planar map and this, begin together. The first windows that move enough are asked for depth, by contrast on a
coarse grid. When what they show is no plane, the windows so far are tracked again on a relief map (`relief_map`), which
from then on is what the camera is tracked by; the log says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dvsviz.contrast.relief import Relief, ReliefProblem, grid_shape, maximize_relief_contrast
from dvsviz.events.recording import EventSource
from dvsviz.events.windows import EventWindow, make_window
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.tracking import relief_constants as rc
from dvsviz.tracking.relief_align import Moving, Sample, between
from dvsviz.tracking.relief_map import ReliefMap
from dvsviz.tracking.relief_planarity import OnPlane, deviation_of_landmarks

Array = NDArray[np.float64]
# A camera before a relief does not turn: over the few degrees of a sensor's view turning and moving sideways look alike
# wherever depth is even (docs/decisions/relief-map.md).
_FREE = np.array([False, False, False, True, True, True])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked:
    """A window that was asked for depth.

    Attributes:
        window: its number.
        first_event: index of its first event in the recording.
        events: how many it has.
        end_us: when it ends.
        velocity: its own (3,), camera frame.
        moved_px: how far its image moved.
        T_world_camera: pose (4, 4) at its middle by the velocities so far.
        sample: its events.
    """

    window: int
    first_event: int
    events: int
    end_us: int
    velocity: Array
    moved_px: float
    T_world_camera: Array
    sample: Sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Passed:
    """A window on the way: its number, its first event's time, and its pose (4, 4) at its middle's time."""

    window: int
    start_us: int
    mid_us: int
    T_world_camera: Array


class ReliefOdometry:
    """What the first windows show of depth, and the relief map where they do.

    Args:
        camera: gives the grid of depths.
        uneven: relative deviation of the relief from a plane from which the scene is none.

    Attributes:
        velocity: last velocity (3,), camera frame, mean distances per second.
        relief: last log inverse depth (rows, columns).
        windows: windows seen.
        seen: windows with enough motion to show depth.
        unevenness: largest relative deviation of their reliefs from a plane.
        not_a_plane: None while undecided.
        T_world_camera: pose (4, 4) at the middle of the last window, in mean distances.
        mid_us: its time.
        asked: windows that a relief map can still be made of.
        map: the relief map, once the camera is tracked by it.
        path: windows that were tracked by it.
    """

    def __init__(self, camera: Camera, uneven: float = rc.RELIEF_UNEVEN) -> None:
        self.camera = camera
        self.uneven = uneven
        self.velocity: Array = np.zeros(3)
        self.relief: Array = np.zeros(grid_shape(camera))
        self.windows = 0
        self.seen = 0
        self.unevenness = 0.0
        self.not_a_plane: bool | None = None
        self.T_world_camera: Array = np.eye(4)
        self.mid_us = 0
        self.asked: list[Asked] = []
        self.map: ReliefMap | None = None
        self.path: list[Passed] = []

    @property
    def is_asked(self) -> bool:
        """True while it is undecided whether the scene is a plane; after a while nobody asks any more."""
        return self.not_a_plane is None and self.windows < rc.RELIEF_PATIENCE

    @property
    def is_sharp(self) -> bool:
        """True where the last window shows the motion that the map gives it, or the camera stands still."""
        return self.map is None or self.map.gain > rc.RELIEF_GAIN or self.map.displacement_px < rc.RELIEF_STILL_PX

    def look(self, window: EventWindow) -> str:
        """Ask a window for depth; return what it decided about the scene, or ""."""
        before, solved = self.velocity, self.step(window)
        # The pose moves on by the mean of two velocities, from middle to middle; a gap is not bridged.
        mid_us = window.start_us + (window.end_us - window.start_us) // 2
        if self.windows > 1:
            dt = min((mid_us - self.mid_us) * 1e-6, rc.RELIEF_GAP_S)
            self.T_world_camera = se3.propagate(
                self.T_world_camera, np.zeros(3), 0.5 * (before + self.velocity), dt
            )
        self.mid_us = mid_us
        moved_px = float(np.hypot(*solved.velocity[:2])) * self.camera.focal_px * window.duration_s
        self.keep(window, moved_px)
        if self.not_a_plane is None:
            if not self.is_asked:
                self.asked = []
            return ""
        return f"the scene is {'not ' if self.not_a_plane else ''}a plane: {self.percent}"

    @property
    def percent(self) -> str:
        """How uneven the scene is, in words."""
        return f"inverse depth {100 * self.unevenness:.0f} % off the best plane"

    def keep(self, window: EventWindow, moved_px: float) -> None:
        """Remember a window of which a relief map can be made."""
        if self.asked and window.first_event != self.asked[-1].first_event + self.asked[-1].events:
            # Windows in between were not asked: what was before them cannot be joined.
            self.asked = []
        self.asked.append(
            Asked(
                window=window.index,
                first_event=window.first_event,
                events=len(window),
                end_us=window.end_us,
                velocity=self.velocity,
                moved_px=moved_px,
                T_world_camera=self.T_world_camera,
                sample=Sample.of(window),
            )
        )

    # --- on the map ----------------------------------------------------------------------------------------

    def begin(
        self,
        T_world_first: Array,
        *,
        may_turn: bool,
        least: float,
        on_plane: OnPlane | None = None,
    ) -> bool:
        """Make the relief map of the windows that were asked; return whether what it holds is no plane.

        The map begins with the first window that moved; those before it are placed when the map is made.

        Args:
            T_world_first: pose (4, 4) of the first of them, at its middle.
            may_turn: the camera may turn: what turning explains is no depth.
            least: deviation of the landmarks' motion from a plane's from which it is taken; else it is dropped.
            on_plane: the pixels (N, 2) to which a plane's map moves a window's events, where it knows it: on the relief
                they must be sharper.
        """
        first = next((k for k, a in enumerate(self.asked) if k and a.moved_px >= rc.RELIEF_MOVED_PX), 0)
        self.map, self.path = ReliefMap(self.camera, _FREE), []
        self.map.T_world_map = T_world_first
        self.map.begin(self.asked[first].sample, self.asked[first].velocity)
        asked, self.asked = self.asked, []
        start_us = [a.sample.mid_us - round(0.5e6 * a.sample.duration_s) for a in asked]
        self.path = [
            Passed(window=a.window, start_us=s, mid_us=a.sample.mid_us, T_world_camera=T_world_first)
            for a, s in zip(asked[: first + 1], start_us, strict=False)
        ]
        sharper: list[float] = []
        for a in asked[first + 1 :]:
            self._advance(a.window, a.sample)
            px = None if on_plane is None else on_plane(a.window, a.sample)
            if px is not None:
                sharper.append(float(np.log(self.live_map.gain / max(a.sample.gain(px, self.camera), 1e-12))))
        self._place_before(asked[:first], T_world_first)
        deviation = deviation_of_landmarks(self.map, may_turn=may_turn)
        if not deviation >= least or (sharper and np.mean(sharper) < rc.RELIEF_SHARPER):
            self.map, self.path = None, []
            return False
        self.unevenness, self.not_a_plane = deviation, True
        return True

    def _place_before(self, asked: Sequence[Asked], T_world_first: Array) -> None:
        """Place the windows before the map's first view by its landmarks, and put the first one at a pose (4, 4)."""
        relief_map, k = self.live_map, len(asked)
        if k == 0 or len(self.path) < k + 2:
            return
        T_map_world = se3.inverse(relief_map.T_world_map)
        a, b = self.path[k], self.path[k + 1]
        T = T_map_world @ a.T_world_camera
        moving = between(Moving(T_world_camera=T_map_world @ b.T_world_camera, omega=np.zeros(3), velocity=np.zeros(3)),
                         T, (a.mid_us - b.mid_us) * 1e-6)  # fmt: skip
        moving = moving or Moving(T_world_camera=T, omega=np.zeros(3), velocity=np.zeros(3))
        poses = relief_map.views_before([w.sample for w in reversed(asked)], moving, a.mid_us)[::-1]
        relief_map.T_world_map = T_world_first @ se3.inverse(poses[0])
        self.path = [
            replace(p, T_world_camera=relief_map.T_world_map @ T)
            for p, T in zip(
                self.path, [*poses, *(T_map_world @ p.T_world_camera for p in self.path[k:])], strict=True
            )
        ]
        self.T_world_camera = self.path[-1].T_world_camera

    def follow(self, window: EventWindow) -> None:
        """Track a window by the relief map."""
        self._advance(window.index, Sample.of(window))

    def _advance(self, window: int, sample: Sample) -> None:
        relief_map = self.live_map
        T = relief_map.T_world_map @ relief_map.follow(sample)
        start_us = sample.mid_us - round(0.5e6 * sample.duration_s)
        self.path.append(Passed(window=window, start_us=start_us, mid_us=sample.mid_us, T_world_camera=T))
        # The last views moved together.
        first = len(self.path) - len(relief_map.views)
        for k, view in enumerate(relief_map.views):
            T_view = relief_map.T_world_map @ view.T_world_camera
            self.path[first + k] = replace(self.path[first + k], T_world_camera=T_view)
        self.T_world_camera, self.mid_us = T, sample.mid_us
        self.velocity = relief_map.moving.velocity

    @property
    def live_map(self) -> ReliefMap:
        """The relief map; there is one after `begin`."""
        if self.map is None:
            raise ValueError("map: expected one after `begin`")
        return self.map

    def poses(self) -> list[tuple[int, Array]]:
        """Return the windows that were tracked by the relief map, with the poses (4, 4) at their starts."""
        return [(p.window, T) for p, T in zip(self.path, _at_starts(self.path), strict=True)]

    # --- checkpoints ---------------------------------------------------------------------------------------

    def pack(self) -> dict[str, np.ndarray]:
        """Return the state as arrays that `unpack` reads."""
        decided = -1 if self.not_a_plane is None else int(self.not_a_plane)
        asked = [(a.window, a.first_event, a.events, a.end_us) for a in self.asked]
        state = {
            "relief": self.relief,
            "relief_velocity": self.velocity,
            "relief_pose": self.T_world_camera,
            "relief_time": np.array([self.mid_us], dtype=np.int64),
            "relief_asked": np.array(asked, dtype=np.int64).reshape(-1, 4),
            "relief_asked_velocities": np.array([[*a.velocity, a.moved_px] for a in self.asked]).reshape(-1, 4),
            "relief_asked_poses": np.array([a.T_world_camera for a in self.asked]).reshape(-1, 4, 4),
            "relief_path": np.array([(p.window, p.start_us, p.mid_us) for p in self.path], dtype=np.int64).reshape(
                -1, 3
            ),
            "relief_poses": np.array([p.T_world_camera for p in self.path]).reshape(-1, 4, 4),
            "relief_numbers": np.array([self.windows, self.seen, self.unevenness, decided], dtype=np.float64),
        }
        return state if self.map is None else state | self.map.pack()

    def unpack(self, state: Mapping[str, np.ndarray], camera: Camera, source: EventSource) -> None:
        """Take over a packed state.

        Args:
            state: made by `pack`.
            camera: of the recording.
            source: the recording's events.
        """
        if "relief_asked" not in state:
            raise ValueError("state: expected the arrays of a relief map, they were made by another version")
        self.relief, self.velocity = np.array(state["relief"]), np.array(state["relief_velocity"])
        self.T_world_camera, self.mid_us = np.array(state["relief_pose"]), int(state["relief_time"][0])
        self.asked = []
        for numbers, speeds, T in zip(
            state["relief_asked"], state["relief_asked_velocities"], state["relief_asked_poses"], strict=True
        ):
            index, first, count, end_us = (int(v) for v in numbers)
            events = source.read(first, first + count)
            window = make_window(camera, events, index=index, first_event=first, end_us=end_us)
            self.asked.append(
                Asked(
                    window=index,
                    first_event=first,
                    events=count,
                    end_us=end_us,
                    velocity=np.array(speeds[:3]),
                    moved_px=float(speeds[3]),
                    T_world_camera=np.array(T),
                    sample=Sample.of(window),
                )
            )
        self.path = [
            Passed(window=int(n), start_us=int(start_us), mid_us=int(mid_us), T_world_camera=np.array(T))
            for (n, start_us, mid_us), T in zip(state["relief_path"], state["relief_poses"], strict=True)
        ]
        windows, seen, self.unevenness, decided = (float(v) for v in state["relief_numbers"])
        self.windows, self.seen = int(windows), int(seen)
        self.not_a_plane = None if decided < 0 else decided > 0
        if "relief_map_views" in state:
            self.map = ReliefMap(self.camera, _FREE)
            self.map.unpack(state)

    # --- is it a plane -------------------------------------------------------------------------------------

    def _moved(self, dt: float) -> Array:
        """Return the relief (rows, columns) as it lies in the image `dt` seconds later: depth moves with its things."""
        rows, cols = self.relief.shape
        y, x = np.indices(self.relief.shape).astype(np.float64)
        rho = np.exp(self.relief)
        cells = np.array([self.camera.fx * (cols - 1) / (self.camera.width - 1),
                          self.camera.fy * (rows - 1) / (self.camera.height - 1)])  # fmt: skip
        before = [y + rho * self.velocity[1] * dt * cells[1], x + rho * self.velocity[0] * dt * cells[0]]
        moved = ndimage.map_coordinates(self.relief, before, order=1, mode="nearest")
        return moved - np.log(np.maximum(1.0 - np.exp(moved) * self.velocity[2] * dt, 0.5))

    def step(self, window: EventWindow) -> Relief:
        """Return the translation and relief of a window, referred to its middle."""
        stride = max(1, len(window) // rc.RELIEF_EVENTS)
        problem = ReliefProblem(
            window.bearings[::stride],
            window.t_s[::stride] - 0.5 * window.duration_s,
            np.where(window.events.is_positive[::stride], np.float32(1), np.float32(-1)),
            self.camera,
        )
        first = self.windows == 0
        mid_us = window.start_us + (window.end_us - window.start_us) // 2
        if not first:
            self.relief = self._moved(min((mid_us - self.mid_us) * 1e-6, rc.RELIEF_GAP_S))
        solved = maximize_relief_contrast(
            problem,
            window.duration_s,
            velocity=self.velocity,
            log_inverse_depth=self.relief,
            prior=None if first else self.relief,
            blurs_px=rc.RELIEF_BLURS_START_PX if first else rc.RELIEF_BLURS_PX,
            max_evaluations=rc.RELIEF_EVALUATIONS,
        )
        self.velocity, self.relief = solved.velocity, solved.log_inverse_depth
        self.windows += 1
        speed = float(np.hypot(*solved.velocity[:2])) * self.camera.fx
        if speed * window.duration_s >= 0.5 * rc.RELIEF_DISPLACEMENT_PX:
            # A window with less motion shows no depth, and counts for neither side.
            self.seen += 1
            # A depth that is there grows out of the plane step by step; one that jumps is events drawn together.
            found = deviation_from_plane(self.relief)
            if found < self.unevenness + rc.RELIEF_JUMP:
                self.unevenness = max(self.unevenness, found)
        # A relief grows out of a plane over some windows; a plane never becomes one.
        if self.not_a_plane is None and self.seen >= rc.RELIEF_WINDOWS_MIN and self.unevenness > self.uneven:
            self.not_a_plane = True
        elif self.not_a_plane is None and self.seen >= rc.RELIEF_WINDOWS:
            self.not_a_plane = False
        return solved


def deviation_from_plane(log_inverse_depth: Array) -> float:
    """Return the RMS deviation of an inverse depth grid from the best plane, by its mean.

    The inverse depth of a plane is linear in the image, so that the best plane is a linear fit.
    """
    rho = np.exp(log_inverse_depth)
    y, x = np.indices(rho.shape)
    A = np.column_stack([np.ones(rho.size), x.ravel(), y.ravel()])
    fit = A @ np.linalg.lstsq(A, rho.ravel(), rcond=None)[0]
    return float(np.sqrt(np.mean((rho.ravel() - fit) ** 2)) / rho.mean())


def _at_starts(path: Sequence[Passed]) -> list[Array]:
    """Return the poses (4, 4) at the windows' starts, by the mean velocities between their middles."""
    out = []
    for k, p in enumerate(path):
        a, b = path[max(k - 1, 0)], path[min(k + 1, len(path) - 1)]
        dt, T = (b.mid_us - a.mid_us) * 1e-6, p.T_world_camera.copy()
        if 0 < dt < 2 * rc.RELIEF_GAP_S:
            T[:3, 3] -= (b.T_world_camera[:3, 3] - a.T_world_camera[:3, 3]) / dt * (p.mid_us - p.start_us) * 1e-6
        out.append(T)
    return out
