"""The event tracker's poses among the frames' methods: one line of the same table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dvsviz.errors import EvaluationError
from dvsviz.evaluate.align import align_positions
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.registration.errors import absolute_errors, relative_errors
from dvsviz.registration.frames import FrameSequence
from dvsviz.registration.study import StudyRow, StudyRun
from dvsviz.session.store import open_session

EVENTS = "events"


def session_rows(path: Path, sequence: FrameSequence, runs: Sequence[StudyRun]) -> list[StudyRow]:
    """Return one row for each skip of the runs: a session's poses at the times of the same frames.

    Lengths are metric where the session knows the plane's distance; else one scale is fitted to the truth, and `scale`
    says so. The time is the tracker's, a frame interval.

    Args:
        path: the session.
        sequence: the frames, with ground truth, on the session's clock.
        runs: of `study` on these frames.

    Raises:
        EvaluationError: there is no ground truth, or the session covers fewer than two of the frames.
        SessionError: it cannot be read.
    """
    truth = sequence.ground_truth
    if truth is None:
        raise EvaluationError("a session is compared by ground truth, and these frames have none", path=path)
    with open_session(path) as session:
        tracked = session.trajectory("refined", False)
        columns = session.columns()
        known = json.loads(session.header.config_json).get("plane_distance")
    rows = []
    for run in {run.row.skip: run for run in runs}.values():
        t_us = run.odometry.trajectory.t_us
        t_us = t_us[tracked.covers(t_us) & truth.covers(t_us)]
        if len(t_us) < 2:
            raise EvaluationError(
                "the session covers fewer than two of the frames", path=path, hint="is it of this recording?"
            )
        true = truth.at(t_us)
        estimated = tracked.at(t_us)
        scale, kind = (float(known), "plane") if known else (_fitted(estimated, true), "fitted")
        Ts = estimated.Ts_world_camera.copy()
        Ts[:, :3, 3] *= scale
        # The session's world is the first window's camera: laid on the first true pose, as the frames' methods are.
        Ts = true.Ts_world_camera[0] @ se3.inverse(Ts[0]) @ Ts
        relative = relative_errors(Ts, true.Ts_world_camera).summary()
        absolute = absolute_errors(Ts, true.Ts_world_camera).summary()
        inside = (columns["start_us"] >= t_us[0]) & (columns["start_us"] < t_us[-1])
        rows.append(
            replace(
                run.row,
                method=EVENTS,
                mode="session",
                registered=len(t_us) - 1,
                failures=0,
                scale=kind,
                matches=float("nan"),
                inliers=float("nan"),
                loops=0,
                **{f"relative_{name}": value for name, value in relative.items()},
                **{f"absolute_{name}": value for name, value in absolute.items()},
                features_s=0.0,
                points_s=0.0,
                method_s=float(np.sum(columns["time_spent_s"][inside])) / (len(t_us) - 1),
            )
        )
    return rows


def _fitted(estimated: Trajectory, true: Trajectory) -> float:
    found = align_positions(estimated.positions, true.positions, "sim3")
    return found.scale if found.scale > 0 else 1.0
