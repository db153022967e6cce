"""From what a user says to what is simulated: a motion's name, file or function; a scene's name or value."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvsviz.simulate.flights import FLIGHTS, FlightName, flight
from dvsviz.simulate.motion import Array, Motion, MotionName, make_motion
from dvsviz.simulate.relief import Relief
from dvsviz.simulate.rooms import RELIEFS, ReliefName, make_relief
from dvsviz.simulate.scenes import PAINTERS, Painter, SceneName
from dvsviz.simulate.spline import SplineMotion, tum_motion

# Duration of motions that go on for ever, s.
DEFAULT_SECONDS = 10.0
AnyMotion = MotionName | FlightName | Path | Motion
AnyScene = SceneName | ReliefName | Painter | Relief


def make_scene(scene: AnyScene, rng: np.random.Generator) -> Painter | Relief:
    """Return the painter of a wall, or a scene with depth.

    Raises:
        ValueError: the name is not known.
    """
    if not isinstance(scene, str):
        return scene
    if scene in PAINTERS:
        return PAINTERS[scene]
    if scene in RELIEFS:
        return make_relief(scene, rng)
    raise ValueError(f"scene: expected {', '.join((*PAINTERS, *RELIEFS))}, got {scene!r}")


def make_path(
    motion: AnyMotion, rng: np.random.Generator, seconds: float | None, *, distance: float, relief: Relief | None
) -> tuple[Motion, float]:
    """Return the camera's motion in the scene's world, and the duration.

    Args:
        motion: a name; a TUM file, whose first pose is put where the scene wants a camera; or a function of time,
            which is taken as it is.
        rng: gives the path of a hand and the wind of a flight.
        seconds: duration; None for the whole of a file or flight, 10 s of the others.
        distance: of the wall, by which the paths of a hand before it are scaled, m.
        relief: the scene with depth, or None before a wall.

    Raises:
        ValueError: the name is not known, the motion does not suit the scene, or does not last so long.
        FormatError: the file is no trajectory.
    """
    path, placed = _motion(motion, rng, DEFAULT_SECONDS if seconds is None else seconds, distance, relief)
    if isinstance(path, SplineMotion):
        whole = path.seconds
        if seconds is not None and seconds > whole:
            raise ValueError(f"seconds: expected at most the {whole:.3f} s that the motion lasts, got {seconds:g}")
        seconds = whole if seconds is None else seconds
    if placed and relief is not None:
        path = _from(relief.T_world_hand, path)
    return path, DEFAULT_SECONDS if seconds is None else seconds


def _motion(
    motion: AnyMotion, rng: np.random.Generator, seconds: float, distance: float, relief: Relief | None
) -> tuple[Motion, bool]:
    """Return a motion, and whether it is one that begins where the scene wants a camera."""
    if isinstance(motion, Path):
        return tum_motion(motion), True
    if not isinstance(motion, str):
        return motion, False
    if motion in FLIGHTS:
        if relief is None or not relief.has_floor:
            raise ValueError(f"motion: {motion} is flown over a floor: expected the scene boxes or carpet")
        return flight(motion, rng), False
    return make_motion(motion, rng, seconds, distance=distance if relief is None else 1.0), True


def _from(T_world_start: Array, motion: Motion) -> Motion:
    """Return a motion that is seen from a pose (4, 4)."""
    return lambda t_s: T_world_start @ motion(t_s)
