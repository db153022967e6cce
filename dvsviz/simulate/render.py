"""Rendering: the intensity that each pixel receives from a textured plane or a distant panorama.

The sensor is worked through in blocks of 4 x 4 pixels; a block whose whole footprint is of one intensity, now and
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

BLOCK = 4
# A bearing whose plane point is further than a thousand plane distances is past the horizon.
_HORIZON = 1e-3


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


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear(data, offset, rows, columns, u, v, inside):
    """Return the intensity of one level at its texel coordinates (u, v); `inside` promises 0 <= u, v < last."""
    if not inside:
        u = min(max(u, np.float32(0.0)), np.float32(columns - 1.0))
        v = min(max(v, np.float32(0.0)), np.float32(rows - 1.0))
    i, j = np.int32(u), np.int32(v)
    a, b = u - np.float32(i), v - np.float32(j)
    right = 1 if i + 1 < columns else 0
    top = offset + j * columns + i
    bottom = top + (columns if j + 1 < rows else 0)
    upper = data[top] + a * (data[top + right] - data[top])
    lower = data[bottom] + a * (data[bottom + right] - data[bottom])
    return upper + b * (lower - upper)


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear_inside(data, offset, columns, u, v):
    """Return what `bilinear` does, where 0 <= u < columns - 1 and likewise v.

    Unsigned indices are not tested for counting from the end: that and the clamps are half of the work.
    """
    i, j = np.int32(u), np.int32(v)
    a, b = u - np.float32(i), v - np.float32(j)
    top = np.uint64(offset + j * columns + i)
    bottom = top + np.uint64(columns)
    one = np.uint64(1)
    upper = data[top] + a * (data[top + one] - data[top])
    lower = data[bottom] + a * (data[bottom + one] - data[bottom])
    return upper + b * (lower - upper)


@njit(cache=True, nogil=True, error_model="numpy")
def _place_blocks(rays, area, H, det, u, v, texels, reach):
    """Write where each block's middle lies (u, v), its texels a pixel, and how far its corners are from there, texels.

    Each row of `rays` (10, blocks) is one number of all blocks, so that the loops run on vectors of the processor:
    one block after the other, they were three quarters of the time of an image of shapes on a wall.
    """
    h00, h01, h02 = H[0, 0], H[0, 1], H[0, 2]
    h10, h11, h12 = H[1, 0], H[1, 1], H[1, 2]
    h20, h21, h22 = H[2, 0], H[2, 1], H[2, 2]
    for b in range(len(area)):
        x, y = rays[0, b], rays[1, b]
        w = 1.0 / max(h20 * x + h21 * y + h22, _HORIZON)
        u[b], v[b] = (h00 * x + h01 * y + h02) * w, (h10 * x + h11 * y + h12) * w
        # Texels a pixel: the root of the area that it covers, |det| / w³ being the homography's Jacobian.
        texels[b] = max(np.sqrt(det * area[b] * w * w * w), 1.0)
        reach[b] = 0.0
    for i in range(1, 5):
        for b in range(len(area)):
            x, y = rays[2 * i, b], rays[2 * i + 1, b]
            w = 1.0 / max(h20 * x + h21 * y + h22, _HORIZON)
            du, dv = (h00 * x + h01 * y + h02) * w - u[b], (h10 * x + h11 * y + h12) * w - v[b]
            reach[b] = max(reach[b], du * du + dv * dv)
    for b in range(len(area)):
        reach[b] = np.sqrt(reach[b])


@njit(cache=True, nogil=True, error_model="numpy")
def _render_plane(
    bearings_x, bearings_y, us, vs, texels_of, reaches, columns, H, data, offsets, shapes, clearance, skips,
    last, still_px, image, active,
):  # fmt: skip
    """Write the light of the blocks that may have changed; `us` to `reaches` are those of `_place_blocks`.

    `skips` is False where `clearance` is 0 everywhere.
    """
    height, width = image.shape
    h00, h01, h02 = H[0, 0], H[0, 1], H[0, 2]
    h10, h11, h12 = H[1, 0], H[1, 1], H[1, 2]
    h20, h21, h22 = H[2, 0], H[2, 1], H[2, 2]
    top_level = len(offsets) - 1
    u_row, v_row = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    half = np.float32(0.5)
    for block in range(len(us)):
        uc, vc, texels, reach = us[block], vs[block], texels_of[block], reaches[block]
        du, dv = uc - last[block, 0], vc - last[block, 1]
        if du * du + dv * dv < (still_px * texels) ** 2:
            active[block] = False
            continue
        last[block, 0], last[block, 1] = uc, vc
        ci = int(min(max(uc, 0.0), shapes[0, 1] - 1.0))
        cj = int(min(max(vc, 0.0), shapes[0, 0] - 1.0))
        clear = clearance[cj, ci]
        # The filter reaches one and a half texels of the coarser level; what was seen before is less than a pixel away.
        # A level's texel is at most as large as a pixel: most blocks need no logarithm to know that they are clear.
        if clear > 1.1 * reach + 3.0 * texels + 1.5 * texels + 1.0:
            active[block] = False
            continue
        exact = min(np.log2(texels), float(top_level))
        level = min(int(exact), top_level - 1)
        part = np.float32(exact - level)
        support = 3.0 * (1 << level)
        if clear > 1.1 * reach + support + 1.5 * texels + 1.0:
            active[block] = False
            continue
        active[block] = True
        border = reach * 1.1 + support + 1.0
        inside = uc > border and vc > border and uc < shapes[0, 1] - border - 1 and vc < shapes[0, 0] - border - 1
        scale, texel = np.float32(1.0 / (1 << level)), np.float32(1 << level)
        # A pixel has no corners to reach for, but its place is rounded to a texel.
        clear_px = np.float32(support + 1.5 * texels + 2.0)
        shift = np.float32(0.5) * scale - np.float32(0.5)
        shift2 = np.float32(0.25) * scale - np.float32(0.5)
        offset, rows_a, columns_a = offsets[level], shapes[level, 0], shapes[level, 1]
        offset_b, rows_b, columns_b = offsets[level + 1], shapes[level + 1, 0], shapes[level + 1, 1]
        y0, x0 = block // columns * BLOCK, block % columns * BLOCK
        x1 = min(x0 + BLOCK, width)
        for row in range(y0, min(y0 + BLOCK, height)):
            # Places first, light after: the divisions of a row run side by side.
            for c in range(x1 - x0):
                x, y = np.float64(bearings_x[row, x0 + c]), np.float64(bearings_y[row, x0 + c])
                w = 1.0 / max(h20 * x + h21 * y + h22, _HORIZON)
                u_row[c] = np.float32((h00 * x + h01 * y + h02) * w) * scale
                v_row[c] = np.float32((h10 * x + h11 * y + h12) * w) * scale
            if inside:
                for c in range(x1 - x0):
                    u, v = u_row[c], v_row[c]
                    if skips and clearance[np.uint64(v * texel + half), np.uint64(u * texel + half)] > clear_px:
                        # Nothing but one intensity in its reach, as in the block above: it stays as it was.
                        continue
                    fine = bilinear_inside(data, offset, columns_a, u + shift, v + shift)
                    coarse = bilinear_inside(data, offset_b, columns_b, half * u + shift2, half * v + shift2)
                    image[row, x0 + c] = fine + part * (coarse - fine)
                continue
            for c in range(x1 - x0):
                u, v = u_row[c], v_row[c]
                fine = bilinear(data, offset, rows_a, columns_a, u + shift, v + shift, inside)
                coarse = bilinear(data, offset_b, rows_b, columns_b, half * u + shift2, half * v + shift2, inside)
                image[row, x0 + c] = fine + part * (coarse - fine)


class PlaneView:
    """A camera's view of a textured plane, rendered again and again while the camera moves.

    Args:
        grid: of the camera.
        texture: of the plane, in metres of the map frame.
    """

    def __init__(self, grid: PixelGrid, texture: Texture) -> None:
        self._grid, self._texture = grid, texture
        blocks = len(grid.block_area)
        self._bearings = np.ascontiguousarray(np.moveaxis(grid.bearings, -1, 0))
        self._rays = np.ascontiguousarray(grid.block_bearings.reshape(blocks, 10).T)
        self._placed = np.empty((4, blocks))
        self._sparse = bool(texture.clearance.any())
        self.forget()

    def forget(self) -> None:
        """Render all of the next image: the last one was not seen."""
        self._last = np.full((len(self._grid.block_area), 2), np.inf)
        self._fresh = True

    def render(
        self,
        H_map_camera: NDArray[np.float64],
        image: NDArray[np.float32],
        active: NDArray[np.bool_],
        *,
        still_px: float = 0.0,
    ) -> None:
        """Write the intensity seen by every pixel of the blocks that may have changed into `image`.

        Args:
            H_map_camera: bearing (x, y, 1) to plane coordinates (u, v, 1), its scale positive in front of the camera.
            image: (height, width) float32, always the same one; written where a block is active.
            active: (blocks,) set to True where the block was rendered. Between two calls the plane moves by less
                than half a pixel in the image.
            still_px: blocks that moved by less, since they were rendered, wait for a later call; 0 for none.
        """
        texture, grid = self._texture, self._grid
        # Nothing is known of the image before the first call.
        clearance = np.zeros_like(texture.clearance) if self._fresh else texture.clearance
        skips = self._sparse and not self._fresh
        self._fresh = False
        H = texture.surface_to_texel @ H_map_camera
        u, v, texels, reach = self._placed
        _place_blocks(self._rays, grid.block_area, H, abs(_determinant(H)), u, v, texels, reach)
        _render_plane(
            self._bearings[0], self._bearings[1], u, v, texels, reach, grid.columns, H,
            texture.data, texture.offsets, texture.shapes, clearance, skips, self._last, still_px, image, active,
        )  # fmt: skip


def _determinant(H: NDArray[np.float64]) -> float:
    """Return the determinant (3, 3), by its first row."""
    a, b, c = H[1:, 1:], H[1:, 0::2], H[1:, :2]
    minors = [float(m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) for m in (a, b, c)]
    return float(H[0, 0]) * minors[0] - float(H[0, 1]) * minors[1] + float(H[0, 2]) * minors[2]
