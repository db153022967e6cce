"""Traces: what is known of tracked windows is corrected where their keyframes move."""

import numpy as np

from dvsviz.geometry import se3
from dvsviz.tracking.traces import Trace, correct


def trace(window: int, mid_us: int, x: float, keyframe: int = -1) -> Trace:
    return Trace(
        window=window,
        first_event=0,
        start_us=mid_us,
        mid_us=mid_us,
        duration_s=0.0,
        T_world_camera=se3.pose(np.eye(3), np.array([x, 0.0, 0.0])),
        omega=np.zeros(3),
        velocity=np.zeros(3),
        bearings=np.zeros((0, 2), np.float32),
        t_s=np.zeros(0),
        events=0,
        keyframe=keyframe,
    )


def test_keyframes_at_one_time_are_corrected() -> None:
    # A clock of milliseconds and a burst of events make several windows, and keyframes, at one time.
    traces = [trace(0, 0, 0.0, 0), trace(1, 1000, 1.0), trace(2, 2000, 2.0, 1), trace(3, 2000, 2.0, 2)]
    moved = {k: se3.pose(np.eye(3), np.array([x, 0.0, 0.0])) for k, x in ((0, 0.0), (2, 2.2), (3, 2.4))}
    x = [t.T_world_camera[0, 3] for t in correct(traces, moved)]
    np.testing.assert_allclose(x, [0.0, 1.2, 2.4, 2.4])
