"""Scenes with depth: textured rectangles in space, and what a camera sees of them, light and depth.

A box is its faces, a floor one large rectangle. Each rectangle is seen through a homography `u ~ H b` whose third row
gives the inverse depth of the bearing `b`; the nearest one wins. Pixels whose corners see different rectangles are
an average over 4 x 4 rays, so that an edge that hides another surface moves smoothly, as light does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.simulate.relief_kernels import depths
from dvsviz.simulate.relief_kernels import render as render_relief
from dvsviz.simulate.render import BLOCK, PixelGrid
from dvsviz.simulate.texture import Texture

Array = NDArray[np.float64]
# Nearer surfaces are not seen, m.
_NEAR = 0.02
# Blocks along the side of a tile: what is not in view of a tile is not looked for in its blocks.
_TILE = 4
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
        self._block_bounds = block_bounds(grid)
        self._tile_blocks, self._tile_bounds = tiles_of(grid, self._block_bounds)
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
        render_relief(
            grid.bearings, grid.block_bearings, grid.block_area, self._block_bounds, self._tile_bounds,
            self._tile_blocks, grid.columns, Hs, self._limits, boxes, seen, self._texel, areas, self._data,
            self._offsets, self._shapes, self._last, self._last_hit, still_px, BACKGROUND, image, active,
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
        depths(np.ascontiguousarray(b).reshape(-1, 2), Hs, self._limits, seen, out)
        return out.reshape(b.shape[:-1])


def block_bounds(grid: PixelGrid) -> Array:
    """Return the bearings (blocks, 4), (x0, y0, x1, y1), between which each block's pixels lie, corners included."""
    # Corners of a block are pixel centres: its pixels reach one pixel further.
    margin = 1.5 * np.sqrt(grid.block_area)[:, None]
    return np.hstack([grid.block_bearings.min(axis=1) - margin, grid.block_bearings.max(axis=1) + margin])


def tiles_of(grid: PixelGrid, bounds: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the blocks (tiles, n) of each tile, -1 for none, and the tiles' bounds (tiles, 4)."""
    row, column = np.divmod(np.arange(len(bounds)), grid.columns)
    tile = row // _TILE * -(-grid.columns // _TILE) + column // _TILE
    blocks = np.full((tile[-1] + 1, _TILE * _TILE), -1, np.int64)
    blocks[tile, row % _TILE * _TILE + column % _TILE] = np.arange(len(bounds))
    known = (blocks >= 0)[..., None]
    low = np.where(known, bounds[blocks, :2], np.inf).min(axis=1)
    return blocks, np.hstack([low, np.where(known, bounds[blocks, 2:], -np.inf).max(axis=1)])


def image_of(view: ReliefView, T_world_camera: Array, camera: Camera) -> NDArray[np.float32]:
    """Return the whole image (height, width) of a view, intensity."""
    image = np.empty((camera.height, camera.width), np.float32)
    view.forget()
    view.render(T_world_camera, image, np.ones(-(-camera.height // BLOCK) * -(-camera.width // BLOCK), np.bool_))
    return image
