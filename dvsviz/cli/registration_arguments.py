"""What can be said of registrations on the command line; see `arguments`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from dvsviz.cli.options import Flag, Json, option, read_number

Features = Literal["sift", "sift-fast", "orb"]
Rig = Literal["auto", "aligned", "kinect"]


def _skips(word: str) -> tuple[int, ...]:
    if not re.fullmatch(r"[1-9]\d{0,5}(,[1-9]\d{0,5})*", word):
        raise ValueError(f"expected whole numbers from 1 on such as 1,2,5, got {word}")
    return tuple(dict.fromkeys(int(part) for part in word.split(",")))


@dataclass(frozen=True, slots=True, kw_only=True)
class Register:
    """Register a sequence of frames by several methods, and compare them with the truth.

    Examples:  dvsviz register rgbd --methods all --skips 1,2,5
               dvsviz register rgbd --methods pnp-icp,kabsch --out sessions/rgbd.h5   and then   dvsviz serve
               dvsviz register recording.h5 --methods essential,homography --session sessions/recording.h5
               dvsviz register flight --skips 30 --keyframes --loop-closure --plots plots --latex table.tex
    """

    path: Annotated[Positional[Path], arg(metavar="PATH")]
    """A TUM RGB-D folder, a folder of frame-*.color.png, or an event recording with intensity frames."""
    methods: Annotated[str, arg(metavar="NAME[,NAME...]|source|all")] = "source"
    """essential, kabsch, kabsch-essential, kabsch-pnp, pnp-iterative, epnp (these are: source), homography, pnp-icp,
    pnp-refined, kabsch-weighted, essential-refined, essential-magsac, homography-magsac, pnp-magsac, and none, which
    is to be beaten."""
    skips: Annotated[tuple[int, ...], *option("N[,N...]", _skips, "1")] = (1,)
    """Frames from one registered frame to the next."""
    features: Features = "sift"
    """What is matched."""
    keyframes: Flag = False
    """Also register against the last keyframe, as long as it overlaps."""
    loop_closure: Flag = False
    """Also close loops, and solve the pose graph."""
    speed: Annotated[float | None, *option("M/S", read_number(float), "not known")] = None
    """Metres a second: the scale of methods without depth, where nothing else gives it."""
    threshold: Annotated[float, *option("PX", read_number(float), "2")] = 2.0
    """Largest distance of an inlier."""
    calibration: Annotated[Path | None, *option("FILE", Path, "the one beside the frames")] = None
    """K (3 x 3), or fx fy cx cy [k1 k2 p1 p2 k3]."""
    depth_scale: Annotated[float | None, *option("UNITS", read_number(float), "5000 for TUM, else 1000")] = None
    """Units of the depth images a metre."""
    rig: Rig = "auto"
    """How depth and colour stand to each other."""
    session: Annotated[Path | None, *option("SESSION", Path, "none")] = None
    """A session of the event tracker on the same recording: one line more in the table."""
    out: Annotated[Path | None, *option("FILE.h5", Path, "none")] = None
    """Keep the registration as a session that the dashboard shows."""
    rerun: Annotated[Path | None, *option("FILE.rrd", Path, "none")] = None
    """Write a rerun recording: images, depth, points, matches, trajectories, errors."""
    plots: Annotated[Path | None, *option("DIR", Path, "none")] = None
    """Draw errors over time, trajectories, and errors against the skip, as SVG and PNG."""
    csv: Annotated[Path | None, *option("FILE", Path, "none")] = None
    """Write the table as CSV."""
    latex: Annotated[Path | None, *option("FILE", Path, "none")] = None
    """Write the table as LaTeX."""
    force: Flag = False
    """Replace files that are there."""
    json: Json = False

    def run(self) -> int:
        """Register."""
        from dvsviz.cli.register import register

        return register(self)
