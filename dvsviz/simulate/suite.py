"""The suite: recordings with truth by which trackers are compared, each made once and kept.

The recordings of one version never change: a changed recipe raises `SUITE_VERSION`, and all are made again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dvsviz.config import Motion as TrackerMotion
from dvsviz.geometry.camera import Camera
from dvsviz.simulate import suite_scenes as own
from dvsviz.simulate.cover import Cover
from dvsviz.simulate.event_camera import EventCameraModel
from dvsviz.simulate.motion import Motion, MotionName, slider
from dvsviz.simulate.panorama import boxes
from dvsviz.simulate.scenes import Painter, SceneName, shapes
from dvsviz.simulate.simulate import default_camera, simulate

SUITE_VERSION = 2
_INDEX = "suite.json"

_VGA = Camera(width=640, height=480, fx=530.0, fy=530.0, cx=319.5, cy=239.5)
_HD = Camera(width=1280, height=720, fx=1000.0, fy=1000.0, cx=639.5, cy=359.5)
_WIDE = Camera(
    width=346, height=260, fx=190.0, fy=190.0, cx=171.0, cy=131.0, distortion=(-0.32, 0.11, 4e-4, -3e-4, -0.01)
)
_DARK_S = tuple((t, t + 1.0) for t in (5.0, 10.0, 14.5, 19.0, 24.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """Figures to reach: RMSE of the refined poses after Sim(3) alignment, and speed.

    Attributes:
        position_percent: of the mean plane distance; None where it is not asked.
        rotation_deg: after the best constant world rotation.
        rtf: recording seconds by wall seconds, at least.
        normal_deg: error of the plane's normal.
        other: what else is asked, in words.
    """

    position_percent: float | None = None
    rotation_deg: float | None = None
    rtf: float | None = None
    normal_deg: float | None = None
    other: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SuiteEntry:
    """One recording of the suite.

    Attributes:
        name: of the recording: its file is `name.h5`.
        scene: what is on the wall: a name or a painter.
        motion: name of the motion, or a function of a generator and the duration that makes it.
        seconds: duration.
        camera: lens and pixels.
        wanted: the figures to reach.
        tracked_as: motion model that a tracker is given.
        seed: of everything random.
        options: further arguments of `simulate`.
    """

    name: str
    scene: SceneName | Painter
    motion: MotionName | Callable[[np.random.Generator, float], Motion]
    seconds: float
    wanted: Wanted
    camera: Camera = field(default_factory=default_camera)
    tracked_as: TrackerMotion = "planar"
    seed: int = 1
    options: dict[str, Any] = field(default_factory=dict)

    def path(self, folder: Path) -> Path:
        """Return the recording's file in the suite's folder."""
        return folder / f"{self.name}.h5"

    def write(self, out: Path, progress: Callable[[float], None] | None = None) -> None:
        """Make the recording."""
        rng, made = np.random.default_rng([self.seed, 100]), self.motion
        motion: MotionName | Motion = made(rng, self.seconds) if callable(made) else made
        simulate(
            out, scene=self.scene, motion=motion, seconds=self.seconds, seed=self.seed, camera=self.camera,
            progress=progress, **self.options,
        )  # fmt: skip


def _slide(_: np.random.Generator, seconds: float) -> Motion:
    # A hand-mounted camera is never quite square to its rail.
    return slider(start=-0.163 * seconds / 2, turn=(0.01, -0.02, 0.015))


def _kidnapped(rng: np.random.Generator, seconds: float) -> Motion:
    return own.kidnapped(rng, seconds, _DARK_S)


def _wide(rng: np.random.Generator, bounds: tuple[float, float, float, float], texel: float):
    return shapes(rng, bounds, texel, size=1.2)


_TILTED = Wanted(position_percent=0.8, normal_deg=1.0, other="normal within 1 degree after 5 s")
_LARGE = Wanted(position_percent=0.4, rtf=1.0)

SUITE: tuple[SuiteEntry, ...] = (
    SuiteEntry(
        name="shapes_6dof", scene="shapes", motion=own.brisk, seconds=60.0,
        wanted=Wanted(position_percent=0.5, rotation_deg=0.3, rtf=4.0, other="no growth over the last 10 s"),
    ),
    SuiteEntry(
        name="shapes_translation", scene=own.voided_shapes, motion=own.voided_path, seconds=60.0,
        wanted=Wanted(position_percent=0.8, other="outside the second at 23 s; back on the map within 0.3 s"),
        options={"tilt_deg": 2.0},
    ),
    SuiteEntry(
        name="slider_close", scene=own.near_poster, motion=_slide, seconds=6.3,
        wanted=Wanted(position_percent=1.0, normal_deg=2.0), options={"distance": 0.3, "tilt_deg": 3.0},
    ),
    SuiteEntry(
        name="slider_far", scene=own.forest, motion=_slide, seconds=6.3,
        wanted=Wanted(position_percent=1.0, other="the weak direction named in the last quarter"),
        options={"distance": 0.6, "tilt_deg": 3.0},
    ),
    SuiteEntry(
        name="poster_6dof", scene="poster", motion=own.brisk, seconds=30.0,
        wanted=Wanted(position_percent=1.0, rotation_deg=0.6, rtf=1.0),
        options={"sensor": EventCameraModel(threshold_on=0.22, threshold_off=0.22)},
    ),
    SuiteEntry(
        name="shake", scene="shapes", motion="shake", seconds=20.0,
        wanted=Wanted(position_percent=0.6, rotation_deg=0.4, rtf=2.0),
    ),
    SuiteEntry(
        name="low_texture", scene=own.sparse_shapes, motion="handheld", seconds=30.0,
        wanted=Wanted(position_percent=1.0, rotation_deg=0.6),
    ),
    SuiteEntry(
        name="tilt_30", scene="shapes", motion=own.gentle, seconds=20.0, wanted=_TILTED, options={"tilt_deg": 30.0},
    ),
    SuiteEntry(
        name="tilt_45", scene="shapes", motion=own.gentle, seconds=20.0, wanted=_TILTED, options={"tilt_deg": 45.0},
    ),
    SuiteEntry(
        name="kidnap", scene="shapes", motion=_kidnapped, seconds=30.0,
        wanted=Wanted(position_percent=0.8, other="5 of 5 found, each within 0.25 s of data"),
        options={"cover": Cover(intervals=_DARK_S)},
    ),
    SuiteEntry(
        name="explore", scene="shapes", motion=own.along_and_back, seconds=60.0,
        wanted=Wanted(other="1 % of the distance travelled before closing, 0.4 % after"), options={"tilt_deg": 2.0},
    ),
    SuiteEntry(
        name="boxes_rotation", scene=boxes, motion="rotation", seconds=30.0, tracked_as="rotation",
        wanted=Wanted(rotation_deg=0.5, other="absolute over 30 s"), options={"panorama": True},
    ),
    SuiteEntry(
        name="vga_shapes", scene="shapes", motion="handheld", seconds=20.0, camera=_VGA, wanted=_LARGE,
    ),
    SuiteEntry(
        name="hd_shapes", scene="shapes", motion="handheld", seconds=8.0, camera=_HD, wanted=_LARGE,
    ),
    SuiteEntry(
        name="distorted", scene=_wide, motion="handheld", seconds=20.0, camera=_WIDE, wanted=_LARGE,
    ),
)  # fmt: skip


def suite_entries(names: Sequence[str] | None = None) -> tuple[SuiteEntry, ...]:
    """Return the suite's entries, all or those of the given names, in the suite's order.

    Raises:
        ValueError: a name is not in the suite.
    """
    known = [entry.name for entry in SUITE]
    if unknown := sorted(set(names or ()) - set(known)):
        raise ValueError(f"names: expected some of {', '.join(known)}, got {', '.join(unknown)}")
    return tuple(entry for entry in SUITE if names is None or entry.name in names)


def simulate_suite(
    out_dir: Path, names: Sequence[str] | None = None, progress: Callable[[str, float], None] | None = None
) -> tuple[SuiteEntry, ...]:
    """Make the recordings that are not there yet and return their entries.

    Args:
        out_dir: folder of the suite; made where it is missing.
        names: which recordings; all where None.
        progress: called with a recording's name and its share done, 0 to 1.

    Raises:
        ValueError: a name is not in the suite.
    """
    entries = suite_entries(names)
    out_dir.mkdir(parents=True, exist_ok=True)
    index = out_dir / _INDEX
    made: dict[str, int] = json.loads(index.read_text()) if index.exists() else {}
    for entry in entries:
        path = entry.path(out_dir)
        if made.get(entry.name) != SUITE_VERSION or not path.exists():
            entry.write(path, partial(progress, entry.name) if progress else None)
            made = {**(json.loads(index.read_text()) if index.exists() else {}), entry.name: SUITE_VERSION}
            index.write_text(json.dumps(made, indent=1, sort_keys=True) + "\n")
        if progress is not None:
            progress(entry.name, 1.0)
    return entries
