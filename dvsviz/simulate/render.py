"""Rendering: the intensity that each pixel receives from a textured plane or a distant panorama.

The sensor is worked through in blocks of 8 x 8 pixels; a block whose whole footprint is of one intensity, now and
one step before, is left alone. On a wall with shapes this skips three quarters of the work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dvsviz.geometry.camera import Camera
from dvsviz.simulate.texture import Texture

BLOCK = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PixelGrid:
    """The sensor's bearings by block.

    Attributes:
        bearings: (height, width, 2) float32, undistorted, of the pixel centres.
        block_bearings: (blocks, 5, 2) of each block's centre and corners.
        block_area: (blocks,) bearing area of one pixel.
        rows: number of block rows.
        columns: number of block columns.
    """

    bearings: NDArray[np.float32]
    block_bearings: NDArray[np.float64]
    block_area: NDArray[np.float64]
    rows: int
    columns: int

    @classmethod
    def of(cls, camera: Camera) -> Self:
        """Return the grid of a camera."""
        table = camera.bearing_table()
        rows, columns = -(-camera.height // BLOCK), -(-camera.width // BLOCK)
        block_bearings = np.zeros((rows * columns, 5, 2))
        block_area = np.zeros(rows * columns)
        for row in range(rows):
            for column in range(columns):
                y0, x0 = row * BLOCK, column * BLOCK
                y1, x1 = min(y0 + BLOCK, camera.height) - 1, min(x0 + BLOCK, camera.width) - 1
                yc, xc = (y0 + y1) // 2, (x0 + x1) // 2
                b = row * columns + column
                for i, (y, x) in enumerate(((yc, xc), (y0, x0), (y0, x1), (y1, x0), (y1, x1))):
                    block_bearings[b, i] = table[y, x]
                # A border block may be a single pixel wide: take the differences across the centre from the sensor.
                ya, yb = max(yc - 1, 0), min(yc + 1, camera.height - 1)
                xa, xb = max(xc - 1, 0), min(xc + 1, camera.width - 1)
                dx = (table[yc, xb].astype(float) - table[yc, xa]) / max(xb - xa, 1)
                dy = (table[yb, xc].astype(float) - table[ya, xc]) / max(yb - ya, 1)
                area = abs(dx[0] * dy[1] - dx[1] * dy[0])
                block_area[b] = area if area > 0 else 1.0 / (camera.fx * camera.fy)
        return cls(bearings=table, block_bearings=block_bearings, block_area=block_area, rows=rows, columns=columns)


@njit(cache=True, nogil=True, inline="always")
def _bilinear(data, offset, rows, columns, u, v):
    u = min(max(u, 0.0), columns - 1.0)
    v = min(max(v, 0.0), rows - 1.0)
    i, j = int(u), int(v)
    i2, j2 = min(i + 1, columns - 1), min(j + 1, rows - 1)
    a, b = u - i, v - j
    top = offset + j * columns
    bottom = offset + j2 * columns
    return (1 - b) * ((1 - a) * data[top + i] + a * data[top + i2]) + b * (
        (1 - a) * data[bottom + i] + a * data[bottom + i2]
    )


@njit(cache=True, nogil=True, inline="always")
def _sample(data, offsets, shapes, level, part, u, v):
    """Intensity at texel coordinates (u, v) of level 0, between `level` and the next by `part`."""
    scale = 1.0 / (1 << level)
    value = _bilinear(
        data,
        offsets[level],
        shapes[level, 0],
        shapes[level, 1],
        (u + 0.5) * scale - 0.5,
        (v + 0.5) * scale - 0.5,
    )
    if part > 0.0:
        scale *= 0.5
        coarse = _bilinear(
            data,
            offsets[level + 1],
            shapes[level + 1, 0],
            shapes[level + 1, 1],
            (u + 0.5) * scale - 0.5,
            (v + 0.5) * scale - 0.5,
        )
        value = (1.0 - part) * value + part * coarse
    return value


@njit(cache=True, nogil=True)
def _render_plane(
    bearings, block_bearings, block_area, columns, H, data, offsets, shapes, clearance, image, active
):
    height, width = image.shape
    det = abs(
        H[0, 0] * (H[1, 1] * H[2, 2] - H[1, 2] * H[2, 1])
        - H[0, 1] * (H[1, 0] * H[2, 2] - H[1, 2] * H[2, 0])
        + H[0, 2] * (H[1, 0] * H[2, 1] - H[1, 1] * H[2, 0])
    )
    top_level = len(offsets) - 1
    for block in range(len(block_area)):
        x, y = block_bearings[block, 0]
        w = max(H[2, 0] * x + H[2, 1] * y + H[2, 2], 1e-3)
        uc = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w
        vc = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
        # Texels a pixel: the root of the area that it covers, |det| / w³ being the homography's Jacobian.
        texels = np.sqrt(det * block_area[block] / (w * w * w))
        ci = int(min(max(uc, 0.0), shapes[0, 1] - 1.0))
        cj = int(min(max(vc, 0.0), shapes[0, 0] - 1.0))
        clear = clearance[cj, ci]
        if clear > 8.0 * texels:
            reach = 0.0
            for i in range(1, 5):
                x, y = block_bearings[block, i]
                w = max(H[2, 0] * x + H[2, 1] * y + H[2, 2], 1e-3)
                u = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w - uc
                v = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w - vc
                reach = max(reach, u * u + v * v)
            # The filter reaches two texels of the coarser level (4 pixels), a step of motion one more; half as
            # much again for the difference of scale within a tilted block.
            if clear > 1.5 * np.sqrt(reach) + 6.0 * max(texels, 1.0):
                active[block] = False
                continue
        active[block] = True
        exact = min(max(np.log2(max(texels, 1.0)), 0.0), float(top_level))
        level = int(exact)
        part = exact - level
        if level == top_level:
            part = 0.0
        y0, x0 = block // columns * 8, block % columns * 8
        for row in range(y0, min(y0 + 8, height)):
            for column in range(x0, min(x0 + 8, width)):
                x, y = bearings[row, column, 0], bearings[row, column, 1]
                w = max(H[2, 0] * x + H[2, 1] * y + H[2, 2], 1e-3)
                u = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w
                v = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
                image[row, column] = _sample(data, offsets, shapes, level, part, u, v)


def render_plane(
    grid: PixelGrid,
    texture: Texture,
    H_map_camera: NDArray[np.float64],
    image: NDArray[np.float32],
    active: NDArray[np.bool_],
) -> None:
    """Write the intensity seen by every pixel of the blocks that may have changed into `image`.

    Args:
        grid: of the camera.
        texture: of the plane, in metres of the map frame.
        H_map_camera: bearing (x, y, 1) to plane coordinates (u, v, 1), with positive scale in front of the camera.
        image: (height, width) float32, written where a block is active; the whole of it must be valid before.
        active: (blocks,) set to True where the block was rendered. The plane must not have moved by more than a
            pixel in the image since the last call with this image.
    """
    _render_plane(
        grid.bearings,
        grid.block_bearings,
        grid.block_area,
        grid.columns,
        texture.surface_to_texel @ H_map_camera,
        texture.data,
        texture.offsets,
        texture.shapes,
        texture.clearance,
        image,
        active,
    )
