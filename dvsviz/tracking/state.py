"""The tracker's state as named arrays: checkpoints.

Sampled events are not stored: they are drawn again from the recording, window by window, by the same seeded choice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import sample_window
from dvsviz.events.recording import EventSource
from dvsviz.events.windows import make_window
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.session.records import STATUSES, Keyframe, Status
from dvsviz.tracking import constants as c
from dvsviz.tracking.mapping import Mapper
from dvsviz.tracking.noise import without_noise
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.prediction import MotionFilter
from dvsviz.tracking.traces import Trace

Array = NDArray[np.float64]
_VERSION = 3
# One number that is none would be in every pose that follows.
_FINITE = (
    "T_world_camera",
    "omega",
    "velocity",
    "covariance",
    "density",
    "numbers",
    "normal_world",
    "distance",
    "faces",
    "trace_poses",
    "trace_velocities",
    "map_votes",
    "map_exposure",
    "map_origin",
    "gyro_bias",
    "gyro_anchor",
)


@dataclass(slots=True, kw_only=True, eq=False)
class Motion:
    """What changes with every window: the tracker's own few numbers.

    Attributes:
        T_world_camera: last pose (4, 4), at `t_us`.
        t_us: its time.
        omega: angular velocity (3,) there, camera frame.
        velocity: linear velocity (3,) there, camera frame.
        status: what is known of it.
        bad_windows: bad windows in a row.
        good_score: running score of good windows.
        size: events wanted for the next window.
        searches: relocalizations tried since it was lost; before the first pose, windows after noise that showed too
            little for it.
        filter: how sure pose and velocity are.
    """

    T_world_camera: Array
    t_us: int
    omega: Array
    velocity: Array
    status: Status
    bad_windows: int
    good_score: float
    size: float
    searches: int = 0
    filter: MotionFilter = field(default_factory=MotionFilter)

    def resize(self, displacement_px: float, wanted_px: float, most: int) -> None:
        """Move the window size towards the wanted image displacement, up to `most` events."""
        factor = float(np.clip(wanted_px / max(displacement_px, 0.1), 1 / c.WINDOW_GROWTH, c.WINDOW_GROWTH))
        # Far off, at once; near, gently, so that a single odd window does not change much.
        factor = factor if displacement_px < 0.5 * wanted_px else float(np.sqrt(factor))
        self.size = float(np.clip(self.size * factor, c.WINDOW_EVENTS_MIN, most))

    @classmethod
    def start(cls, free: NDArray[np.bool_]) -> Motion:
        """Return the state before the first window.

        Args:
            free: mask (6,) of rotation and position that the motion model solves for.
        """
        return cls(
            T_world_camera=np.eye(4),
            t_us=0,
            omega=np.zeros(3),
            velocity=np.zeros(3),
            status=Status.INITIALIZING,
            bad_windows=0,
            good_score=0.0,
            size=float(c.WINDOW_EVENTS_START),
            filter=MotionFilter(free=free),
        )


def pack(motion: Motion, mapper: Mapper) -> dict[str, np.ndarray]:
    """Return the state as arrays that `unpack` reads."""
    state = {
        "version": np.array([_VERSION]),
        "T_world_camera": motion.T_world_camera,
        "omega": motion.omega,
        "velocity": motion.velocity,
        "free": motion.filter.free,
        "covariance": motion.filter.covariance,
        "density": motion.filter.density.copy(),
        "numbers": np.array([motion.good_score, motion.size]),
        "counters": np.array(
            [
                motion.t_us,
                STATUSES.index(motion.status),
                motion.bad_windows,
                motion.searches,
                mapper.refinements,
                mapper.revision,
                mapper.tried_at,
                mapper.revision_at_keyframes,
            ],
            dtype=np.int64,
        ),
        "normal_world": mapper.plane.normal,
        "distance": np.array([mapper.plane.distance]),
        "trace_integers": np.array(
            [
                (
                    t.window,
                    t.first_event,
                    t.events,
                    t.start_us,
                    t.mid_us,
                    round(t.duration_s * 1e6),
                    t.keyframe,
                    t.is_trusted,
                )
                for t in mapper.traces
            ],
            dtype=np.int64,
        ).reshape(-1, 8),
        "trace_poses": np.array([t.T_world_camera for t in mapper.traces]).reshape(-1, 4, 4),
        "trace_velocities": np.array([[t.omega, t.velocity] for t in mapper.traces]).reshape(-1, 2, 3),
    }
    if mapper.panorama is not None:
        state["faces"] = np.stack([p.normal for p in mapper.panorama.faces])
        state["faces_made_at"] = np.array([*mapper.panorama.made_at, mapper.panorama.current], dtype=np.int64)
    if mapper.job is not None:
        state["job"] = np.array([mapper.job.count, mapper.job.land_at], dtype=np.int64)
    if mapper.map is not None:
        # Up to date: the density that goes with the votes is a part of the state.
        mapper.map.level(-1)
        state |= {
            "map_votes": mapper.map.votes.copy(),
            "map_exposure": mapper.map.exposure.copy(),
            "map_origin": mapper.map.origin,
            "map_numbers": np.array(
                [mapper.map.px_per_unit, mapper.map.freeze_px, mapper.map.adds, mapper.map.density]
            ),
        }
    return state


def unpack(
    state: Mapping[str, np.ndarray], camera: Camera, seed: int, mapper: Mapper, source: EventSource
) -> Motion:
    """Fill an empty mapper and return the motion of a packed state.

    Args:
        state: made by `pack`.
        camera: of the recording.
        seed: the configuration's, which draws the same samples again.
        mapper: empty; filled in place.
        source: the recording's events.

    Raises:
        ValueError: the state is incomplete or of another version.
    """
    try:
        if int(state["version"][0]) != _VERSION:
            raise ValueError(f"state: expected version {_VERSION}, got {int(state['version'][0])}")
        _check_finite(state)
        t_us, status, bad, searches, refinements, revision, tried_at, revision_at = (
            int(v) for v in state["counters"]
        )
        mapper.plane = Plane(normal=np.array(state["normal_world"]), distance=float(state["distance"][0]))
        if mapper.panorama is not None and "faces" in state:
            # A branch may go on as another motion than the one that was stored.
            mapper.panorama.faces = [Plane(normal=np.array(n)) for n in state["faces"]]
            *mapper.panorama.made_at, mapper.panorama.current = (int(v) for v in state["faces_made_at"])
            mapper.plane = mapper.panorama.plane
        mapper.refinements, mapper.revision, mapper.tried_at = refinements, revision, tried_at
        mapper.revision_at_keyframes = revision_at
        for integers, T, speeds in zip(
            state["trace_integers"], state["trace_poses"], state["trace_velocities"], strict=True
        ):
            trace = _trace(integers, T, speeds, camera, seed, source)
            mapper.traces.append(trace)
            if trace.keyframe >= 0:
                mapper.keyframes.append(
                    Keyframe(
                        keyframe=trace.keyframe,
                        window=trace.window,
                        t_us=trace.start_us,
                        T_world_camera=trace.T_world_start,
                        image=np.zeros((camera.height, camera.width), dtype=np.uint8),
                    )
                )
        if "map_votes" in state:
            scale, freeze, adds, density = (float(v) for v in state["map_numbers"])
            votes = np.array(state["map_votes"], dtype=np.float32)
            mapper.map = PlanarMap(
                mapper.plane,
                scale,
                np.array(state["map_origin"]),
                (votes.shape[0], votes.shape[1]),
                freeze_px=freeze,
                reach=float("inf") if mapper.panorama is None else c.FACE_REACH,
            )
            mapper.map.votes = votes
            mapper.map.exposure = np.array(state["map_exposure"], dtype=np.float32)
            mapper.map.settle(int(adds), density)
        if "job" in state:
            mapper.begin_refinement(*(int(v) for v in state["job"]))
        return Motion(
            T_world_camera=np.array(state["T_world_camera"]),
            t_us=t_us,
            omega=np.array(state["omega"]),
            velocity=np.array(state["velocity"]),
            status=STATUSES[status],
            bad_windows=bad,
            searches=searches,
            filter=MotionFilter(
                free=np.array(state["free"]),
                covariance=np.array(state["covariance"]),
                density=np.array(state["density"]),
            ),
            good_score=float(state["numbers"][0]),
            size=float(state["numbers"][1]),
        )
    except KeyError as error:
        raise ValueError(f"state: expected an array {error}, got none") from error
    except (IndexError, TypeError) as error:
        raise ValueError(f"state: expected the arrays of a tracker ({error})") from error


def _check_finite(state: Mapping[str, np.ndarray]) -> None:
    for name in _FINITE:
        if name in state and not np.isfinite(np.asarray(state[name], dtype=np.float64)).all():
            raise ValueError(f"state: expected finite numbers in {name}")


def _trace(integers: np.ndarray, T: Array, speeds: Array, camera: Camera, seed: int, source: EventSource) -> Trace:
    window, first, count, start_us, mid_us, duration_us, keyframe, trusted = (int(v) for v in integers)
    events = make_window(
        camera,
        source.read(first, first + count),
        index=window,
        first_event=first,
        end_us=start_us + duration_us,
    )
    heard, _ = without_noise(events, camera.width, camera.height)
    bearings, t_s = sample_window(heard, c.TRACE_EVENTS if keyframe < 0 else c.KEYFRAME_EVENTS, seed)
    return Trace(
        window=window,
        first_event=first,
        start_us=start_us,
        mid_us=mid_us,
        duration_s=duration_us * 1e-6,
        T_world_camera=np.array(T),
        omega=np.array(speeds[0]),
        velocity=np.array(speeds[1]),
        bearings=bearings,
        t_s=t_s,
        events=count,
        heard=len(heard) / count,
        keyframe=keyframe,
        is_trusted=bool(trusted),
    )
