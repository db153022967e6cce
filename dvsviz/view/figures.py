"""What a session takes along besides trajectories: its windows' figures as a table, its map as a picture."""

from __future__ import annotations

import numpy as np

from dvsviz.errors import DvsvizError
from dvsviz.session.records import STATUSES
from dvsviz.view.images import map_levels
from dvsviz.view.shown import ShownSession

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_PLAIN = ("contrast_before", "contrast_after", "overlap", "score", "confidence", "condition")


def figures_csv(shown: ShownSession) -> str:
    """Return one line a window: times, state, refined pose, velocities, what was measured, errors where known.

    Positions are in plane distances; an empty field is a value that is not known.
    """
    columns = shown.session.columns()
    plotted = shown.plotted(0)
    poses = shown.poses()
    names = ["window", "start_us", "end_us", "first_event", "end_event", "status", *_POSE]
    names += [f"omega_{axis}_rad_s" for axis in "xyz"] + [f"velocity_{axis}_d_s" for axis in "xyz"]
    names += [*_PLAIN, "event_rate_hz", "error_percent", "error_deg", "keyframe", "map_revision"]
    count = len(poses)
    table: list[list[str]] = [[str(window) for window in range(count)]]
    table += [[str(value) for value in columns[name][:count]] for name in names[1:5]]
    table.append([str(STATUSES[number]) for number in columns["status"][:count]])
    floats = [*poses[:, :3, 3].T, *shown.quaternions().T]
    floats += [*columns["omega"][:count].T, *columns["velocity"][:count].T]
    floats += [columns[name][:count] for name in _PLAIN]
    floats += [plotted[name][:count] for name in ("event_rate_hz", "error_percent", "error_deg")]
    table += [[f"{value:.9g}" if np.isfinite(value) else "" for value in column] for column in floats]
    table += [[str(value) for value in columns[name][:count]] for name in ("keyframe", "map_revision")]
    lines = [",".join(names), *(",".join(row) for row in zip(*table, strict=True))]
    return "\n".join(lines) + "\n"


def map_png(shown: ShownSession) -> bytes:
    """Return the newest map as a grey PNG, 0 no edge to 255 a sure one.

    Raises:
        DvsvizError: the session holds no map.
    """
    revision = shown.newest_map()
    if revision is None:
        raise DvsvizError(
            "the session holds no map", path=shown.session.path, hint="it appears with the first keyframe"
        )
    return map_levels(revision).png()
