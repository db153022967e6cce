"""A textured surface as the renderer wants it: intensity at several scales, and where nothing changes.

A pixel integrates the light of its footprint. Levels of half resolution each, read with interpolation between
positions and between levels, do this without a step when the distance changes (a step would be seen as events).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# A pixel's footprint is at most 2^(LEVELS - 1) texels; beyond it the texture is read at the coarsest level.
LEVELS = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Texture:
    """Linear intensity over a rectangle of a surface.

    Attributes:
        data: all levels after each other, float32, each row-major.
        offsets: where each level begins in `data`.
        shapes: rows and columns (LEVELS, 2) of each level.
        clearance: texels of level 0 (rows, columns) float32 from a texel to the nearest one that differs from a
            neighbour; all zero where the texture is dense.
        texel: size of a texel of level 0, in the surface's units (m on a plane, rad on a panorama).
        left: surface coordinate u of the left border of the first texel.
        top: surface coordinate v of its upper border.
    """

    data: NDArray[np.float32]
    offsets: NDArray[np.int64]
    shapes: NDArray[np.int64]
    clearance: NDArray[np.float32]
    texel: float
    left: float
    top: float

    @property
    def image(self) -> NDArray[np.float32]:
        """Level 0 (rows, columns)."""
        rows, columns = self.shapes[0]
        return self.data[: rows * columns].reshape(rows, columns)

    @property
    def surface_to_texel(self) -> NDArray[np.float64]:
        """`S` (3, 3): surface coordinates (u, v, 1) to texel coordinates, (0, 0) the centre of the first texel."""
        s = 1.0 / self.texel
        return np.array([[s, 0, -self.left * s - 0.5], [0, s, -self.top * s - 0.5], [0, 0, 1.0]])


def make_texture(image: NDArray[np.float32], *, texel: float, left: float, top: float) -> Texture:
    """Return the texture of a linear intensity image (rows, columns), values in (0, 1].

    Rows and columns are padded to multiples of the coarsest texel by repeating the border.
    """
    step = 1 << (LEVELS - 1)
    rows, columns = image.shape
    padded = np.pad(image, ((0, -rows % step), (0, -columns % step)), mode="edge").astype(np.float32)
    levels = [padded]
    for _ in range(LEVELS - 1):
        a = levels[-1]
        levels.append((a[::2, ::2] + a[1::2, ::2] + a[::2, 1::2] + a[1::2, 1::2]) / np.float32(4))
    sizes = [a.size for a in levels]
    return Texture(
        data=np.concatenate([a.ravel() for a in levels]),
        offsets=np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
        shapes=np.array([a.shape for a in levels], dtype=np.int64),
        clearance=_clearance(padded),
        texel=texel,
        left=left,
        top=top,
    )


def _clearance(image: NDArray[np.float32]) -> NDArray[np.float32]:
    varied = np.zeros(image.shape, dtype=bool)
    across, down = image[:, 1:] != image[:, :-1], image[1:] != image[:-1]
    varied[:, 1:] |= across
    varied[:, :-1] |= across
    varied[1:] |= down
    varied[:-1] |= down
    if varied.mean() > 0.5 or not varied.any():
        # Dense texture has nothing to skip; an empty one is far from everything.
        return np.full(image.shape, 0.0 if varied.any() else 1e6, dtype=np.float32)
    return cv2.distanceTransform((~varied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5).astype(np.float32)
