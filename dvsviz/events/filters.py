"""Filters of events: hot pixels, background activity, refractory period; each counts what it keeps.

A filter sees the events in order, in chunks of any size, and its result does not depend on how they are cut.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dvsviz.events.events import Events

# A pixel is hot that fires ten times as often as the median of the 24 around it (at least 20 events more): edges are
# wider than one pixel or cross many, so that no texture of the real recordings tried makes a pixel stand out so far.
_HOT_RATIO = 10.0
_HOT_FLOOR = 20
_HOT_NEIGHBOURHOOD = 5
_NEVER = -(2**62)


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig:
    """Which events are kept.

    Attributes:
        hot_pixels: drop the events of pixels that `hot_pixels` finds.
        background_us: keep an event only where one of the eight pixels around it fired within this time before it.
        refractory_us: drop an event that follows a kept event of its pixel within less than this time.
    """

    hot_pixels: bool = False
    background_us: int | None = None
    refractory_us: int | None = None

    def __post_init__(self) -> None:
        for name, value in (("background_us", self.background_us), ("refractory_us", self.refractory_us)):
            if value is not None and not 1 <= value <= 60_000_000:
                raise ValueError(f"{name}: expected 1 to 60000000 us, got {value}")

    def to_json(self) -> str:
        """Return the settings as JSON text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> FilterConfig:
        """Return the settings in JSON text.

        Raises:
            ValueError: it is not what `to_json` writes.
        """
        values = json.loads(text)
        if not isinstance(values, dict) or not values.keys() <= {"hot_pixels", "background_us", "refractory_us"}:
            raise ValueError(f"filters: expected hot_pixels, background_us, refractory_us, got {text:.80}")
        return cls(**values)

    @property
    def is_active(self) -> bool:
        """Whether anything is filtered."""
        return self.hot_pixels or self.background_us is not None or self.refractory_us is not None


def hot_pixels(counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask (height, width) of the pixels that fire far more often than those around them.

    Args:
        counts: events a pixel (height, width) over the whole recording.
    """
    footprint = np.ones((_HOT_NEIGHBOURHOOD, _HOT_NEIGHBOURHOOD), bool)
    footprint[_HOT_NEIGHBOURHOOD // 2, _HOT_NEIGHBOURHOOD // 2] = False
    around = ndimage.median_filter(counts.astype(np.float64), footprint=footprint, mode="nearest")
    return (counts > _HOT_RATIO * around) & (counts >= around + _HOT_FLOOR)


def count_pixels(counts: NDArray[np.int64], events: Events) -> None:
    """Add the events to the counts a pixel (height, width), in place."""
    _count(counts, events.x_px, events.y_px)


@numba.njit(cache=True, nogil=True)
def _count(counts, x_px, y_px):
    for i in range(len(x_px)):
        counts[y_px[i], x_px[i]] += 1


class EventFilter:
    """Filters one stream of events.

    Args:
        width: sensor columns.
        height: sensor rows.
        config: which filters act.
        hot: mask (height, width) of hot pixels, needed where `config.hot_pixels` is set.

    Attributes:
        seen: events given so far.
        kept: events kept so far.
    """

    def __init__(self, width: int, height: int, config: FilterConfig, hot: NDArray[np.bool_] | None = None) -> None:
        if config.hot_pixels and hot is None:
            raise ValueError("hot: expected a mask of hot pixels, got None")
        self.seen, self.kept = 0, 0
        self._hot = hot if config.hot_pixels and hot is not None else np.zeros((height, width), bool)
        self._background_us = config.background_us or 0
        self._refractory_us = config.refractory_us or 0
        # One pixel of margin on each side saves the kernel the tests for the border.
        self._last_seen_us = np.full((height + 2, width + 2), _NEVER, np.int64)
        self._last_kept_us = np.full((height, width), _NEVER, np.int64)

    def __call__(self, events: Events) -> Events:
        """Return the events that are kept, in order."""
        keep = np.empty(len(events), np.bool_)
        _filter(
            events.t_us,
            events.x_px,
            events.y_px,
            self._hot,
            self._last_seen_us,
            self._last_kept_us,
            self._background_us,
            self._refractory_us,
            keep,
        )
        self.seen += len(events)
        self.kept += int(np.count_nonzero(keep))
        return Events(
            t_us=events.t_us[keep],
            x_px=events.x_px[keep],
            y_px=events.y_px[keep],
            is_positive=events.is_positive[keep],
        )


@numba.njit(cache=True, nogil=True)
def _filter(t_us, x_px, y_px, hot, last_seen_us, last_kept_us, background_us, refractory_us, keep):
    for i in range(len(t_us)):
        t, x, y = t_us[i], np.int64(x_px[i]), np.int64(y_px[i])
        keep[i] = False
        if hot[y, x]:
            continue
        if background_us > 0:
            supported = False
            for dy in range(3):
                for dx in range(3):
                    if (dx != 1 or dy != 1) and last_seen_us[y + dy, x + dx] >= t - background_us:
                        supported = True
            last_seen_us[y + 1, x + 1] = t
            if not supported:
                continue
        if refractory_us > 0 and last_kept_us[y, x] > t - refractory_us:
            continue
        last_kept_us[y, x] = t
        keep[i] = True
