"""Walls and paths of the suite's recordings that need their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.simulate.motion import Motion, free_motion, wobble
from dvsviz.simulate.scenes import (
    INK,
    Bounds,
    ellipse,
    fill_polygon,
    paint,
    poster,
    shape_layout,
)
from dvsviz.simulate.texture import Texture, make_texture

Array = NDArray[np.float64]

# The empty part of the wall of `shapes_translation`: centre and half size, m.
_VOID, _VOID_HALF = np.array([1.5, 0.0]), np.array([0.85, 0.7])
# The visit of it begins, arrives, leaves and ends, s: about one second without any other shape in view.
_VISIT_S = (20.3, 22.6, 23.4, 25.7)
# The stripes of `slider_far` begin here, m: in the last quarter nothing else is in view.
_FOREST = 0.257 - 0.37


def smooth_step(t_s: Array, start: float, end: float) -> Array:
    """Return 0 before `start`, 1 after `end`, with jerk-limited motion in between (N,)."""
    s = np.clip((np.asarray(t_s) - start) / (end - start), 0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def voided_shapes(rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
    """Return a wall of shapes with an empty part, at whose border one oval is partly seen from its middle."""
    layout = shape_layout(rng, bounds, spacing=0.36, radius=(0.06, 0.115))
    kept = [p for p in layout if not np.any(np.all(np.abs(p - _VOID) < _VOID_HALF, axis=1))]
    # Seen from the middle the image ends at -0.6: a quarter of the oval is in view.
    oval = ellipse(np.random.default_rng(0), _VOID + np.array([-0.62, 0.08]), 0.13, 0.6)
    return paint([*kept, oval], bounds, texel)


def voided_path(rng: np.random.Generator, seconds: float) -> Motion:
    """Return a translation that goes to the empty part of the wall at 23 s, for about a second."""
    hand = wobble(rng, [0.35, 0.28, 0.1], low_hz=0.2, high_hz=1.2, seconds=seconds)
    drift = wobble(rng, [0.02, 0.02, 0.01], low_hz=0.3, high_hz=1.0, seconds=seconds)

    def position(t_s: Array) -> Array:
        share = smooth_step(t_s, *_VISIT_S[:2]) - smooth_step(t_s, *_VISIT_S[2:])
        return (1 - share)[:, None] * hand(t_s) + share[:, None] * (np.array([*_VOID, 0.0]) + drift(t_s))

    return free_motion(position)


def sparse_shapes(rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
    """Return a wall with two or three small shapes in view."""
    return paint(shape_layout(rng, bounds, spacing=0.62, radius=(0.05, 0.1)), bounds, texel)


def near_poster(rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
    """Return a poster that is looked at from near."""
    return poster(rng, bounds, texel, contrast=0.7)


def forest(rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
    """Return a poster whose right part is vertical stripes alone: along them nothing can be seen."""
    image = near_poster(rng, bounds, texel).image.copy()
    left, top, right, bottom = bounds
    image[:, max(int((_FOREST - left) / texel), 0) :] = 0.5
    x = _FOREST
    while x < right + 0.2:
        width = rng.uniform(0.01, 0.04)
        bar = [(x, top - 1), (x + width, top - 1), (x + width, bottom + 1), (x, bottom + 1)]
        fill_polygon(image, bar, float(rng.uniform(INK, 0.3)), left=left, top=top, texel=texel)
        x += width + rng.uniform(0.015, 0.06)
    return make_texture(image, texel=texel, left=left, top=top)


def gentle(rng: np.random.Generator, seconds: float) -> Motion:
    """Return a hand's motion with turns of ±6 degrees, for walls that are seen at a slant."""
    position = wobble(rng, [0.22, 0.18, 0.08], low_hz=0.08, high_hz=0.5, seconds=seconds)
    return free_motion(position, wobble(rng, np.radians([6, 6, 10]), low_hz=0.1, high_hz=0.8, seconds=seconds))


def brisk(rng: np.random.Generator, seconds: float) -> Motion:
    """Return a quick hand's motion: about 30 m of path a minute."""
    position = wobble(rng, [0.25, 0.2, 0.1], low_hz=0.2, high_hz=1.2, seconds=seconds)
    return free_motion(position, wobble(rng, np.radians([9, 12, 12]), low_hz=0.2, high_hz=1.4, seconds=seconds))


def along_and_back(rng: np.random.Generator, seconds: float) -> Motion:
    """Return a walk of 5 m along the wall and back, with a hand's motion on it."""
    hand = wobble(rng, [0.08, 0.12, 0.08], low_hz=0.1, high_hz=0.6, seconds=seconds)
    turn = wobble(rng, np.radians([6, 8, 8]), low_hz=0.1, high_hz=0.7, seconds=seconds)

    def position(t_s: Array) -> Array:
        p = hand(t_s)
        p[:, 0] += -2.5 + 2.5 * (1 - np.cos(2 * np.pi * np.asarray(t_s) / seconds))
        return p

    return free_motion(position, turn)


def kidnapped(rng: np.random.Generator, seconds: float, covered: tuple[tuple[float, float], ...]) -> Motion:
    """Return a hand's motion that goes elsewhere, and turns about the optical axis, while the lens is covered.

    Args:
        rng: gives the path.
        seconds: duration.
        covered: (start, end) of each time of darkness, s; all that is visited lies within what was seen before
            the first one.
    """
    # Before the first darkness the hand runs once around what will be visited.
    hand = wobble(rng, [0.12, 0.1, 0.06], low_hz=0.12, high_hz=0.7, seconds=seconds)
    turn = wobble(rng, np.radians([6, 7, 6]), low_hz=0.12, high_hz=0.8, seconds=seconds)
    angles = rng.permutation(len(covered)) * 2 * np.pi / len(covered) + rng.uniform(0, 2 * np.pi)
    centres = np.stack([0.4 * np.cos(angles), 0.3 * np.sin(angles), rng.uniform(-0.08, 0.08, len(covered))], axis=1)
    rolls = rng.uniform(-0.5, 0.5, len(covered))
    around_s = covered[0][0]

    def motion(t_s: Array) -> Array:
        t = np.asarray(t_s, dtype=np.float64)
        round_trip = 2 * np.pi * smooth_step(t, 0.0, around_s - 0.2)
        out = smooth_step(t, 0.0, 0.8) - smooth_step(t, around_s - 1.0, around_s - 0.1)
        base = np.stack([0.4 * out * np.cos(round_trip), 0.3 * out * np.sin(round_trip), 0 * t], axis=1)
        roll, before, roll_before = np.zeros(len(t)), np.zeros(3), 0.0
        for (start, end), centre, angle in zip(covered, centres, rolls, strict=True):
            share = smooth_step(t, start + 0.1, end - 0.1)
            base += share[:, None] * (centre - before)
            roll += share * (angle - roll_before)
            before, roll_before = centre, angle
        phi = np.zeros((len(t), 3))
        phi[:, 2] = roll
        return se3.pose(se3.exp_so3(phi) @ se3.exp_so3(turn(t)), base + hand(t))

    return motion


def away_and_back(
    rng: np.random.Generator,
    covered: tuple[float, float],
    back: tuple[float, float],
    away: tuple[float, float, float] = (1.7, 0.2, -0.1),
) -> Motion:
    """Return a hand's motion that goes to another part of the wall while the lens is covered, and walks back.

    Args:
        rng: gives the path.
        covered: (start, end) of the darkness, s.
        back: when it walks back, s.
        away: how far it goes, m.
    """
    hand = wobble(rng, [0.15, 0.12, 0.06], low_hz=0.2, high_hz=0.9, seconds=14)
    turn = wobble(rng, np.radians([6, 7, 8]), low_hz=0.15, high_hz=0.8, seconds=14)

    def position(t_s: Array) -> Array:
        share = smooth_step(t_s, covered[0] + 0.1, covered[1] - 0.1) - smooth_step(t_s, *back)
        return hand(t_s) + share[:, None] * np.array(away)

    return free_motion(position, turn)
