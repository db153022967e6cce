"""A hand over the lens: darkness that sweeps in from the side and out again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A hand before the lens is dark and out of focus: its border is this share of the image's width.
_DARK, _SOFT = 0.03, 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Cover:
    """When the lens is covered.

    Attributes:
        intervals: (start, end) in s, in order, from the first touch of the image to the last.
        sweep_s: time that the hand takes across the image, at the start and at the end of each interval.
    """

    intervals: tuple[tuple[float, float], ...]
    sweep_s: float = 0.08

    def _position(self, t_s: float) -> tuple[float, float] | None:
        """Return the hand's leading and trailing borders, 0 left to 1 right; None where it is away."""
        for start, end in self.intervals:
            if start < t_s < end:
                lead, trail = (t_s - start) / self.sweep_s, (t_s - end) / self.sweep_s + 1
                return min(lead, 1.0), max(trail, 0.0)
        return None

    def is_over(self, t_s: float) -> bool:
        """Return True where the hand is before some part of the image."""
        return self._position(t_s) is not None

    def is_dark(self, t_s: float) -> bool:
        """Return True where it is before all of it."""
        return self._position(t_s) == (1.0, 0.0)

    def over(self, image: NDArray[np.float32], t_s: float) -> NDArray[np.float32]:
        """Return what is seen of an intensity image (height, width) at a time."""
        borders = self._position(t_s)
        if borders is None:
            return image
        x = (np.arange(image.shape[1]) + 0.5) / image.shape[1]
        # Both borders run past the image by their softness, so that it is wholly dark in between.
        lead, trail = (b * (1 + _SOFT) for b in borders)
        behind_lead = np.clip((lead - x) / _SOFT, 0, 1)
        before_trail = np.clip((x - (trail - _SOFT)) / _SOFT, 0, 1)
        share = np.minimum(behind_lead, before_trail).astype(np.float32)
        return image * (1 - share) + np.float32(_DARK) * share

    def step_times(self, longest_s: float = 5e-4) -> Array:
        """Return times at which the sweeping hand must be looked at."""
        n = int(np.ceil(self.sweep_s / longest_s)) + 1
        spans = [np.linspace(t, t + self.sweep_s, n) for a, b in self.intervals for t in (a, b - self.sweep_s)]
        return np.concatenate(spans) if spans else np.zeros(0)
