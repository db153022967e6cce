"""A session's trajectory as a TUM file."""

from __future__ import annotations

from pathlib import Path

from dvsviz.errors import SessionError
from dvsviz.geometry.tum import write_tum
from dvsviz.session.store import Poses, Session


def export_tum(session: Session, out: Path, poses: Poses = "refined") -> int:
    """Write a session's poses as `t px py pz qx qy qz qw` a line, and return how many there are.

    Times are those of the windows' starts, seconds of the recording's own clock with six decimals; positions are in
    plane distances. Windows without a pose of their own (lost, relocalizing) are left out.

    Args:
        session: what is written.
        out: the file; replaced where it exists.
        poses: as last refined, or as known at the time.

    Raises:
        SessionError: no window has a pose.
        FormatError: the file cannot be written.
    """
    trajectory = session.trajectory(poses)
    if len(trajectory) == 0:
        raise SessionError("no window has a pose", path=session.path, hint="there is nothing to write")
    write_tum(out, trajectory)
    return len(trajectory)
