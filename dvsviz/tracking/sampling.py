"""What of a window or a view is looked at: events evenly thinned, rays of a coarse grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.camera import Camera
from dvsviz.tracking import constants as c

_VIEW_COLUMNS = 18


def thinned(count: int, most: int = c.ALIGN_EVENTS) -> NDArray[np.int64]:
    """Return which (M,) of `count` events are aligned: at most so many, evenly spread."""
    most = min(count, most)
    return (np.arange(most) * (count / max(1, most))).astype(np.int64)


def view_rays(camera: Camera) -> NDArray[np.float32]:
    """Return the rays (3, G) float32, camera frame, of a coarse grid over a camera's image."""
    rows = max(2, round(_VIEW_COLUMNS * camera.height / camera.width))
    x, y = np.meshgrid(
        (np.arange(_VIEW_COLUMNS) + 0.5) * camera.width / _VIEW_COLUMNS - 0.5,
        (np.arange(rows) + 0.5) * camera.height / rows - 0.5,
    )
    x, y = (x.ravel() - camera.cx) / camera.fx, (y.ravel() - camera.cy) / camera.fy
    return np.stack([x, y, np.ones(len(x))]).astype(np.float32)
