"""The nouns that tracker, store, viewer and exporters share: frozen results of tracking."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Status(StrEnum):
    """What the tracker knows about a window's pose."""

    INITIALIZING = "initializing"
    TRACKING = "tracking"
    WEAK = "weak"
    LOST = "lost"
    RELOCALIZING = "relocalizing"


# The order is the number stored in session files: append, never reorder.
STATUSES: tuple[Status, ...] = tuple(Status)

_FROM_BEST = (Status.INITIALIZING, Status.TRACKING, Status.WEAK, Status.RELOCALIZING, Status.LOST)
STATUS_BADNESS: tuple[int, ...] = tuple(_FROM_BEST.index(status) for status in STATUSES)
"""How bad each of `STATUSES` is: a stretch of windows is drawn in its worst one."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowResult:
    """What the tracker found for one event window.

    Attributes:
        window: number of the window, from 0.
        start_us: time of its first event.
        end_us: time the next window starts.
        first_event: index of its first event in the recording.
        end_event: index after its last event.
        status: what is known about the pose.
        T_world_camera: pose (4, 4) at the first event, in plane distances (d_w = 1).
        omega: angular velocity (3,), rad/s, camera frame.
        velocity: linear velocity (3,), plane distances per second, camera frame.
        normal_world: unit normal (3,) of the plane as known then.
        contrast_before: variance of the IWE without motion.
        contrast_after: variance of the IWE at the estimated motion.
        overlap: share (0 to 1) of the window's edge pixels that the map explains; NaN before there is a map.
        score: chance-normalised agreement with the map (1 perfect, 0 chance); NaN before there is a map.
        confidence: calibrated, 0 to 1: chance that the pose is within 2 % of the plane distance.
        condition: condition number of the pose's normal matrix.
        weak_direction: unit vector (6,) over (omega, v) that the texture shows least.
        iterations: solver steps used.
        events_used: events that took part in the estimate.
        map_revision: number of the map revision it was aligned with; -1 before there is one.
        keyframe: number of the keyframe made of this window; -1 where none was.
        time_spent_s: wall seconds of the tracker for this window.
        note: a sentence for the log of events, or "".
    """

    window: int
    start_us: int
    end_us: int
    first_event: int
    end_event: int
    status: Status
    T_world_camera: Array
    omega: Array
    velocity: Array
    normal_world: Array
    contrast_before: float
    contrast_after: float
    overlap: float
    score: float
    confidence: float
    condition: float
    weak_direction: Array
    iterations: int
    events_used: int
    map_revision: int
    keyframe: int
    time_spent_s: float
    note: str = ""

    @property
    def contrast_gain(self) -> float:
        """Contrast at the estimate by contrast without motion."""
        return self.contrast_after / self.contrast_before if self.contrast_before > 0 else float("nan")

    @property
    def event_rate_hz(self) -> float:
        """Events per second in the window."""
        return (self.end_event - self.first_event) * 1e6 / max(1, self.end_us - self.start_us)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """A window whose events became part of the map.

    Attributes:
        keyframe: number of the keyframe, from 0.
        window: the window it was made of.
        t_us: time of its pose.
        T_world_camera: pose (4, 4), as last refined when it was stored.
        image: the window's warped events (height, width) uint8, for sessions whose recording is gone.
    """

    keyframe: int
    window: int
    t_us: int
    T_world_camera: Array
    image: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapRevision:
    """The map's texture at one time.

    Pixel (row, column) is the plane point `(u, v) = origin + (column, row) / px_per_unit` of the map frame
    (`geometry.plane`): `R_map_world p_world = (u, v, distance)`.

    Attributes:
        revision: number, from 0.
        window: the window after which it holds.
        texture: edge occurrence (rows, columns) uint8, 0 none to 255 sure.
        origin: (u, v) (2,) of pixel (0, 0)'s centre.
        px_per_unit: texture pixels per plane distance.
        normal_world: unit normal (3,) of the plane.
        distance: plane's distance from the world origin.
    """

    revision: int
    window: int
    texture: NDArray[np.uint8]
    origin: Array
    px_per_unit: float
    normal_world: Array
    distance: float


class Cause(StrEnum):
    """Why tracking failed."""

    TOO_FEW_EVENTS = "too_few_events"
    TOO_LITTLE_TEXTURE = "too_little_texture"
    WEAK_DIRECTION = "weak_direction"
    LEFT_MAP = "left_map"
    TOO_FAST = "too_fast"
    LOCAL_OPTIMUM = "local_optimum"
    MAP_POLLUTED = "map_polluted"
    NOT_PLANAR = "not_planar"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A stretch of windows that were weak or lost.

    Attributes:
        cause: the diagnosed cause.
        start: first window.
        end: window after the last.
        worst: window with the lowest score.
        message: one sentence for people.
    """

    cause: Cause
    start: int
    end: int
    worst: int
    message: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinedPoses:
    """Poses of windows re-expressed after a refinement; the poses known at the time are kept beside them.

    Attributes:
        windows: window numbers (N,), int64, increasing.
        Ts_world_camera: refined poses (N, 4, 4).
    """

    windows: NDArray[np.int64]
    Ts_world_camera: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class LogEntry:
    """One line of a session's log of events.

    Attributes:
        window: the window it belongs to.
        level: "info", "warning" or "error".
        text: one sentence.
    """

    window: int
    level: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackerUpdates:
    """What a tracker made since it was last asked, besides one result a window.

    Attributes:
        keyframes: new keyframes.
        map_revisions: new map revisions.
        refined: poses re-expressed by refinements, in the order they landed.
        failures: failures that ended.
        log: lines for the log of events.
    """

    keyframes: tuple[Keyframe, ...] = ()
    map_revisions: tuple[MapRevision, ...] = ()
    refined: tuple[RefinedPoses, ...] = ()
    failures: tuple[Failure, ...] = ()
    log: tuple[LogEntry, ...] = ()
