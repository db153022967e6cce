"""A registration of frames as a session: ordinary windows, one a registered frame, and a group with what else is shown.

The windows are those of one run, the `primary`; the group `registration` (version 1) keeps the images, matches and
points of its steps and the trajectories and errors of all runs. `docs/session-format.md` describes the layout.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import SessionError
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session.header import SessionHeader, read_header
from dvsviz.session.reading import open_file
from dvsviz.session.rebuild import REGISTRATION
from dvsviz.session.records import Cause, Failure, LogEntry, Status, TrackerUpdates, WindowResult
from dvsviz.session.writer import SessionWriter

Array = NDArray[np.float64]

VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredRun:
    """One method at one skip.

    Attributes:
        name: the method, with its mode where it is not plain.
        skip: frames from one registered frame to the next.
        t_us: times (N,) of the registered frames.
        Ts_world_camera: poses (N, 4, 4), metres; the first is the identity.
        errors: relative rotation (rad) and translation (m), absolute rotation and translation (N - 1, 4); NaN where
            they are not known.
        row: the run's line of the study's table.
    """

    name: str
    skip: int
    t_us: NDArray[np.int64]
    Ts_world_camera: Array
    errors: Array
    row: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredStep:
    """How one frame was registered against another.

    Attributes:
        against: number of the other frame among the registered ones.
        pixels_a: matched pixels (M, 2) float32 in the other frame.
        pixels_b: the same points (M, 2) in this frame.
        is_inlier: mask (M,) of the matches that agree.
        points: the inliers whose depth is known, in this frame's camera (K, 3) float32, m.
        reason: why there was no motion, or "".
    """

    against: int
    pixels_a: NDArray[np.float32]
    pixels_b: NDArray[np.float32]
    is_inlier: NDArray[np.bool_]
    points: NDArray[np.float32]
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredFrame:
    """The images of a registered frame, encoded: JPEG, and PNG of 16 bits in mm, or None without depth."""

    grey: bytes
    depth: bytes | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegistrationRecord:
    """All that is kept of a registration.

    Attributes:
        source: where the frames are.
        camera: their calibration.
        features: what was matched.
        runs: methods and skips.
        primary: number of the run whose frames and steps are kept.
        frames: its N frames.
        steps: its N - 1 steps, one a frame after the first.
        truth: true poses in their own world, or None.
        mean_depth: of the scene, m, or None: what errors are a share of.
    """

    source: Path
    camera: Camera
    features: str
    runs: tuple[StoredRun, ...]
    primary: int
    frames: tuple[StoredFrame, ...]
    steps: tuple[StoredStep, ...]
    truth: Trajectory | None
    mean_depth: float | None

    @property
    def shown_run(self) -> StoredRun:
        """The primary run."""
        return self.runs[self.primary]


def write_registration(path: Path, record: RegistrationRecord, *, created: str = "", force: bool = False) -> None:
    """Write a registration as a session.

    Args:
        path: the file.
        record: what is kept.
        created: ISO 8601 date and time with offset.
        force: replace a session that is there.

    Raises:
        SessionError: the file exists or cannot be written.
    """
    run = record.shown_run
    from dvsviz import __version__

    header = SessionHeader(
        recording_path=str(record.source.resolve()),
        recording_name=record.source.name,
        recording_format="frames",
        events=0,
        first_us=int(run.t_us[0]),
        last_us=int(run.t_us[-1]),
        camera=record.camera,
        config_json=json.dumps({"registration": run.name, "skip": run.skip, "features": record.features}),
        program_version=__version__,
        created=created,
        mean_plane_distance=record.mean_depth,
    )
    with SessionWriter.create(path, header, force=force, chunk_rows=64) as writer:
        for k in range(len(run.t_us)):
            writer.append(_window(record, k), _updates(record, k))
        if record.truth is not None:
            writer.set_ground_truth(record.truth)
        writer.close({"registration": [kept.row for kept in record.runs]})
    try:
        with h5py.File(path, "r+") as file:
            _fill(file.create_group(REGISTRATION), record)
    except OSError as error:
        raise SessionError(f"cannot be written: {error}", path=path, hint="check the free space") from error


def read_registration(path: Path) -> RegistrationRecord | None:
    """Return what a session keeps of a registration, or None where it is one of the event tracker.

    Raises:
        SessionError: the file is damaged or of a later version.
    """
    with open_file(path) as file:
        if REGISTRATION not in file:
            return None
        group: Any = file[REGISTRATION]
        version = int(group.attrs["version"])
        if version > VERSION:
            raise SessionError(f"holds a registration of version {version}", path=path, hint="update dvsviz")
        return _read(file, group)


def _window(record: RegistrationRecord, k: int) -> WindowResult:
    run = record.shown_run
    step = record.steps[k - 1] if k else None
    found, end = step is None or not step.reason, min(k + 1, len(run.t_us) - 1)
    share = float(step.is_inlier.mean()) if step is not None and len(step.is_inlier) else float("nan")
    status = Status.INITIALIZING if step is None else Status.TRACKING if found else Status.LOST
    nothing = float("nan")
    return WindowResult(
        window=k,
        start_us=int(run.t_us[k]),
        end_us=int(run.t_us[end]) + int(end == k),
        first_event=0,
        end_event=0,
        status=status,
        T_world_camera=run.Ts_world_camera[k],
        omega=np.zeros(3),
        velocity=np.zeros(3),
        normal_world=np.array([0.0, 0.0, -1.0]),
        contrast_before=nothing,
        contrast_after=nothing,
        overlap=share,
        score=nothing,
        confidence=nothing,
        condition=nothing,
        weak_direction=np.full(6, nothing),
        iterations=0,
        events_used=0,
        map_revision=-1,
        keyframe=-1,
        time_spent_s=float(run.row.get("total_s") or 0.0),
        note="" if step is None else step.reason,
    )


def _updates(record: RegistrationRecord, k: int) -> TrackerUpdates | None:
    if k == 0 or not (reason := record.steps[k - 1].reason):
        return None
    failure = Failure(cause=Cause.TOO_LITTLE_TEXTURE, start=k, end=k + 1, worst=k, message=reason)
    return TrackerUpdates(failures=(failure,), log=(LogEntry(window=k, level="warning", text=reason),))


def _fill(group: h5py.Group, record: RegistrationRecord) -> None:
    group.attrs["version"], group.attrs["primary"] = VERSION, record.primary
    group.attrs["features"], group.attrs["source"] = record.features, str(record.source)
    for k, run in enumerate(record.runs):
        part = group.create_group(f"runs/{k}")
        part.attrs["name"], part.attrs["skip"], part.attrs["row"] = run.name, run.skip, json.dumps(run.row)
        part["t_us"], part["T_world_camera"], part["errors"] = run.t_us, run.Ts_world_camera, run.errors
    for k, step in enumerate(record.steps):
        part = group.create_group(f"steps/{k}")
        part.attrs["against"], part.attrs["reason"] = step.against, step.reason
        part["pixels_a"], part["pixels_b"] = step.pixels_a, step.pixels_b
        part["is_inlier"], part["points"] = step.is_inlier.astype(np.uint8), step.points
    for k, frame in enumerate(record.frames):
        group[f"frames/{k}/grey"] = np.frombuffer(frame.grey, np.uint8)
        if frame.depth is not None:
            group[f"frames/{k}/depth"] = np.frombuffer(frame.depth, np.uint8)


def _read(file: h5py.File, group: Any) -> RegistrationRecord:
    header = read_header(file)
    runs = tuple(
        StoredRun(
            name=str(part.attrs["name"]),
            skip=int(part.attrs["skip"]),
            t_us=np.asarray(part["t_us"], dtype=np.int64),
            Ts_world_camera=np.asarray(part["T_world_camera"], dtype=np.float64).reshape(-1, 4, 4),
            errors=np.asarray(part["errors"], dtype=np.float64).reshape(-1, 4),
            row=json.loads(part.attrs["row"]),
        )
        for part in _numbered(group, "runs")
    )
    steps = tuple(
        StoredStep(
            against=int(part.attrs["against"]),
            pixels_a=np.asarray(part["pixels_a"], dtype=np.float32).reshape(-1, 2),
            pixels_b=np.asarray(part["pixels_b"], dtype=np.float32).reshape(-1, 2),
            is_inlier=np.asarray(part["is_inlier"]) > 0,
            points=np.asarray(part["points"], dtype=np.float32).reshape(-1, 3),
            reason=str(part.attrs["reason"]),
        )
        for part in _numbered(group, "steps")
    )
    frames = tuple(
        StoredFrame(
            grey=np.asarray(part["grey"], dtype=np.uint8).tobytes(),
            depth=np.asarray(part["depth"], dtype=np.uint8).tobytes() if "depth" in part else None,
        )
        for part in _numbered(group, "frames")
    )
    primary = int(group.attrs["primary"])
    if not 0 <= primary < len(runs) or len(frames) != len(runs[primary].t_us) or len(steps) != len(frames) - 1:
        raise ValueError("registration: runs, frames and steps do not belong together")
    truth: Any = file["ground_truth"]
    t_us = np.asarray(truth["t_us"], dtype=np.int64)
    return RegistrationRecord(
        source=Path(str(group.attrs["source"])),
        camera=header.camera,
        features=str(group.attrs["features"]),
        runs=runs,
        primary=primary,
        frames=frames,
        steps=steps,
        truth=Trajectory(t_us=t_us, Ts_world_camera=np.asarray(truth["T_world_camera"])) if len(t_us) else None,
        mean_depth=header.mean_plane_distance,
    )


def _numbered(group: Any, name: str) -> list[Any]:
    return [group[f"{name}/{k}"] for k in range(len(group[name]))] if name in group else []
