"""Walls and paths on which tracking fails for one known reason: for trying the diagnosis and the dashboard."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.simulate.event_camera import EventCameraModel
from dvsviz.simulate.motion import Motion, free_motion, handheld
from dvsviz.simulate.scenes import Bounds, shapes
from dvsviz.simulate.simulate import simulate
from dvsviz.simulate.suite_scenes import smooth_step
from dvsviz.simulate.texture import Texture, make_texture

Array = NDArray[np.float64]
Painter = Callable[[np.random.Generator, Bounds, float], Texture]
Planted = Literal["bare", "stripes", "jerk"]
"""A bare wall, stripes alone, a blow against the camera."""

# Where the shapes end, m right of the middle.
_SHAPES_END = 0.35
# What the hand goes away, m, to see nothing else than what lies beyond.
_AWAY = 1.3
PAPER, STRIPE, PERIOD = 0.7, 0.2, 0.07


def blank(x: Array) -> Array:
    """Return the brightness (N,) of bare wall."""
    return np.full_like(x, PAPER)


def stripes(x: Array) -> Array:
    """Return the brightness (N,) of upright stripes by their place across (N,), m."""
    return np.where((x / PERIOD) % 1.0 < 0.45, STRIPE, PAPER)


def shapes_until(beyond: Callable[[Array], Array]) -> Painter:
    """Return a painter of shapes that end at 0.35 m: to their right the brightness is `beyond` the place across."""

    def paint(rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
        left, top, _, _ = bounds
        image = shapes(rng, bounds, texel).image.copy()
        first = int((_SHAPES_END - left) / texel)
        image[:, first:] = beyond(left + texel * np.arange(first, image.shape[1]))
        return make_texture(image, texel=texel, left=left, top=top)

    return paint


def to_the_right(rng: np.random.Generator, seconds: float) -> Motion:
    """Return a hand that goes 1.3 m to the right from 1.2 to 2.4 s and looks at what is there."""
    hand = handheld(rng, seconds, scale=0.6)

    def position(t_s: Array) -> Array:
        return hand(t_s)[:, :3, 3] + smooth_step(t_s, 1.2, 2.4)[:, None] * np.array([_AWAY, 0.0, 0.0])

    return free_motion(position)


def jerked(rng: np.random.Generator, seconds: float) -> Motion:
    """Return a hand that is struck after 1.2 s: it turns to the right by 25 degrees in 5 ms."""
    hand = handheld(rng, seconds, scale=0.5)

    def motion(t_s: Array) -> Array:
        T = hand(t_s).copy()
        phi = np.zeros((len(T), 3))
        phi[:, 1] = np.radians(25.0) * smooth_step(t_s, 1.2, 1.205)
        T[:, :3, :3] = T[:, :3, :3] @ se3.exp_so3(phi)
        return T

    return motion


def plant(name: Planted, out: Path, *, seed: int = 3) -> None:
    """Write a short recording in which tracking fails for one reason: texture, stripes or speed.

    Args:
        name: for which.
        out: the file.
        seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    if name == "jerk":
        simulate(out, scene=shapes, motion=jerked(rng, 3.0), seconds=1.8, seed=seed)
        return
    wall = shapes_until(blank if name == "bare" else stripes)
    # Fewer events an edge than usual: two seconds of stripes are three million events.
    sensor = EventCameraModel(threshold_on=0.3, threshold_off=0.3)
    simulate(out, scene=wall, motion=to_the_right(rng, 2.2), seconds=2.2, seed=seed, sensor=sensor)
