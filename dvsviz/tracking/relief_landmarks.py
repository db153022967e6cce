"""Landmarks of the relief map: short pieces of edge in space, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from dvsviz.tracking.relief_kernels import RAY_COLUMNS, SEEN_COLUMNS, see

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """Landmarks (L); `relief_kernels` says what a ray and its two unknowns are.

    Attributes:
        rays: origin, direction, normal and tangent (L, 12), world.
        states: offset and inverse depth (L, 2).
        prior_states: what views before the lag window said of them (L, 2).
        prior_information: how well they did (L, 2, 2).
        information: of all views (L, 2, 2).
        sides: polarity (L,) of its events when it moves along its normal, ±1; 0 where that was not told.
        counts: windows that saw it, and in a row that should have and did not (L, 2).
    """

    rays: Array
    states: Array
    prior_states: Array
    prior_information: Array
    information: Array
    sides: Array
    counts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.rays)

    @classmethod
    def none(cls) -> Landmarks:
        """Return no landmarks."""
        return cls(
            rays=np.zeros((0, RAY_COLUMNS)),
            states=np.zeros((0, 2)),
            prior_states=np.zeros((0, 2)),
            prior_information=np.zeros((0, 2, 2)),
            information=np.zeros((0, 2, 2)),
            sides=np.zeros(0),
            counts=np.zeros((0, 2), dtype=np.int64),
        )

    def take(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> Landmarks:
        """Return some of them, by index or mask."""
        return Landmarks(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def joined(self, other: Landmarks) -> Landmarks:
        """Return these and others after them."""
        return Landmarks(
            **{f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)}
        )

    def seen_from(self, T_world_camera: Array) -> Array:
        """Return how a camera at a pose (4, 4) sees them (L, 5): bearing, normal, inverse depth (0 behind it)."""
        seen = np.empty((len(self), SEEN_COLUMNS))
        R, p = np.ascontiguousarray(T_world_camera[:3, :3]), np.ascontiguousarray(T_world_camera[:3, 3])
        see(self.rays, self.states, R, p, seen)
        return seen

    def pack(self) -> dict[str, np.ndarray]:
        """Return them as named arrays that `unpack` reads."""
        return {f"landmark_{f.name}": getattr(self, f.name) for f in fields(self)}

    @classmethod
    def unpack(cls, state: Mapping[str, np.ndarray]) -> Landmarks:
        """Return packed landmarks."""
        return cls(**{f.name: np.array(state[f"landmark_{f.name}"]) for f in fields(cls)})
