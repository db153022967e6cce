"""What a session takes along besides trajectories: its windows' figures as a table, its map as a picture."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import DvsvizError
from dvsviz.session.records import STATUSES
from dvsviz.view.images import map_levels
from dvsviz.view.panorama import equirectangular
from dvsviz.view.shown import ShownSession

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_PLAIN = ("contrast_before", "contrast_after", "overlap", "score", "confidence", "condition")


UNITS = {
    **dict.fromkeys(("start_us", "end_us"), "us"),
    **dict.fromkeys(("first_event", "end_event"), "events"),
    **dict.fromkeys(("x", "y", "z"), "plane distance"),
    **{f"omega_{axis}_rad_s": "rad/s" for axis in "xyz"},
    **{f"velocity_{axis}_d_s": "plane distance/s" for axis in "xyz"},
    "event_rate_hz": "Hz",
    "error_percent": "% of the plane distance",
    "error_deg": "deg",
}
"""Units of the columns of `figures`; of the others 1."""


def figures(shown: ShownSession) -> dict[str, NDArray[Any]]:
    """Return a column a figure, a row a window (N,): times, state, refined pose, velocities, measurements, errors.

    Positions are in plane distances; NaN is a value that is not known. `status` holds texts.
    """
    columns = shown.session.columns()
    plotted = shown.plotted(0)
    poses = shown.poses()
    count = len(poses)
    found: dict[str, NDArray[Any]] = {"window": np.arange(count)}
    found |= {name: columns[name][:count] for name in ("start_us", "end_us", "first_event", "end_event")}
    found["status"] = np.array([str(STATUSES[number]) for number in columns["status"][:count]], dtype=object)
    found |= dict(zip(_POSE, [*poses[:, :3, 3].T, *shown.quaternions().T], strict=True))
    found |= {f"omega_{axis}_rad_s": v for axis, v in zip("xyz", columns["omega"][:count].T, strict=True)}
    found |= {f"velocity_{axis}_d_s": v for axis, v in zip("xyz", columns["velocity"][:count].T, strict=True)}
    found |= {name: columns[name][:count] for name in _PLAIN}
    found |= {name: plotted[name][:count] for name in ("event_rate_hz", "error_percent", "error_deg")}
    return found | {name: columns[name][:count] for name in ("keyframe", "map_revision")}


def figures_csv(shown: ShownSession) -> str:
    """Return the figures as one line a window after their names; an empty field is a value that is not known."""
    table = figures(shown)
    texts = [
        [f"{value:.9g}" if np.isfinite(value) else "" for value in column]
        if column.dtype.kind == "f"
        else [str(value) for value in column]
        for column in table.values()
    ]
    return "\n".join([",".join(table), *(",".join(row) for row in zip(*texts, strict=True))]) + "\n"


def map_png(shown: ShownSession) -> bytes:
    """Return the newest map as a grey PNG, 0 no edge to 255 a sure one; a panorama as all directions round the camera.

    Raises:
        DvsvizError: the session holds no map.
    """
    revision = shown.newest_map()
    if revision is None:
        raise DvsvizError(
            "the session holds no map", path=shown.session.path, hint="it appears with the first keyframe"
        )
    faces = shown.faces()
    if len(faces) > 1:
        revision = replace(revision, texture=equirectangular(faces))
    return map_levels(revision).png()
