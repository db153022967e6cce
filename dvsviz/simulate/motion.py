"""Camera motions: functions of time that return poses.

A motion is a function `t_s (N,) -> Ts_world_camera (N, 4, 4)`. World: optical axes of a camera that looks at the wall
(x right, y down, z toward the wall), its origin where the camera is on average at the start.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvsviz.geometry import se3

Array = NDArray[np.float64]
Motion = Callable[[Array], Array]
MotionName = Literal["handheld", "slider", "rotation", "turn", "shake"]


def wobble(
    rng: np.random.Generator, amplitude: ArrayLike, *, low_hz: float, high_hz: float, seconds: float, terms: int = 6
) -> Callable[[Array], Array]:
    """Return a smooth random function of time `(N,) -> (N, axes)`: a sum of sinusoids, amplitudes falling as 1/f.

    Args:
        rng: gives frequencies and phases.
        amplitude: (axes,) largest magnitude of each axis within the duration.
        low_hz: lowest frequency.
        high_hz: highest frequency.
        seconds: duration over which `amplitude` is reached.
        terms: sinusoids an axis.
    """
    size = np.atleast_1d(np.asarray(amplitude, dtype=np.float64))
    # Jittered log-spaced frequencies: every band is present in every draw.
    edges = np.geomspace(low_hz, high_hz, terms + 1)
    f = np.exp(rng.uniform(np.log(edges[:-1]), np.log(edges[1:]), (len(size), terms)))
    phase = rng.uniform(0, 2 * np.pi, (len(size), terms))

    def raw(t_s: Array) -> Array:
        out = np.empty((len(t_s), len(size)))
        for axis in range(len(size)):
            out[:, axis] = np.sin(2 * np.pi * t_s[:, None] * f[axis] + phase[axis]) @ (1 / f[axis])
        return out

    grid = raw(np.linspace(0, seconds, max(int(seconds * 50), 500)))
    middle = (grid.max(axis=0) + grid.min(axis=0)) / 2
    scale = size / np.maximum(np.abs(grid - middle).max(axis=0), 1e-12)
    return lambda t_s: (raw(np.asarray(t_s, dtype=np.float64)) - middle) * scale


def free_motion(position: Callable[[Array], Array], turn: Callable[[Array], Array] | None = None) -> Motion:
    """Return the motion of a position (N, 3) in m and a rotation vector (N, 3) in rad, both functions of time."""

    def motion(t_s: Array) -> Array:
        p = position(t_s)
        return se3.pose(np.eye(3) if turn is None else se3.exp_so3(turn(t_s)), p)

    return motion


def handheld(rng: np.random.Generator, seconds: float, *, scale: float = 1.0) -> Motion:
    """Return a hand's 6-DoF motion: ±0.25 m sideways, ±0.1 m in depth, ±12 degrees, up to about 0.5 m/s.

    Args:
        rng: gives the path.
        seconds: its duration.
        scale: multiplies the positions: the distance to the wall in metres.
    """
    position = wobble(rng, np.array([0.25, 0.2, 0.1]) * scale, low_hz=0.08, high_hz=0.5, seconds=seconds)
    turn = wobble(rng, np.radians([9, 12, 12]), low_hz=0.1, high_hz=0.8, seconds=seconds)
    return free_motion(position, turn)


def slider(*, speed: float = 0.163, start: float = -0.5, turn: ArrayLike = (0.0, 0.0, 0.0)) -> Motion:
    """Return a straight motion along x at constant speed (m/s) with a constant orientation."""
    phi = np.asarray(turn, dtype=np.float64)

    def motion(t_s: Array) -> Array:
        p = np.zeros((len(t_s), 3))
        p[:, 0] = start + speed * np.asarray(t_s)
        return se3.pose(se3.exp_so3(phi), p)

    return motion


def rotation(rng: np.random.Generator, seconds: float) -> Motion:
    """Return a pure rotation: ±12 degrees of pitch, ±25 of yaw, ±15 of roll, up to about 1 rad/s."""
    turn = wobble(rng, np.radians([12, 25, 15]), low_hz=0.1, high_hz=0.7, seconds=seconds)
    return free_motion(lambda t_s: np.zeros((len(t_s), 3)), turn)


def turn(rng: np.random.Generator, seconds: float, *, degrees: float = 400.0) -> Motion:
    """Return a turn about the vertical axis, past where it began, that nods by ±8 degrees and rolls by ±6.

    Args:
        rng: nods and rolls.
        seconds: its duration; it gathers speed over the first tenth.
        degrees: how far it turns in all.
    """
    rest = wobble(rng, np.radians([8, 0, 6]), low_hz=0.1, high_hz=0.6, seconds=seconds)
    start = 0.1

    def motion(t_s: Array) -> Array:
        s = np.asarray(t_s, dtype=np.float64) / seconds
        share = np.where(s < start, np.maximum(s, 0) ** 2 / (2 * start), s - start / 2) / (1 - start / 2)
        yaw = np.zeros((len(s), 3))
        yaw[:, 1] = np.radians(degrees) * share
        return se3.pose(se3.exp_so3(yaw) @ se3.exp_so3(rest(t_s)), np.zeros((len(s), 3)))

    return motion


def shake(rng: np.random.Generator, seconds: float) -> Motion:
    """Return a fast shake: up to about 2.3 m/s and 4.7 rad/s."""
    position = wobble(rng, [1, 0.8, 0.35], low_hz=0.5, high_hz=2.5, seconds=seconds)
    turn = wobble(rng, [0.8, 0.9, 1.0], low_hz=0.6, high_hz=3.0, seconds=seconds)
    t = np.linspace(0, seconds, int(seconds * 1000) + 2)
    v = np.linalg.norm(np.diff(position(t), axis=0), axis=1).max() / (t[1] - t[0])
    w = np.linalg.norm(np.diff(turn(t), axis=0), axis=1).max() / (t[1] - t[0])
    return free_motion(lambda s: position(s) * (2.3 / v), lambda s: turn(s) * (4.7 / w))


def make_motion(name: str, rng: np.random.Generator, seconds: float, *, distance: float = 1.0) -> Motion:
    """Return a motion by its name.

    Raises:
        ValueError: the name is not known.
    """
    if name == "handheld":
        return handheld(rng, seconds, scale=distance)
    if name == "slider":
        return slider(start=-0.163 * seconds / 2)
    if name == "rotation":
        return rotation(rng, seconds)
    if name == "turn":
        return turn(rng, seconds)
    if name == "shake":
        return shake(rng, seconds)
    raise ValueError(f"motion: expected handheld, slider, rotation, turn or shake, got {name!r}")
