"""Compare a session with its ground truth, and two trajectories with each other. Run 02_session.py first."""

import sys
from pathlib import Path

import dvsviz
from dvsviz.evaluate.evaluate import window_errors
from dvsviz.evaluate.tables import evaluation_table

path = Path(sys.argv[1] if len(sys.argv) > 1 else "sessions/example.h5")

with dvsviz.open_session(path) as session:
    print(evaluation_table(dvsviz.evaluate(session)))

    online = dvsviz.evaluate(session, poses="online")
    print(f"\nas known at the time: rotation {online.rotation_rmse_deg:.3f} deg")

    worst = int(window_errors(session).rotation_deg.argmax())
    print(f"window {worst} has the largest error of rotation")

    # Any two trajectories on one clock: here the refined poses with those known at the time as the truth.
    same = dvsviz.evaluate(session.trajectory("refined"), session.trajectory("online"), alignment="se3")
    print(f"refinement moved the poses by {same.position_rmse_m:.4f} plane distances")
