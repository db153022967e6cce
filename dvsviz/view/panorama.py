"""The panorama of a camera that only turns, as one picture: all directions, in azimuth and elevation."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.plane import rotation_to_map
from dvsviz.session.records import MapRevision

# A whole turn of a wide sensor with a long lens would be larger than anybody looks at.
_WIDEST_PX = 4096
# Where a face shows things at a slant, its neighbour shows them better: weights fall with this power of the cosine.
_SHARPNESS = 16


def equirectangular(faces: Sequence[MapRevision]) -> NDArray[np.uint8]:
    """Return the faces as one grey picture (rows, columns) uint8, 0 no edge to 255 a sure one.

    The middle is the direction that the first camera looked; azimuth grows to the right (the world's x axis) and
    elevation downwards (y), both with the same number of pixels a radian: that of the faces' centres, or less. The
    picture is cut to what was seen, but as wide as the whole turn where the camera looked backwards too.

    Args:
        faces: map revisions at distance 1 of the world's origin.
    """
    px_per_rad = min(max(f.px_per_unit * f.distance for f in faces), _WIDEST_PX / (2 * np.pi))
    rows, cols = round(np.pi * px_per_rad), round(2 * np.pi * px_per_rad)
    azimuth = ((np.arange(cols) + 0.5) / cols * 2 - 1) * np.pi
    elevation = ((np.arange(rows) + 0.5) / rows - 0.5) * np.pi
    flat, up = np.cos(elevation)[:, None], np.sin(elevation)[:, None]
    look = np.stack([flat * np.sin(azimuth), np.broadcast_to(up, (rows, cols)), flat * np.cos(azimuth)], axis=-1)
    total, weights = np.zeros((rows, cols)), np.zeros((rows, cols))
    for face in faces:
        p = look @ rotation_to_map(face.normal_world).T
        ahead = p[..., 2] > 0.2
        uv = p[..., :2] / np.where(ahead, p[..., 2], 1.0)[..., None] * face.distance
        cells = ((uv - face.origin) * face.px_per_unit).astype(np.float32)
        height, width = face.texture.shape
        inside = ahead & (cells >= 0).all(axis=-1) & (cells[..., 0] <= width - 1) & (cells[..., 1] <= height - 1)
        value = cv2.remap(face.texture, cells[..., 0], cells[..., 1], cv2.INTER_LINEAR)
        # A face says nothing of where it was not written: another one may.
        weight = np.where(inside, p[..., 2] ** _SHARPNESS, 0.0)
        total += weight * value
        weights += weight
    picture = np.round(total / np.maximum(weights, 1e-12)).astype(np.uint8)
    return _cut(picture)


def _cut(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the part of a picture that holds something."""
    rows, cols = np.flatnonzero(picture.any(axis=1)), np.flatnonzero(picture.any(axis=0))
    if len(rows) == 0:
        return picture[:1, :1]
    return np.ascontiguousarray(picture[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1])
