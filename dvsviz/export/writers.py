"""All that can be taken along, by kind: what the page and the command line ask for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from dvsviz.view.shown import ShownSession


class Kind(StrEnum):
    """What can be written of a session."""

    RRD = "rrd"
    TUM = "tum"
    CSV = "csv"
    PARQUET = "parquet"
    PNG = "png"
    WEBM = "webm"
    MP4 = "mp4"
    SCENE = "scene"
    REPORT = "report"

    @property
    def ending(self) -> str:
        """What its file's name ends with."""
        return f".{self}.html" if self in (Kind.SCENE, Kind.REPORT) else f".{self}"

    @property
    def is_video(self) -> bool:
        """True where frames are played."""
        return self in (Kind.WEBM, Kind.MP4)

    @property
    def has_part(self) -> bool:
        """True where a part of the time can be chosen."""
        return self.is_video or self is Kind.RRD

    @property
    def shows_events(self) -> bool:
        """True where the recording's events are drawn."""
        return self in (Kind.RRD, Kind.WEBM, Kind.MP4, Kind.SCENE, Kind.REPORT)


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Which part of a session's time a video shows and a rerun recording marks.

    Attributes:
        start_s: seconds after the first event; None for the first window.
        end_s: seconds after the first event, exclusive; None for the last window.
        speed: recording seconds a second.
    """

    start_s: float | None = None
    end_s: float | None = None
    speed: float = 1.0

    def windows(self, shown: ShownSession) -> tuple[int, int] | None:
        """Return the first and the last window of the part, or None where it is the whole or nothing."""
        t_s = (shown.session.column("start_us") - shown.session.header.first_us) * 1e-6
        inside = np.flatnonzero(
            (t_s >= (-np.inf if self.start_s is None else self.start_s))
            & (t_s < (np.inf if self.end_s is None else self.end_s))
        )
        if len(inside) in (0, len(t_s)):
            return None
        return int(inside[0]), int(inside[-1])


def write(
    shown: ShownSession,
    kind: Kind,
    out: Path,
    part: Part | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Write a session as a file; replaced where it exists.

    Args:
        shown: the session.
        kind: what is written.
        out: the file.
        part: of a video or a rerun recording, which part of the time.
        progress: called with the share that is done, 0 to 1; what it raises ends the writing, and nothing is left.

    Raises:
        DvsvizError: there is nothing to write, or the file cannot be written.
    """
    # Each writer is imported when it is asked for: rerun alone takes 0.4 s.
    match kind:
        case Kind.RRD:
            from dvsviz.export.rerun import export_rerun

            windows = None if part is None else part.windows(shown)
            export_rerun(shown.session, out, recording=shown.recording, progress=progress, windows=windows)
        case Kind.TUM:
            from dvsviz.export.tum import export_tum

            export_tum(shown.session, out)
        case Kind.CSV:
            from dvsviz.view.figures import figures_csv

            out.write_text(figures_csv(shown), encoding="utf-8")
        case Kind.PARQUET:
            from dvsviz.export.parquet import export_parquet

            export_parquet(shown, out)
        case Kind.PNG:
            from dvsviz.view.figures import map_png

            out.write_bytes(map_png(shown))
        case Kind.WEBM | Kind.MP4:
            from dvsviz.export.video import export_video

            chosen = part or Part()
            export_video(
                shown, out, start_s=chosen.start_s, end_s=chosen.end_s, speed=chosen.speed, progress=progress
            )
        case Kind.SCENE:
            from dvsviz.view.scene_page import write_scene_page

            write_scene_page(shown, out, progress)
        case Kind.REPORT:
            from dvsviz.export.report import write_report

            write_report(shown, out, progress)
