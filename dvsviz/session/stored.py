"""What a session gives back lightly: images are read from the file when they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Bookmark:
    """A window that a person marked.

    Attributes:
        bookmark: its number, by which it is deleted.
        window: the window.
        text: what the person wrote.
    """

    bookmark: int
    window: int
    text: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredKeyframe:
    """A keyframe whose image is read when it is asked for; otherwise as `records.Keyframe`."""

    keyframe: int
    window: int
    t_us: int
    T_world_camera: NDArray[np.float64]
    load: Callable[[], NDArray[np.uint8]]

    @property
    def image(self) -> NDArray[np.uint8]:
        """The window's warped events (height, width) uint8, read from the file."""
        return self.load()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredMapRevision:
    """A map revision whose texture is read when it is asked for; otherwise as `records.MapRevision`.

    Attributes:
        rows: rows of the texture.
        columns: columns of the texture.
        place: where its bytes lie; revisions with one place have the same texture.
    """

    revision: int
    window: int
    rows: int
    columns: int
    origin: NDArray[np.float64]
    px_per_unit: float
    normal_world: NDArray[np.float64]
    distance: float
    place: tuple[int, int]
    load: Callable[[], NDArray[np.uint8]]

    @property
    def texture(self) -> NDArray[np.uint8]:
        """Edge occurrence (rows, columns) uint8, read from the file."""
        return self.load()
