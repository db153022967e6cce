"""A session's trajectory as a TUM file."""

from __future__ import annotations

import json
from pathlib import Path

from dvsviz.errors import SessionError
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import write_tum
from dvsviz.session.store import Poses, Session


def metres_per_unit(session: Session) -> float:
    """Return how many metres a unit of a session's positions is: told by `--plane-distance`, or by an accelerometer.

    Raises:
        SessionError: nothing tells it.
    """
    told = json.loads(session.header.config_json).get("plane_distance")
    if told:
        return float(told)
    scale = (session.summary or {}).get("metric_scale", {})
    if "metres_per_unit" not in scale:
        why = scale.get("unknown", "there was no accelerometer, or the session is incomplete")
        hint = "track it with --plane-distance METRES, or leave --metres out"
        raise SessionError(f"its scale is not known: {why}", path=session.path, hint=hint)
    return float(scale["metres_per_unit"])


def export_tum(session: Session, out: Path, poses: Poses = "refined", *, metres: bool = False) -> int:
    """Write a session's poses as `t px py pz qx qy qz qw` a line, and return how many there are.

    Times are those of the windows' starts, seconds of the recording's own clock with six decimals; positions are in
    plane distances, or in metres. Windows without a pose of their own (lost, relocalizing) are left out.

    Args:
        session: what is written.
        out: the file; replaced where it exists.
        poses: as last refined, or as known at the time.
        metres: positions in metres, see `metres_per_unit`.

    Raises:
        SessionError: no window has a pose, or the scale is not known.
        FormatError: the file cannot be written.
    """
    trajectory = session.trajectory(poses)
    if len(trajectory) == 0:
        raise SessionError("no window has a pose", path=session.path, hint="there is nothing to write")
    if metres:
        Ts = trajectory.Ts_world_camera.copy()
        Ts[:, :3, 3] *= metres_per_unit(session)
        trajectory = Trajectory(t_us=trajectory.t_us, Ts_world_camera=Ts)
    write_tum(out, trajectory)
    return len(trajectory)
