"""Scenes with depth: textured rectangles in space, and what a camera sees of them, light and depth.

A box is its faces, a floor one large rectangle. Each rectangle is seen through a homography `u ~ H b` whose third row
gives the inverse depth of the bearing `b`; the nearest one wins. Pixels whose corners see different rectangles are
averaged over 4 x 4 rays, so that an edge that hides another surface moves smoothly, as light does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.simulate.render import BLOCK, PixelGrid, bilinear
from dvsviz.simulate.texture import Texture

Array = NDArray[np.float64]
# Nearer surfaces are not seen, m.
_NEAR = 0.02
# Intensity where there is no surface.
BACKGROUND = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """A textured rectangle, seen from the side that its normal `right × down` points away from.

    Attributes:
        T_world_patch: pose (4, 4) of its corner: x along the texture's columns, y along its rows, z away from who
            looks at it (as optical axes that look at it squarely).
        width: m along x.
        height: m along y.
        texture: with its upper left border at (0, 0), covering width and height.
    """

    T_world_patch: Array
    width: float
    height: float
    texture: Texture


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Relief:
    """A scene with depth.

    Attributes:
        patches: its surfaces.
        T_world_hand: pose (4, 4) where a hand-held camera begins: motions are seen from there.
        gravity_world: acceleration of a falling body (3,), m/s².
        has_floor: True where the world is that of flights: z up, the floor at z = 0.
    """

    patches: tuple[Patch, ...]
    T_world_hand: Array
    gravity_world: Array
    has_floor: bool


@njit(cache=True, nogil=True, error_model="numpy")
def _hit(Hs, limits, chosen, count, x, y):
    """Return the nearest of the chosen patches along a bearing, or -1, and its inverse depth."""
    best, nearest = -1, 1e-6
    for i in range(count):
        k = chosen[i]
        H = Hs[k]
        w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        if w <= nearest:
            continue
        u, v = H[0, 0] * x + H[0, 1] * y + H[0, 2], H[1, 0] * x + H[1, 1] * y + H[1, 2]
        if u >= 0.0 and v >= 0.0 and u < limits[k, 0] * w and v < limits[k, 1] * w:
            best, nearest = k, w
    return best, nearest


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(Hs, texel, areas, pixel_area, data, offsets, shapes, k, w, x, y):
    """Return the light from patch k along a bearing whose inverse depth is w."""
    H = Hs[k]
    u, v = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w, (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
    texels = max(np.sqrt(areas[k] * pixel_area / (w * w * w)) / texel[k], 1.0)
    top = offsets.shape[1] - 1
    exact = min(np.log2(texels), float(top))
    level = min(int(exact), top - 1)
    scale = 1.0 / (texel[k] * (1 << level))
    fine = bilinear(
        data, offsets[k, level], shapes[k, level, 0], shapes[k, level, 1],
        np.float32(u * scale - 0.5), np.float32(v * scale - 0.5), False,
    )  # fmt: skip
    coarse = bilinear(
        data, offsets[k, level + 1], shapes[k, level + 1, 0], shapes[k, level + 1, 1],
        np.float32(0.5 * u * scale - 0.5), np.float32(0.5 * v * scale - 0.5), False,
    )  # fmt: skip
    return fine + np.float32(exact - level) * (coarse - fine)


@njit(cache=True, nogil=True, error_model="numpy")
def _corners(bearings, row, column, out):
    """Write the bearings of the four corners of a pixel, half way to its diagonal neighbours or as far outside."""
    height, width = bearings.shape[0], bearings.shape[1]
    row2 = row + 1 if row + 1 < height else row - 1
    column2 = column + 1 if column + 1 < width else column - 1
    down_sign, right_sign = (1.0 if row2 > row else -1.0), (1.0 if column2 > column else -1.0)
    for axis in range(2):
        here = float(bearings[row, column, axis])
        down = down_sign * (float(bearings[row2, column, axis]) - here)
        right = right_sign * (float(bearings[row, column2, axis]) - here)
        out[0, axis], out[1, axis], out[2, axis] = here, right, down


@njit(cache=True, nogil=True, error_model="numpy")
def _render(
    bearings, block_bearings, block_area, columns, Hs, limits, boxes, seen, texel, areas, data, offsets, shapes,
    last, last_hit, still_px, background, image, active,
):  # fmt: skip
    height, width = image.shape
    chosen = np.empty(len(Hs), np.int64)
    near = np.empty(5, np.int64)
    pixel = np.empty((3, 2))
    for block in range(len(block_area)):
        x0, y0, x1, y1 = 1e9, 1e9, -1e9, -1e9
        for i in range(5):
            x, y = block_bearings[block, i, 0], block_bearings[block, i, 1]
            x0, y0, x1, y1 = min(x0, x), min(y0, y), max(x1, x), max(y1, y)
        # Corners of a block are pixel centres: its pixels reach one pixel further, corners included.
        margin = 1.5 * np.sqrt(block_area[block])
        count = 0
        for k in range(len(Hs)):
            across = boxes[k, 0] < x1 + margin and boxes[k, 2] > x0 - margin
            if seen[k] and across and boxes[k, 1] < y1 + margin and boxes[k, 3] > y0 - margin:
                chosen[count] = k
                count += 1
        moved, same = False, True
        for i in range(5):
            x, y = block_bearings[block, i, 0], block_bearings[block, i, 1]
            k, w = _hit(Hs, limits, chosen, count, x, y)
            near[i] = k
            same = same and k == near[0]
            if k != last_hit[block, i]:
                moved = True
            elif k >= 0:
                u = (Hs[k, 0, 0] * x + Hs[k, 0, 1] * y + Hs[k, 0, 2]) / w
                v = (Hs[k, 1, 0] * x + Hs[k, 1, 1] * y + Hs[k, 1, 2]) / w
                du, dv = u - last[block, i, 0], v - last[block, i, 1]
                pixel2 = areas[k] * block_area[block] / (w * w * w)
                moved = moved or du * du + dv * dv >= still_px * still_px * pixel2
        if same and not moved:
            active[block] = False
            continue
        active[block] = True
        for i in range(5):
            x, y = block_bearings[block, i, 0], block_bearings[block, i, 1]
            k, w = _hit(Hs, limits, chosen, count, x, y)
            last_hit[block, i] = k
            if k >= 0:
                last[block, i, 0] = (Hs[k, 0, 0] * x + Hs[k, 0, 1] * y + Hs[k, 0, 2]) / w
                last[block, i, 1] = (Hs[k, 1, 0] * x + Hs[k, 1, 1] * y + Hs[k, 1, 2]) / w
        area = block_area[block]
        row0, column0 = block // columns * BLOCK, block % columns * BLOCK
        for row in range(row0, min(row0 + BLOCK, height)):
            for column in range(column0, min(column0 + BLOCK, width)):
                _corners(bearings, row, column, pixel)
                x, y = pixel[0, 0], pixel[0, 1]
                k, w = _hit(Hs, limits, chosen, count, x, y)
                pure = True
                if count > 1 or k < 0:
                    for i in range(4):
                        a, b = (0.5 if i & 1 else -0.5), (0.5 if i & 2 else -0.5)
                        corner, _ = _hit(
                            Hs, limits, chosen, count,
                            x + a * pixel[1, 0] + b * pixel[2, 0], y + a * pixel[1, 1] + b * pixel[2, 1],
                        )  # fmt: skip
                        pure = pure and corner == k
                if pure:
                    if k < 0:
                        image[row, column] = background
                    else:
                        image[row, column] = _shade(Hs, texel, areas, area, data, offsets, shapes, k, w, x, y)
                    continue
                total = 0.0
                for i in range(16):
                    a, b = (i % 4 - 1.5) / 4, (i // 4 - 1.5) / 4
                    xs, ys = x + a * pixel[1, 0] + b * pixel[2, 0], y + a * pixel[1, 1] + b * pixel[2, 1]
                    k, w = _hit(Hs, limits, chosen, count, xs, ys)
                    if k < 0:
                        total += background
                    else:
                        total += _shade(Hs, texel, areas, area / 16, data, offsets, shapes, k, w, xs, ys)
                image[row, column] = total / 16


@njit(cache=True, nogil=True, error_model="numpy")
def _depths(bearings, Hs, limits, seen, out):
    chosen, count = np.empty(len(Hs), np.int64), 0
    for k in range(len(Hs)):
        if seen[k]:
            chosen[count] = k
            count += 1
    for i in range(len(bearings)):
        k, w = _hit(Hs, limits, chosen, count, float(bearings[i, 0]), float(bearings[i, 1]))
        out[i] = 1.0 / w if k >= 0 else np.nan


class ReliefView:
    """A camera's view of a relief; used like `PlaneView`, with poses in place of homographies.

    Args:
        grid: of the camera.
        scene: what is looked at.
    """

    def __init__(self, grid: PixelGrid, scene: Relief) -> None:
        if not scene.patches:
            raise ValueError("scene: expected at least one surface")
        self._grid = grid
        patches, textures = scene.patches, [p.texture for p in scene.patches]
        self._Ts_patch_world = se3.inverse(np.stack([p.T_world_patch for p in patches]))
        self._limits = np.array([[p.width, p.height] for p in patches])
        starts = np.cumsum([0] + [len(t.data) for t in textures[:-1]])
        self._data = np.concatenate([t.data for t in textures])
        self._offsets = np.stack([t.offsets + s for t, s in zip(textures, starts, strict=True)])
        self._shapes = np.stack([t.shapes for t in textures])
        self._texel = np.array([t.texel for t in textures])
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        local = np.concatenate([self._limits[:, None] * corners, np.zeros((len(patches), 4, 1))], axis=-1)
        Ts = np.stack([p.T_world_patch for p in patches])
        self._corners_world = np.einsum("nij,nkj->nki", Ts[:, :3, :3], local) + Ts[:, None, :3, 3]
        self.forget()

    def forget(self) -> None:
        """Render all of the next image: the last one was not seen."""
        blocks = len(self._grid.block_area)
        self._last = np.full((blocks, 5, 2), np.inf)
        self._last_hit = np.full((blocks, 5), -2, np.int64)

    def _seen_from(self, T_world_camera: Array) -> tuple[Array, Array, NDArray[np.bool_], Array]:
        """Return homographies (N, 3, 3), bounds in bearings (N, 4), which face the camera, and Jacobians (N,)."""
        Ts = self._Ts_patch_world @ T_world_camera
        R, t = Ts[:, :3, :3], Ts[:, :3, 3]
        # The patch is z = 0 of its frame: t_z + s r_z · b = 0 at depth s, so 1 / s = -r_z · b / t_z.
        seen = t[:, 2] < -1e-6
        away = np.where(seen, t[:, 2], -1.0)
        w = -R[:, 2] / away[:, None]
        Hs = R + 0.0
        Hs[:, 0] += t[:, :1] * w
        Hs[:, 1] += t[:, 1:2] * w
        Hs[:, 2] = w
        R_cw, t_wc = T_world_camera[:3, :3].T, T_world_camera[:3, 3]
        p = (self._corners_world - t_wc) @ R_cw.T
        z = p[..., 2]
        whole = np.all(z > _NEAR, axis=1)
        b = p[..., :2] / np.where(z > _NEAR, z, 1.0)[..., None]
        boxes = np.concatenate([b.min(axis=1), b.max(axis=1)], axis=1)
        # A patch that reaches behind the camera may be anywhere in the image.
        boxes[~whole] = [-1e9, -1e9, 1e9, 1e9]
        seen &= np.any(z > _NEAR, axis=1)
        return Hs, boxes, seen, np.abs(np.linalg.det(Hs))

    def render(
        self,
        T_world_camera: Array,
        image: NDArray[np.float32],
        active: NDArray[np.bool_],
        *,
        still_px: float = 0.0,
    ) -> None:
        """Write the intensity seen by the blocks that may have changed into `image` (height, width)."""
        Hs, boxes, seen, areas = self._seen_from(T_world_camera)
        grid = self._grid
        _render(
            grid.bearings, grid.block_bearings, grid.block_area, grid.columns, Hs, self._limits, boxes, seen,
            self._texel, areas, self._data, self._offsets, self._shapes, self._last, self._last_hit, still_px,
            BACKGROUND, image, active,
        )  # fmt: skip

    def depth(self, T_world_camera: Array, bearings: NDArray | None = None) -> Array:
        """Return depths along the optical axis, m, NaN where there is no surface.

        Args:
            T_world_camera: pose (4, 4).
            bearings: (..., 2); those of the pixels (height, width) where None.
        """
        b = self._grid.bearings if bearings is None else np.asarray(bearings)
        Hs, _, seen, _ = self._seen_from(T_world_camera)
        out = np.empty(b.size // 2)
        _depths(np.ascontiguousarray(b).reshape(-1, 2), Hs, self._limits, seen, out)
        return out.reshape(b.shape[:-1])


def image_of(view: ReliefView, T_world_camera: Array, camera: Camera) -> NDArray[np.float32]:
    """Return the whole image (height, width) of a view, intensity."""
    image = np.empty((camera.height, camera.width), np.float32)
    view.forget()
    view.render(T_world_camera, image, np.ones(-(-camera.height // BLOCK) * -(-camera.width // BLOCK), np.bool_))
    return image
