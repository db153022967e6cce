"""The real recordings of the accuracy table: what they say without a true trajectory."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dvsviz.config import TrackerConfig
from dvsviz.evaluate.align import align_positions
from dvsviz.events.recording import Recording
from dvsviz.formats.open import open_recording
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.pipeline import track
from dvsviz.session.store import open_session

_SLICES = ("boxes_translation", "dynamic_translation", "poster_translation", "shapes_rotation")


def _row(name: str, said: str, is_reached: bool, rtf: float, **figures: Any) -> dict[str, Any]:
    return {
        "name": name, "position": "–", "rotation": "–", "online": "–", "rtf": f"{rtf:.1f}", "other": said,
        "is_reached": is_reached, "figures": figures,
    }  # fmt: skip


def _tracked(recording: Recording, out: Path, **config: Any) -> tuple[dict[str, Any], Trajectory]:
    summary = track(recording, TrackerConfig(**config), out, force=True)
    with open_session(out) as session:
        return summary, session.trajectory(drop_lost=False)


def real_rows(data: Path, sessions: Path) -> Iterator[dict[str, Any]]:
    """Yield the arguments of a table's rows, one recording after the other."""
    yield from _disk(data, sessions)
    summary, _ = _tracked(open_recording(data / "ecd" / "shapes_rotation_start"), sessions / "rotation_start.h5")
    lost = int(summary["losses"])
    yield _row("real: shapes_rotation_start", f"losses {lost} (0)", lost == 0, summary["real_time_factor"])
    ends = []
    for size in (1000, 2000):
        recording = open_recording(data / "ecd" / "shapes_start")
        summary, trajectory = _tracked(recording, sessions / f"shapes_start_{size}.h5", window=size)
        ends.append(trajectory)
    last = np.array([min(int(e.t_us[-1]) for e in ends)])
    a, b = (e.at(last).Ts_world_camera[0] for e in ends)
    percent = 100 * float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    degrees = float(np.degrees(se3.rotation_angle(a[:3, :3].T @ b[:3, :3])))
    said = f"windows of 1,000 and 2,000 differ by {percent:.2f} % (0.2), {degrees:.2f}° (0.2)"
    yield _row("real: shapes_start", said, percent <= 0.2 and degrees <= 0.2, summary["real_time_factor"])
    yield _slider(data, sessions)


def _disk(data: Path, sessions: Path) -> Iterator[dict[str, Any]]:
    imu = np.loadtxt(data / "gyro" / "rotdisk_imu.csv", delimiter=",", skiprows=1)
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder) / "calib.txt"
        calibration.write_text("243 243 119.5 89.5 0 0 0 0 0\n")
        recording = open_recording(data / "gyro" / "rotdisk_events.npz", size=(240, 180), calibration=calibration)
        for motion in ("rotation", "planar"):
            summary, trajectory = _tracked(recording, sessions / f"rotdisk_{motion}.h5", motion=motion)
            R = trajectory.rotations
            steps = se3.log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:])[:, 2]
            roll = abs(float(np.degrees(steps.sum())))
            said = f"total roll {roll:.1f}° (92.7 ± 1.5)"
            rate = _rate_error(trajectory, np.concatenate([[0.0], np.cumsum(steps)]), imu)
            said += f"; rate over 60 ms {rate:.2f} °/s off the gyro (0.8); losses {summary['losses']}"
            is_reached = abs(roll - 92.7) <= 1.5 and rate <= 0.8 and summary["losses"] == 0
            yield _row(f"real: rotdisk, {motion}", said, is_reached, summary["real_time_factor"])


def _rate_error(trajectory: Trajectory, roll: np.ndarray, imu: np.ndarray) -> float:
    """Return the median difference (deg/s) of the roll rate over 60 ms from the gyro's mean over the same 60 ms."""
    t, gyro = imu[:, 0], np.degrees(imu[:, 3]) - 0.2
    times = np.arange(float(trajectory.t_us[0]), float(trajectory.t_us[-1]) - 60_000, 20_000.0)
    angle = np.degrees(np.interp([times, times + 60_000], trajectory.t_us.astype(np.float64), roll))
    rate = (angle[1] - angle[0]) / 0.06
    level = np.concatenate([[0.0], np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(t) * 1e-6)])
    true = (np.interp(times + 60_000, t, level) - np.interp(times, t, level)) / 0.06
    return float(min(np.median(np.abs(rate - true)), np.median(np.abs(rate + true))))


def _slider(data: Path, sessions: Path) -> dict[str, Any]:
    recording = open_recording(data / "ecd" / "slider_depth.zip")
    summary, trajectory = _tracked(recording, sessions / "slider_depth.h5", motion="auto")
    truth = recording.ground_truth
    assert truth is not None, "slider_depth has a ground truth"
    inside = (trajectory.t_us >= truth.t_us[0]) & (trajectory.t_us <= truth.t_us[-1])
    trajectory = Trajectory(t_us=trajectory.t_us[inside], Ts_world_camera=trajectory.Ts_world_camera[inside])
    true = truth.at(trajectory.t_us)
    R0 = true.rotations[0] @ trajectory.rotations[0].T
    p = (trajectory.positions - trajectory.positions[0]) @ R0.T
    q = true.positions - true.positions[0]
    scale = float((p * q).sum() / (p * p).sum())
    axis = q[-1] / np.linalg.norm(q[-1])
    direction = float(np.degrees(np.arccos(np.clip(p[-1] @ axis / np.linalg.norm(p[-1]), -1, 1))))
    fit = align_positions(p, q, "sim3")
    path = float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
    # Sideways: off the straight line that fits the estimate best.
    centred = scale * (p - p.mean(axis=0))
    own = np.linalg.svd(centred, full_matrices=False)[2][0]
    sideways = 100 * float(np.linalg.norm(centred - np.outer(centred @ own, own), axis=1).max()) / path
    turned = float(
        np.degrees(np.asarray(se3.rotation_angle(trajectory.rotations[0].T @ trajectory.rotations)).max())
    )
    s = (trajectory.t_us - trajectory.t_us[0]) * 1e-6
    times = np.arange(0.0, s[-1] - 0.1, 0.05)

    def speed(x: np.ndarray) -> np.ndarray:
        at = [np.stack([np.interp(times + d, s, x[:, i]) for i in range(3)], axis=-1) for d in (0.0, 0.1)]
        return np.linalg.norm(at[1] - at[0], axis=1) / 0.1

    true_speed = speed(q)
    off = 100 * float(np.sqrt(np.mean((scale * speed(p) - true_speed) ** 2)) / true_speed.mean())
    said = (
        f"direction {direction:.1f}° (5), sideways {sideways:.1f} % (3), turned {turned:.1f}° (2), "
        f"speed {off:.0f} % (10); Sim(3) scale {fit.scale:.3f} m"
    )
    is_reached = direction <= 5 and sideways <= 3 and turned <= 2 and off <= 10
    return _row("real: slider_depth, auto", said, is_reached, summary["real_time_factor"])
