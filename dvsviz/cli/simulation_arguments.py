"""What can be said of simulations on the command line; see `arguments`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from dvsviz.cli.options import Flag, option, read_size

SCENES = ("shapes", "poster", "stripes", "checkerboard", "planes", "boxes", "carpet", "room")
_PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
Layout = Literal["hdf5", "uzh", "rgbd"]
MOTIONS = ("handheld", "slider", "rotation", "turn", "shake", "circle", "rectangle", "lawnmower")
TURNS = ("rotation", "turn")


def _motion(word: str) -> str:
    if word not in MOTIONS and Path(word).suffix.lower() not in (".tum", ".txt"):
        raise ValueError(f"expected one of {', '.join(MOTIONS)}, or a file x.tum or x.txt, got {word}")
    return word


def _scene(word: str) -> str:
    if word not in SCENES and Path(word).suffix.lower() not in _PICTURES:
        raise ValueError(f"expected one of {', '.join(SCENES)}, or a picture x.png or x.jpg, got {word}")
    return word


def _seed(word: str) -> int:
    if not re.fullmatch(r"\d+", word):
        raise ValueError(f"expected a whole number of at least 0, got {word}")
    return int(word)


def _seconds(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"expected a number, got {word}") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class Simulate:
    """Write a simulated recording, with its ground truth.

    Examples:  dvsviz simulate --scene shapes --motion handheld --seconds 10 --seed 1 --out r.h5
               dvsviz simulate --scene boxes --motion circle --seconds 8 --out flight.h5
               dvsviz simulate --scene carpet --motion lawnmower --layout rgbd --out flight
               dvsviz simulate --scene photo.jpg --motion real-groundtruth.tum --out mine.h5
               dvsviz simulate --scene room --motion turn --seconds 20 --out turn.h5
               dvsviz simulate --motion shake --size 240x180 --layout rgbd --exposure-ms 10 --out frames
    """

    out: Annotated[Path, arg(metavar="FILE.h5|DIR")]
    """What to write: a file, or a folder where the layout is one."""
    scene: Annotated[str, *option("{" + ",".join(SCENES) + "}|PICTURE", _scene, "shapes")] = "shapes"
    """What is on the wall, a picture of one's own 2 m wide; or a scene with depth: planes, boxes on a plain floor,
    boxes on a carpet; a room all around a camera that only turns."""
    motion: Annotated[str, *option("{" + ",".join(MOTIONS) + "}|FILE.tum", _motion, "handheld")] = "handheld"
    """How the camera moves: a hand, a flight over boxes, or the poses of a TUM file."""
    seconds: Annotated[float | None, *option("S", _seconds, "10, or the whole of a flight or file")] = None
    """Duration."""
    seed: Annotated[int, *option("INT", _seed, "1")] = 1
    """Of everything random: the same seed writes the same events."""
    distance: float = 1.0
    """Metres to the wall."""
    tilt_deg: float = 5.0
    """Angle between the wall and the first image, degrees."""
    size: Annotated[tuple[int, int] | None, *option("WxH", read_size, "240x180; rgbd 640x480")] = None
    """Width and height of the sensor, pixels, its view as wide as that of the usual one."""
    calibration: Annotated[Path | None, *option("FILE", Path, "none")] = None
    """Calibration of the simulated camera: fx fy cx cy k1 k2 p1 p2 k3."""
    frames_hz: Annotated[float | None, *option("HZ", _seconds, "none; rgbd 30")] = None
    """Intensity frames a second beside the events; of rgbd, frames a second."""
    exposure_ms: Annotated[float, *option("MS", _seconds, "0: no blur")] = 0.0
    """How long the shutter of rgbd's intensity images is open."""
    layout: Layout = "hdf5"
    """hdf5: our recording; uzh: a folder of text; rgbd: a TUM folder of images and depth, without events."""
    force: Flag = False
    """Write over what is there."""

    def run(self) -> int:
        """Simulate."""
        from dvsviz.cli.simulations import simulate

        return simulate(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulateSuite:
    """Write the simulated recordings that trackers are measured by, those that are not there yet.

    Examples:  dvsviz simulate-suite --out suite  |  dvsviz simulate-suite --out suite --names shake tilt_30
    """

    out: Annotated[Path, arg(metavar="DIR")]
    """The folder of the suite."""
    names: Annotated[tuple[str, ...], arg(metavar="NAME [NAME ...]", help_behavior_hint="(default: all)")] = ()
    """Which recordings."""

    def run(self) -> int:
        """Simulate them."""
        from dvsviz.cli.simulations import simulate_suite

        return simulate_suite(self)
