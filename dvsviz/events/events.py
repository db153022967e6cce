"""Events: four columns, sorted by time, validated once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Events:
    """A run of events in time order.

    Attributes:
        t_us: times (N,), int64 microseconds, never decreasing.
        x_px: columns (N,), uint16. Cast before any arithmetic.
        y_px: rows (N,), uint16.
        is_positive: polarity (N,), bool.
    """

    t_us: NDArray[np.int64]
    x_px: NDArray[np.uint16]
    y_px: NDArray[np.uint16]
    is_positive: NDArray[np.bool_]

    def __post_init__(self) -> None:
        n = len(self.t_us)
        for name, kind in (
            ("t_us", np.int64),
            ("x_px", np.uint16),
            ("y_px", np.uint16),
            ("is_positive", np.bool_),
        ):
            column = getattr(self, name)
            if column.shape != (n,) or column.dtype != kind:
                raise ValueError(f"{name}: expected ({n},) {np.dtype(kind)}, got {column.shape} {column.dtype}")

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, key: slice) -> Events:
        """Return a view of a slice of the events."""
        return Events(
            t_us=self.t_us[key], x_px=self.x_px[key], y_px=self.y_px[key], is_positive=self.is_positive[key]
        )

    @classmethod
    def empty(cls) -> Events:
        """Return no events."""
        return cls(
            t_us=np.zeros(0, np.int64),
            x_px=np.zeros(0, np.uint16),
            y_px=np.zeros(0, np.uint16),
            is_positive=np.zeros(0, np.bool_),
        )


def joined(parts: Sequence[Events]) -> Events:
    """Return events that follow each other as one."""
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return Events.empty()
    return Events(
        t_us=np.concatenate([part.t_us for part in parts]),
        x_px=np.concatenate([part.x_px for part in parts]),
        y_px=np.concatenate([part.y_px for part in parts]),
        is_positive=np.concatenate([part.is_positive for part in parts]),
    )
