"""A recording: events and what was recorded beside them, each present or None."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dvsviz.events.events import Events
from dvsviz.events.filters import FilterConfig
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory

CHUNK_EVENTS = 1 << 20


class EventSource(Protocol):
    """Events that are read by index or by time; a source never needs to hold them all in memory."""

    @property
    def count(self) -> int:
        """Number of events."""
        ...

    def read(self, first: int, end: int) -> Events:
        """Return events `[first, end)`, clipped to those there are."""
        ...

    def index_at(self, t_us: int) -> int:
        """Return the index of the first event at or after a time (`count` where there is none)."""
        ...


class MemoryEvents:
    """An `EventSource` over events in memory."""

    def __init__(self, events: Events) -> None:
        self._events = events

    @property
    def count(self) -> int:
        """Number of events."""
        return len(self._events)

    def read(self, first: int, end: int) -> Events:
        """Return events `[first, end)`, clipped to those there are."""
        return self._events[max(0, first) : max(0, end)]

    def index_at(self, t_us: int) -> int:
        """Return the index of the first event at or after a time."""
        return int(np.searchsorted(self._events.t_us, t_us, side="left"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Imu:
    """Inertial measurements along the camera's optical axes.

    Attributes:
        t_us: times (N,), int64.
        gyro: angular velocity (N, 3), rad/s.
        accel: specific force (N, 3), m/s²; NaN where it was not measured.
    """

    t_us: NDArray[np.int64]
    gyro: NDArray[np.float64]
    accel: NDArray[np.float64]


class FrameSource(Protocol):
    """Intensity frames, read one at a time."""

    @property
    def t_us(self) -> NDArray[np.int64]:
        """Times (N,) of the frames."""
        ...

    def read(self, index: int) -> NDArray[np.uint8]:
        """Return frame `index` (height, width)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """Events of one sensor with what is known about them.

    Attributes:
        path: the file or folder it came from.
        name: its stem: what a session of it is called.
        format: name of the layout, as `dvsviz info` prints it.
        camera: calibration; `camera.is_guess` where none was recorded.
        events: where the events are read.
        ground_truth: true poses, or None.
        imu: inertial measurements, or None.
        frames: intensity frames, or None.
        mean_plane_distance: metres, of a simulated or measured plane, or None.
        plane_normal_world: unit normal (3,) of the true plane in the ground truth's world, or None.
        plane_distance_world: its distance from that world's origin, m, or None.
        filters: what the events were filtered by on opening, or None.
        events_before_filters: how many there were before, or None.
        triggers: how many triggers of each kind the file holds, as `info` lists them; their times are not kept.
        warnings: sentences about what was assumed or repaired on opening.
    """

    path: Path
    name: str
    format: str
    camera: Camera
    events: EventSource
    ground_truth: Trajectory | None = None
    imu: Imu | None = None
    frames: FrameSource | None = None
    mean_plane_distance: float | None = None
    plane_normal_world: NDArray[np.float64] | None = None
    plane_distance_world: float | None = None
    filters: FilterConfig | None = None
    events_before_filters: int | None = None
    triggers: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = field(default=())

    @property
    def first_us(self) -> int:
        """Time of the first event; 0 where there is none."""
        return int(self.events.read(0, 1).t_us[0]) if self.events.count else 0

    @property
    def last_us(self) -> int:
        """Time of the last event; 0 where there is none."""
        n = self.events.count
        last = self.events.read(n - 1, n)
        return int(last.t_us[-1]) if len(last) else 0

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last event."""
        return (self.last_us - self.first_us) * 1e-6

    def close(self) -> None:
        """Close the file that the events are read from, where they are."""
        close = getattr(self.events, "close", None)
        if close is not None:
            close()

    def chunks(self, size: int = CHUNK_EVENTS) -> Iterator[Events]:
        """Yield all events in order, at most `size` at a time."""
        for first in range(0, self.events.count, size):
            yield self.events.read(first, first + size)
