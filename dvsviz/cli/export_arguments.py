"""What can be said about taking a session along: `dvsviz export` and `dvsviz report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from dvsviz.cli.options import Flag, Json, option, read_number

Poses = Literal["refined", "online"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    """Write a session as another file: its ending says what.

    .rrd rerun recording, .tum trajectory, .csv and .parquet figures of all windows, .png newest map, .webm and .mp4
    video, .html the 3-D scene as one page.

    Examples:  dvsviz export sessions/r.h5 --to r.rrd  |  dvsviz export sessions/r.h5 --video r.webm --start 2 --end 5
    """

    session: Annotated[Positional[Path], arg(metavar="SESSION")]
    """The session."""
    to: Annotated[Path, arg(metavar="FILE", aliases=("--video",))]
    """The file to write."""
    start: Annotated[float | None, *option("SECONDS", read_number(float), "the first window")] = None
    """Where a video begins, or the stretch that rerun marks: seconds after the first event."""
    end: Annotated[float | None, *option("SECONDS", read_number(float), "the last window")] = None
    """Where it ends, seconds after the first event, exclusive."""
    speed: float = 1.0
    """Of a video: recording seconds a second."""
    poses: Poses = "refined"
    """Of a TUM file: as refined by later windows, or as known at the time."""
    metres: Flag = False
    """Of a TUM file: positions in metres instead of plane distances, where --plane-distance or an accelerometer told
    the scale."""
    force: Flag = False
    """Replace a file that is there."""

    def run(self) -> int:
        """Export."""
        from dvsviz.cli.report import export

        return export(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Write a session as one HTML page to send: curves, map, trajectory, each failure with its pictures and cause.

    Example:  dvsviz report sessions/r.h5 --out r.html
    """

    session: Annotated[Positional[Path], arg(metavar="SESSION")]
    """The session."""
    out: Annotated[Path | None, *option("FILE.html", Path, "NAME.report.html in the current folder")] = None
    """The page to write."""
    force: Flag = False
    """Replace a file that is there."""
    json: Json = False

    def run(self) -> int:
        """Report."""
        from dvsviz.cli.report import report

        return report(self)
