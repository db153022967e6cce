"""The encoder on a wheel: how far it rolled, in ticks."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def metres_per_tick(diameter: float, ticks_per_turn: int) -> float:
    """Return `pi d / n`, m.

    Raises:
        ValueError: a diameter or number of ticks that is not above 0.
    """
    if not (diameter > 0 and ticks_per_turn > 0):
        raise ValueError(f"encoder: expected diameter and ticks above 0, got {diameter}, {ticks_per_turn}")
    return np.pi * diameter / ticks_per_turn


def encoder_counts(v: ArrayLike, tau: ArrayLike, diameter: float, ticks_per_turn: int) -> NDArray[np.int64]:
    """Return the ticks z (N,) counted in each interval: `sum(z) = floor(sum(tau v) n / (pi d))`.

    What is left of a tick is carried on, so that nothing is lost; backward motion counts down.

    Args:
        v: velocity of the wheel's hub (N,) in each interval, m/s.
        tau: durations (N,) or one, s.
        diameter: d of the wheel, m.
        ticks_per_turn: n.
    """
    rolled = np.cumsum(np.asarray(v, dtype=np.float64) * np.asarray(tau)) / metres_per_tick(
        diameter, ticks_per_turn
    )
    return np.diff(np.floor(rolled), prepend=0.0).astype(np.int64)


def encoder_velocity(counts: ArrayLike, tau: ArrayLike, diameter: float, ticks_per_turn: int) -> Array:
    """Return `v = pi d z / (n tau)` (N,), m/s; off by at most one tick an interval."""
    return np.asarray(counts) * metres_per_tick(diameter, ticks_per_turn) / np.asarray(tau, dtype=np.float64)
