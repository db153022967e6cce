"""A distant panorama on a cylinder about the world's y axis: what a turning camera sees of any scene."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dvsviz.simulate.render import BLOCK, PixelGrid, bilinear
from dvsviz.simulate.scenes import Bounds, blank, fill_polygon, natural_noise
from dvsviz.simulate.texture import Texture, make_texture

Array = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def _render_panorama(
    bearings, block_bearings, columns, R, left, top, texel, data, offsets, shapes, clearance, last, still_px,
    image, active,
):  # fmt: skip
    height, width = image.shape
    top_level = len(offsets) - 1
    seen = np.empty((5, 2))
    for block in range(len(block_bearings)):
        for i in range(5):
            x, y = block_bearings[block, i, 0], block_bearings[block, i, 1]
            px, py = R[0, 0] * x + R[0, 1] * y + R[0, 2], R[1, 0] * x + R[1, 1] * y + R[1, 2]
            pz = R[2, 0] * x + R[2, 1] * y + R[2, 2]
            seen[i, 0] = (np.arctan2(px, pz) - left) / texel - 0.5
            seen[i, 1] = (py / np.sqrt(px * px + pz * pz) - top) / texel - 0.5
        reach = 0.0
        for i in range(1, 5):
            reach = max(reach, np.hypot(seen[i, 0] - seen[0, 0], seen[i, 1] - seen[0, 1]))
        # The farthest corner of a block lies two pixels across and two down from its middle pixel.
        texels = max(reach / np.sqrt(8.0), 1.0)
        if np.hypot(seen[0, 0] - last[block, 0], seen[0, 1] - last[block, 1]) < still_px * texels:
            active[block] = False
            continue
        last[block] = seen[0]
        exact = min(np.log2(texels), float(top_level))
        level = min(int(exact), top_level - 1)
        part = np.float32(exact - level)
        ci = int(min(max(seen[0, 0], 0.0), shapes[0, 1] - 1.0))
        cj = int(min(max(seen[0, 1], 0.0), shapes[0, 0] - 1.0))
        if clearance[cj, ci] > 1.1 * reach + 3.0 * (1 << level) + 1.5 * texels + 1.0:
            active[block] = False
            continue
        active[block] = True
        scale = 1.0 / (1 << level)
        y0, x0 = block // columns * BLOCK, block % columns * BLOCK
        for row in range(y0, min(y0 + BLOCK, height)):
            for column in range(x0, min(x0 + BLOCK, width)):
                x, y = bearings[row, column, 0], bearings[row, column, 1]
                px, py = R[0, 0] * x + R[0, 1] * y + R[0, 2], R[1, 0] * x + R[1, 1] * y + R[1, 2]
                pz = R[2, 0] * x + R[2, 1] * y + R[2, 2]
                u = (np.arctan2(px, pz) - left) / texel * scale
                v = (py / np.sqrt(px * px + pz * pz) - top) / texel * scale
                fine = bilinear(
                    data, offsets[level], shapes[level, 0], shapes[level, 1],
                    np.float32(u - 0.5), np.float32(v - 0.5), False,
                )  # fmt: skip
                coarse = bilinear(
                    data, offsets[level + 1], shapes[level + 1, 0], shapes[level + 1, 1],
                    np.float32(0.5 * u - 0.5), np.float32(0.5 * v - 0.5), False,
                )  # fmt: skip
                image[row, column] = fine + part * (coarse - fine)


class PanoramaView:
    """A turning camera's view of a panorama; used like `PlaneView`, with rotations in place of homographies.

    Args:
        grid: of the camera.
        texture: over azimuth `atan2(x, z)` (rad) and height `y / hypot(x, z)` of world directions.
    """

    def __init__(self, grid: PixelGrid, texture: Texture) -> None:
        self._grid, self._texture = grid, texture
        self.forget()

    def forget(self) -> None:
        """Render all of the next image: the last one was not seen."""
        self._last = np.full((len(self._grid.block_area), 2), np.inf)
        self._fresh = True

    def render(
        self,
        R_world_camera: Array,
        image: NDArray[np.float32],
        active: NDArray[np.bool_],
        *,
        still_px: float = 0.0,
    ) -> None:
        """Write the intensity seen by the blocks that may have changed into `image` (height, width)."""
        texture, grid = self._texture, self._grid
        clearance = np.zeros_like(texture.clearance) if self._fresh else texture.clearance
        self._fresh = False
        _render_panorama(
            grid.bearings, grid.block_bearings, grid.columns, np.ascontiguousarray(R_world_camera), texture.left,
            texture.top, texture.texel, texture.data, texture.offsets, texture.shapes, clearance, self._last,
            still_px, image, active,
        )  # fmt: skip


def boxes(rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
    """Return a room with piled boxes around the camera, as a panorama.

    Args:
        rng: places the boxes.
        bounds: azimuths and heights (left, top, right, bottom).
        texel: rad.
    """
    image = blank(bounds, texel, 0.45)
    image *= np.exp(0.25 * natural_noise(rng, image.shape))
    piled = []
    for _ in range(150):
        azimuth, distance = rng.uniform(bounds[0], bounds[2]), rng.uniform(1.5, 5.0)
        size, turn = rng.uniform(0.15, 0.6, 3), rng.uniform(0, np.pi / 2)
        # The floor is 1.2 m below the camera; piles are up to 2 m high.
        bottom = 1.2 - rng.integers(0, 5) * 0.4
        centre = np.array([distance * np.sin(azimuth), bottom - size[1] / 2, distance * np.cos(azimuth)])
        piled.append((distance, centre, size, turn))
    for _, centre, size, turn in sorted(piled, key=lambda box: -box[0]):
        _paint_box(image, centre, size, turn, bounds, texel, rng)
    image *= np.exp(0.08 * natural_noise(rng, image.shape))
    return make_texture(np.clip(image, 0.05, 1.0), texel=texel, left=bounds[0], top=bounds[1])


def _paint_box(image, centre, size, turn, bounds: Bounds, texel: float, rng: np.random.Generator) -> None:
    """Paint the faces of a box that look at the camera, each in its own grey, with a label on it."""
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = sign * R[:, axis]
            middle = centre + normal * size[axis] / 2
            if normal @ middle >= 0:
                continue
            first, second = (axis + 1) % 3, (axis + 2) % 3
            a, b = R[:, first] * size[first] / 2, R[:, second] * size[second] / 2
            grey = float(np.exp(rng.uniform(np.log(0.12), np.log(0.85))))
            inner = rng.uniform(0.3, 0.7)
            for share, value in ((1.0, grey), (inner, float(np.clip(grey * rng.choice([0.5, 1.8]), 0.06, 1.0)))):
                corners = np.array([-a - b, a - b, a + b, b - a]) * share + middle
                # Straight edges are curves on a cylinder.
                t = np.linspace(0, 1, 16, endpoint=False)[:, None]
                p = np.vstack([corners[i] * (1 - t) + corners[(i + 1) % 4] * t for i in range(4)])
                flat = np.column_stack([np.arctan2(p[:, 0], p[:, 2]), p[:, 1] / np.hypot(p[:, 0], p[:, 2])])
                if np.ptp(flat[:, 0]) < np.pi:
                    fill_polygon(image, flat, value, left=bounds[0], top=bounds[1], texel=texel)
