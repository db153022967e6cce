"""What is asked of a run, and where it stands."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvsviz.config import TrackerConfig
from dvsviz.events.filters import FilterConfig
from dvsviz.geometry.camera import Camera

Action = Literal["pause", "resume", "cancel"]


class Stage(StrEnum):
    """What a running run is doing."""

    SIMULATING = "simulating"
    READING = "reading"
    COMPILING = "compiling"
    TRACKING = "tracking"


class RunState(StrEnum):
    """Where a run stands."""

    QUEUED = "queued"
    RUNNING = "running"
    PAUSED = "paused"
    DONE = "done"
    CANCELLED = "cancelled"
    FAILED = "failed"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunOrder:
    """What is to be tracked.

    Attributes:
        recording: file or folder.
        out: the session that is written; its stem is the run's name.
        config: of the tracker.
        force: overwrite a session that is there.
        resume: go on with a session that was interrupted.
        demo: the recording is the demo's: it is simulated where it is not there yet.
        camera: calibration to use instead of the recording's.
        filters: which events are kept.
        start_s: where to begin, seconds from the first event.
        end_s: where to end, seconds from the first event.
        branch_of: the session that is tried again, its recording opened with its filters; None for a run of its own.
        window: of a branch: the first window that is tracked anew.
        live: the stream to track instead of a recording, `aedat4+tcp://HOST:PORT` or `camera`.
        calibration: file with the calibration of a live stream's camera.
        record: where a live stream is recorded.
        rerun_port: where a rerun viewer of this machine listens that the run is streamed to, or None.
        T_world_camera: of a branch: the pose (4, 4) to start that window from, or None.
    """

    recording: Path
    out: Path
    config: TrackerConfig = field(default_factory=TrackerConfig)
    force: bool = False
    resume: bool = False
    demo: bool = False
    camera: Camera | None = None
    filters: FilterConfig | None = None
    start_s: float | None = None
    end_s: float | None = None
    branch_of: Path | None = None
    window: int = 0
    live: str | None = None
    calibration: Path | None = None
    record: Path | None = None
    rerun_port: int | None = None
    T_world_camera: NDArray[np.float64] | None = None

    @property
    def name(self) -> str:
        """The session's name."""
        return self.out.stem
