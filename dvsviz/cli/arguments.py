"""What can be said on the command line: one dataclass a subcommand, its docstring the help text."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, Union, get_args

import tyro
from tyro.conf import Positional, arg

from dvsviz.cli.export_arguments import Export, Poses, Report
from dvsviz.cli.options import Calibration, Flag, Folder, Json, Repair, Size, option, read_number, read_roi
from dvsviz.cli.registration_arguments import Register
from dvsviz.cli.simulation_arguments import Simulate, SimulateSuite
from dvsviz.config import ImuUse, Mode, Motion, Objective
from dvsviz.errors import DvsvizError

if TYPE_CHECKING:
    from dvsviz.events.filters import FilterConfig

Target = Literal["hdf5", "uzh", "dsec", "aedat4", "tum"]
Align = Literal["sim3", "se3", "none"]


class UsageError(DvsvizError):
    """A command line that cannot be understood."""


class Command(Protocol):
    """A parsed subcommand."""

    def run(self) -> int:
        """Do it and return the exit code."""
        ...


def _one_of(choices: object) -> Callable[[str], str]:
    """Return a reader of one of a literal type's words."""

    def read(word: str) -> str:
        if word not in get_args(choices):
            raise ValueError(f"expected one of {', '.join(get_args(choices))}, got {word}")
        return word

    return read


@dataclass(frozen=True, slots=True, kw_only=True)
class Opening:
    """How a recording is opened."""

    size: Size = None
    calibration: Calibration = None
    repair: Repair = False
    topic: Annotated[str | None, *option("NAME", str, "the only one")] = None
    """Which event topic of a bag."""
    ground_truth: Annotated[str | None, *option("FILE|TOPIC", str, "the recorded one")] = None
    """True poses: TUM or Event-Camera-Dataset text, EuRoC CSV, or a topic of the bag."""
    gt_offset: Annotated[float, *option("SECONDS", read_number(float), "0")] = 0.0
    """What is added to the times of the true poses."""
    hot_pixels: Flag = False
    """Leave out the events of pixels that fire far more often than those around them."""
    background_activity: Annotated[int | None, *option("US", read_number(int), "off")] = None
    """Leave out events without another one beside them in so many microseconds before."""
    refractory: Annotated[int | None, *option("US", read_number(int), "off")] = None
    """Leave out events of a pixel that fired less than so many microseconds before."""

    def filters(self) -> FilterConfig:
        """Return the filters that were said.

        Raises:
            UsageError: a time that is none.
        """
        from dvsviz.events.filters import FilterConfig

        try:
            return FilterConfig(
                hot_pixels=self.hot_pixels,
                background_us=self.background_activity,
                refractory_us=self.refractory,
            )
        except ValueError as error:
            raise UsageError(str(error)) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracking(Opening):
    """How a recording is tracked."""

    motion: Annotated[Motion | None, *option("{planar,translation,rotation,auto}", _one_of(Motion), "planar")] = (
        None
    )
    """planar: 6-DoF in front of a plane; translation: no rotation; rotation: no translation."""
    mode: Annotated[Mode | None, *option("{map,contrast}", _one_of(Mode), "map")] = None
    """map: windows are aligned with the edge map; contrast: contrast maximization all through, slower."""
    objective: Annotated[
        Objective | None, *option("{" + ",".join(get_args(Objective)) + "}", _one_of(Objective), "variance")
    ] = None
    """What is maximised where contrast is: highpass and michelson are for study."""
    window: Annotated[int | None, *option("N", read_number(int), "chosen by the image motion")] = None
    """Events a window; a window also ends after 100 ms."""
    imu: Annotated[ImuUse | None, *option("{auto,off}", _one_of(ImuUse), "off")] = None
    """auto: rotations are predicted by the recording's gyroscope, and go on by it where nothing is seen."""
    plane_distance: Annotated[float | None, *option("METRES", read_number(float), "not known")] = None
    """Distance from the first camera to the plane, for metric output."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Info(Opening):
    """Say what is in a recording or a session.

    Example:  dvsviz info slider_depth.zip --json
    """

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A recording (file, folder or archive) or a session."""
    json: Json = False

    def run(self) -> int:
        """Print it."""
        from dvsviz.cli.files import info

        return info(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Convert(Opening):
    """Write a recording, or a part of it, in another format.

    Examples:  dvsviz convert slider_depth.zip slider.h5  |  dvsviz convert r.h5 r.aedat4 --start 1 --end 3
               dvsviz convert events.raw part.h5 --roi 320,180,640,360 --refractory 1000
    """

    recording: Annotated[Positional[Path], arg(metavar="IN")]
    """The recording: file, folder or archive."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """What is written."""
    to: Annotated[
        Target | None, *option("{hdf5,uzh,dsec,aedat4,tum}", _one_of(Target), "told by the ending of OUT")
    ] = None
    """The format; tum writes the true poses alone."""
    start: Annotated[float | None, *option("SECONDS", read_number(float), "the first event")] = None
    """Seconds after the first event."""
    end: Annotated[float | None, *option("SECONDS", read_number(float), "the last event")] = None
    """Seconds after the first event, exclusive."""
    roi: Annotated[tuple[int, int, int, int] | None, *option("X,Y,W,H", read_roi, "the whole sensor")] = None
    """Pixels that are kept."""
    stride: Annotated[int, *option("N", read_number(int), "1")] = 1
    """Every N-th event is kept."""
    force: Flag = False
    """Replace a file that is there."""
    json: Json = False

    def run(self) -> int:
        """Convert."""
        from dvsviz.cli.files import convert

        return convert(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Track(Tracking):
    """Track a recording into a session.

    Examples:  dvsviz track r.h5  |  dvsviz track slider_depth.zip --motion translation --json
               dvsviz track events.npz --size 240x180 --calibration calib.txt
               dvsviz track --live aedat4+tcp://127.0.0.1:7777 --out live.h5 --record recording.h5
    """

    recording: Annotated[Positional[Path | None], arg(metavar="[RECORDING]", help_behavior_hint="")] = None
    """The recording: file, folder or archive."""
    live: Annotated[str | None, *option("aedat4+tcp://HOST:PORT|camera", str, "none")] = None
    """Track a network stream or a connected camera instead; Ctrl-C ends the session."""
    record: Annotated[Path | None, *option("FILE.h5", Path, "none")] = None
    """Record the whole live stream."""
    out: Annotated[Path | None, *option("SESSION.h5", Path, "sessions/NAME.h5")] = None
    """The session to write."""
    force: Flag = False
    """Replace a session that is there."""
    resume: Flag = False
    """Continue an interrupted session from its last checkpoint."""
    json: Json = False
    rerun: Annotated[Path | None, *option("FILE.rrd", Path, "none")] = None
    """Log to a rerun recording while tracking."""

    def run(self) -> int:
        """Track."""
        from dvsviz.cli.runs import track

        return track(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay(Opening):
    """Serve a recording as a network stream, at the pace at which it was recorded.

    Example:  dvsviz replay slider_depth.zip --listen 7777   and elsewhere
              dvsviz track --live aedat4+tcp://127.0.0.1:7777 --out live.h5
    """

    recording: Annotated[Positional[Path], arg(metavar="RECORDING")]
    """The recording: file, folder or archive."""
    listen: Annotated[int, arg(metavar="PORT")] = 7777
    """Port to listen at; 0 for any free one."""
    host: str = "127.0.0.1"
    """Address to listen at."""
    speed: float = 1.0
    """Recording seconds a second."""

    def run(self) -> int:
        """Serve."""
        from dvsviz.cli.live import replay

        return replay(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch(Tracking):
    """Track several recordings, one after the other, and print a table.

    Example:  dvsviz batch recordings/*.h5 --sessions runs
    """

    recordings: Annotated[Positional[tuple[Path, ...]], arg(metavar="RECORDING [RECORDING ...]")]
    """The recordings: files, folders or archives."""
    sessions: Folder = None
    force: Flag = False
    """Replace sessions that are there."""
    json: Json = False

    def run(self) -> int:
        """Track them all."""
        from dvsviz.cli.runs import batch

        return batch(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluate:
    """Compare a session, or a trajectory in TUM layout, with the truth.

    Examples:  dvsviz evaluate sessions/r.h5  |  dvsviz evaluate estimate.tum --truth truth.tum --align se3
    """

    session: Annotated[Positional[Path], arg(metavar="SESSION")]
    """A session, or a TUM file of estimated poses."""
    truth: Annotated[Path | None, *option("FILE", Path, "the session's own"), arg(aliases=("--ground-truth",))] = (
        None
    )
    """True poses: TUM or Event-Camera-Dataset text, or EuRoC CSV."""
    gt_offset: Annotated[float, *option("SECONDS", read_number(float), "0")] = 0.0
    """What is added to the times of the true poses."""
    align: Align = "sim3"
    """What is removed before positions are compared: similarity, rigid motion or nothing."""
    poses: Poses = "refined"
    """A session's poses: as refined by later windows, or as known at the time."""
    json: Json = False

    def run(self) -> int:
        """Compare."""
        from dvsviz.cli.files import evaluate

        return evaluate(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Serve:
    """Open the dashboard in a browser.

    Examples:  dvsviz serve  |  dvsviz serve slider_depth.zip --port 0 --no-browser
               dvsviz serve --live aedat4+tcp://127.0.0.1:7777 --record recording.h5
    """

    paths: Annotated[Positional[tuple[Path, ...]], arg(metavar="[PATH ...]", help_behavior_hint="")] = ()
    """Recordings to track live, and sessions to show."""
    host: str = "127.0.0.1"
    """Address to listen at; others than this machine's own are reachable from the network."""
    port: Annotated[int, arg(metavar="PORT")] = 8765
    """Port to listen at; 0 for any free one."""
    no_browser: Flag = False
    """Do not open a browser."""
    sessions: Folder = None
    recordings: Annotated[tuple[Path, ...], arg(metavar="DIR ...")] = ()
    """Folders whose recordings can be tracked from the page, besides those of the sessions' folder."""
    live: Annotated[str | None, *option("aedat4+tcp://HOST:PORT|camera", str, "none")] = None
    """Track a network stream or a connected camera, and watch it."""
    record: Annotated[Path | None, *option("FILE.h5", Path, "none")] = None
    """Record the whole live stream."""
    motion: Annotated[Motion | None, *option("{planar,translation,rotation,auto}", _one_of(Motion), "planar")] = (
        None
    )
    """How the live stream is tracked."""
    calibration: Calibration = None
    rerun: Flag = False
    """Stream what is tracked to the rerun viewer that is open on this machine (`rerun`)."""
    rerun_port: Annotated[int, arg(metavar="PORT")] = 9876
    """Where that viewer listens."""

    def run(self) -> int:
        """Serve until stopped."""
        from dvsviz.cli.serve import serve

        return serve(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Doctor:
    """Say what dvsviz finds on this machine: versions, browser, folders, threads."""

    json: Json = False

    def run(self) -> int:
        """Print it."""
        from dvsviz.cli.doctor import doctor

        return doctor(self)


COMMANDS: dict[str, tuple[Any, str]] = {
    "info": (Info, "say what is in a recording or a session"),
    "convert": (Convert, "write a recording in another format, whole or in part"),
    "simulate": (Simulate, "write a simulated recording with its ground truth"),
    "simulate-suite": (SimulateSuite, "write the simulated recordings that trackers are measured by"),
    "track": (Track, "track a recording into a session"),
    "register": (Register, "register frames by several methods and compare them with the truth"),
    "evaluate": (Evaluate, "compare a session with the truth"),
    "export": (Export, "write a session for rerun, as trajectory, table, video or 3-D page"),
    "report": (Report, "write a session as one page to send"),
    "replay": (Replay, "serve a recording as a network stream"),
    "serve": (Serve, "open the dashboard"),
    "batch": (Batch, "track several recordings and print a table"),
    "doctor": (Doctor, "say what dvsviz finds on this machine"),
}

_DESCRIPTION = """Planar event-camera tracking, and a dashboard to understand it.

First steps:  dvsviz simulate --out r.h5  |  dvsviz track r.h5  |  dvsviz serve
"""


def parse(argv: Sequence[str]) -> Command:
    """Return the subcommand that the arguments say.

    Raises:
        UsageError: they say nothing that can be done, in one line.
        SystemExit: help or version was asked for and printed.
    """
    if list(argv) == ["--version"]:
        from dvsviz import __version__

        print(f"dvsviz {__version__}")
        raise SystemExit(0)
    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            if argv and argv[0] in COMMANDS:
                kind, _ = COMMANDS[argv[0]]
                return tyro.cli(kind, prog=f"dvsviz {argv[0]}", args=list(argv[1:]), config=config)
            kinds = (
                Annotated[kind, tyro.conf.subcommand(name, description=text)]
                for name, (kind, text) in COMMANDS.items()
            )
            every: Any = Union[tuple(kinds)]  # noqa: UP007
            return tyro.cli(every, prog="dvsviz", description=_DESCRIPTION, args=list(argv), config=config)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UsageError(_one_line(complaint.getvalue())) from None


def _one_line(box: str) -> str:
    """Return the complaint of tyro's framed message as one line."""
    parts: list[list[str]] = [[]]
    for line in box.splitlines():
        inside = line.strip("│╭╮╰╯ ")
        if re.fullmatch(r"[─\s]*", inside):
            parts.append([])
        elif line.startswith("│"):
            parts[-1].append(inside)
    sentences = [" ".join(part).rstrip(".") for part in parts if part]
    sentences = [sentence for sentence in sentences if not sentence.startswith("Argument helptext")]
    return "; ".join(sentences) or " ".join(box.split()) or "the arguments cannot be understood; see dvsviz --help"
