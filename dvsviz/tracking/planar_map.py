"""The planar map: edge occurrence on the plane, normalised by the image displacement that showed it.

A cell's rate is `votes / (displacement + 1 px)`: an edge that stood still for a second and one that flew past in a
millisecond get the same value. The edge image is `M = 1 - exp(-k rate / p90)`, which saturates, so that strong edges
do not outweigh weak ones (tracking notes, finding 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.plane import Plane
from dvsviz.session.records import MapRevision
from dvsviz.tracking import constants as c
from dvsviz.tracking.map_kernels import add_exposure, edge_block, frozen_vote, occupied_percentile

Array = NDArray[np.float64]
Image = NDArray[np.float32]


# Cells that the widest processors blur at once.
_LANES = 16


@dataclass(slots=True, kw_only=True, eq=False)
class _Level:
    """A blurred edge image.

    Attributes:
        image: (rows, columns).
        dirty: box of cells (first row, first column, end row, end column) that has changed since it was made.
        density: that it was made with.
    """

    image: Image
    dirty: tuple[int, int, int, int] | None
    density: float = 0.0


class PlanarMap:
    """A growing grid of edge occurrence on one plane.

    Attributes:
        plane: in the world frame.
        px_per_unit: cells per unit of the plane's distance.
        origin: (u, v) (2,) of cell (0, 0)'s centre, in units.
        votes: events that fell on each cell (rows, columns).
        exposure: image displacement, px, that has swept each block of cells (rows / b, columns / b).
        freeze_px: a block swept by more is no longer written.
        reach: how far from the map frame's origin, in units, the grid may grow.
        adds: windows that were added.
        density: 90th percentile of the rates of occupied cells, measured now and then.
    """

    def __init__(
        self,
        plane: Plane,
        px_per_unit: float,
        origin: Array,
        shape: tuple[int, int],
        *,
        freeze_px: float,
        reach: float = float("inf"),
    ) -> None:
        b = c.EXPOSURE_CELL_PX
        rows, cols = (-(-n // b) * b for n in shape)
        self.plane = plane
        self.px_per_unit = px_per_unit
        self.freeze_px = freeze_px
        self.reach = reach
        self.origin = np.asarray(origin, dtype=np.float64)
        self.votes: Image = np.zeros((rows, cols), dtype=np.float32)
        self.exposure: Image = np.zeros((rows // b, cols // b), dtype=np.float32)
        # M itself, and blurred.
        self._sharp, self._smooth, *self._levels = (
            _Level(image=np.zeros_like(self.votes), dirty=(0, 0, rows, cols)) for _ in (0, 0, *c.ALIGN_BLURS_PX)
        )
        self.adds = 0
        self.density = 0.0
        self._is_density_due = True

    @property
    def projection(self) -> Array:
        """The affine map (3, 3) from plane coordinates (u, v, 1) to cells (column, row, 1)."""
        s = self.px_per_unit
        return np.array([[s, 0, -s * self.origin[0]], [0, s, -s * self.origin[1]], [0, 0, 1.0]])

    def cover(self, low: Array, high: Array) -> bool:
        """Grow the grid until it holds the box from `low` to `high` (u, v); True where it had to.

        A box that would make the map larger than `MAP_MAX_CELLS` is cut: a wrong pose must not take all memory.
        """
        s, b = self.px_per_unit, c.EXPOSURE_CELL_PX
        rows, cols = self.votes.shape
        left, top = (low - self.origin) * s
        right, bottom = (high - self.origin) * s
        # Where nothing is finite there is nothing to hold.
        if not min(left, top) < 0.0 and not right >= cols - 2 and not bottom >= rows - 2:
            return False
        lo = np.floor((np.clip(low, -self.reach, self.reach) - self.origin) * s)
        hi = np.ceil((np.clip(high, -self.reach, self.reach) - self.origin) * s)
        if not (np.all(np.isfinite(lo)) and np.all(np.isfinite(hi))):
            return False
        if lo.min() >= 0 and hi[0] < cols - 1 and hi[1] < rows - 1:
            return False
        grow = np.maximum([-lo[0], -lo[1], hi[0] - cols + 2, hi[1] - rows + 2], 0.0)
        left, top, right, bottom = (int(-(-(g + c.MAP_MARGIN_PX) // b) * b) if g > 0 else 0 for g in grow)
        if (rows + top + bottom) * (cols + left + right) > c.MAP_MAX_CELLS:
            return False
        margins = ((top, bottom), (left, right))
        self.votes = np.pad(self.votes, margins)
        self.exposure = np.pad(self.exposure, ((top // b, bottom // b), (left // b, right // b)))
        self.origin = self.origin - np.array([left, top]) / s
        for level in (self._sharp, self._smooth, *self._levels):
            # What was never made need not be kept.
            level.image = np.pad(level.image, margins) if level.density > 0 else np.zeros_like(self.votes)
            if level.dirty is not None:
                r0, c0, r1, c1 = level.dirty
                level.dirty = (r0 + top, c0 + left, r1 + top, c1 + left)
        return True

    def take_in(self, other: PlanarMap) -> None:
        """Add what another map of the same plane and resolution holds, which began at the same place.

        What lies beyond the largest map is left out.
        """
        s, b = self.px_per_unit, c.EXPOSURE_CELL_PX
        self.cover(other.origin, other.origin + (np.array(other.votes.shape[::-1]) - 2.5) / s)
        # Both grow by whole blocks.
        left, top = np.round((other.origin - self.origin) * s / b).astype(int).tolist()
        rows, cols = self.exposure.shape
        r0, c0 = max(0, top), max(0, left)
        r1, c1 = min(rows, top + other.exposure.shape[0]), min(cols, left + other.exposure.shape[1])
        if r1 > r0 and c1 > c0:
            own, its = (slice(r0, r1), slice(c0, c1)), (slice(r0 - top, r1 - top), slice(c0 - left, c1 - left))
            self.exposure[own] += other.exposure[its]
            cells = [tuple(slice(b * k.start, b * k.stop) for k in block) for block in (own, its)]
            self.votes[cells[0]] += other.votes[cells[1]]
        self.adds += other.adds
        self._is_density_due = True
        for level in (self._sharp, self._smooth, *self._levels):
            level.dirty = (0, 0, *self.votes.shape)

    def add(
        self,
        points: NDArray[np.float32],
        start: Array,
        end: Array,
        sensor: tuple[int, int],
        K: Array,
        *,
        weight: float = 1.0,
    ) -> None:
        """Add a window's events.

        Args:
            points: plane coordinates (N, 2) of its events.
            start: homography (3, 3) from bearings to plane coordinates at its first event.
            end: the same at its end.
            sensor: (height, width) of the camera, for the footprint.
            K: the camera's calibration (3, 3).
            weight: events that each point stands for.
        """
        self.adds += 1
        self._is_density_due |= self.adds <= c.DENSITY_AFTER or self.adds % c.DENSITY_EVERY == 0
        written = frozen_vote(
            points,
            self.px_per_unit,
            self.origin,
            self.votes,
            self.exposure,
            c.EXPOSURE_CELL_PX,
            self.freeze_px,
            weight,
        )
        projection = self.projection
        box = add_exposure(
            self.exposure,
            projection @ start,
            projection @ end,
            K,
            sensor[0],
            sensor[1],
            c.EXPOSURE_CELL_PX,
            self.freeze_px,
        )
        seen = [int(v) * c.EXPOSURE_CELL_PX for v in box]
        # Events may lie beyond what was in view when the window began.
        low, high = np.minimum(written, seen)[:2], np.maximum(written, seen)[2:]
        r0, c0, r1, c1 = (int(v) for v in (*low, *high))
        for level in (self._sharp, self._smooth, *self._levels) if r1 > r0 else ():
            d = level.dirty or (r0, c0, r1, c1)
            level.dirty = (min(d[0], r0), min(d[1], c0), max(d[2], r1), max(d[3], c1))

    def prepare(self, first: int = 0) -> None:
        """Bring the pyramid from a level on up to date, before threads read it."""
        for number in range(first, len(c.ALIGN_BLURS_PX)):
            self.level(number)
        self.smooth()

    def level(self, number: int) -> Image:
        """Return M blurred by one of `ALIGN_BLURS_PX`, up to date, for reading; what is not asked for is not made.

        A thin line loses its height to the blur: it is brought back, so that each level still reaches about 1.
        """
        sigma = c.ALIGN_BLURS_PX[number]
        return self._blurred(self._levels[number], sigma, min(1.0 + 1.5 * sigma, 4.0))

    def smooth(self) -> Image:
        """Return M blurred for its ridges, up to date: as high as the blur leaves it."""
        return self._blurred(self._smooth, c.LINE_BLUR_PX, 1.0)

    def _blurred(self, level: _Level, sigma: float, gain: float) -> Image:
        if self._is_density_due:
            self.density = occupied_percentile(self.votes, self.exposure, c.EXPOSURE_CELL_PX, 0.9)
            self._is_density_due = False
        box = self._stale(level)
        if box is None or self.density <= 0:
            return level.image
        edge = self._edge()
        rows, cols = edge.shape
        r0, c0, r1, c1 = box
        # OpenCV's Gaussian reaches 4 sigma for float images.
        pad = int(4 * sigma) + 1
        # A halo of one blur around what changed, and one more to blur it from.
        a0, b0, a1, b1 = max(0, r0 - pad), max(0, c0 - pad), min(rows, r1 + pad), min(cols, c1 + pad)
        s0, t0, s1, t1 = max(0, a0 - pad), max(0, b0 - pad), min(rows, a1 + pad), min(cols, b1 + pad)
        # Whole vectors: a cell is rounded alike wherever the block begins, and a restored map is the same to the bit.
        t0, t1 = t0 // _LANES * _LANES, min(cols, -(-t1 // _LANES) * _LANES)
        blurred = cv2.GaussianBlur(edge[s0:s1, t0:t1], (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        blurred *= np.float32(gain)
        cv2.threshold(
            blurred[a0 - s0 : a1 - s0, b0 - t0 : b1 - t0],
            1.0,
            1.0,
            cv2.THRESH_TRUNC,
            dst=level.image[a0:a1, b0:b1],
        )
        return level.image

    def _stale(self, level: _Level) -> tuple[int, int, int, int] | None:
        """Return the box of cells in which an image must be made anew, and take it as made."""
        if level.density == self.density and level.dirty is None:
            return None
        # Another saturation changes every cell: the images depend on the votes alone, not on when they were asked for.
        box = level.dirty if level.density == self.density else None
        level.density, level.dirty = self.density, None
        return box or (0, 0, *self.votes.shape)

    def _edge(self) -> Image:
        """Return M (eq. above), up to date."""
        box = self._stale(self._sharp)
        if box is not None and self.density > 0:
            r0, c0, r1, c1 = box
            k = c.MAP_SATURATION / self.density
            edge_block(self.votes, self.exposure, c.EXPOSURE_CELL_PX, r0, c0, k, self._sharp.image[r0:r1, c0:c1])
        return self._sharp.image

    def settle(self, adds: int | None = None, density: float | None = None) -> None:
        """Measure the density anew when it is next asked for; or take over a stored count of windows and density."""
        self._is_density_due = density is None
        if adds is not None and density is not None:
            self.adds, self.density = adds, density

    def edge_image(self) -> Image:
        """Return M in [0, 1] (rows, columns), not blurred."""
        self.level(-1)
        if self.density <= 0:
            return np.zeros_like(self.votes)
        return self._edge().copy()

    def revision(self, number: int, window: int) -> MapRevision:
        """Return the map as it stands, cut to what was written, as a frozen record."""
        edge = self.edge_image()
        rows, cols = np.flatnonzero(edge.any(axis=1)), np.flatnonzero(edge.any(axis=0))
        r0, r1 = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 1)
        c0, c1 = (int(cols[0]), int(cols[-1]) + 1) if len(cols) else (0, 1)
        return MapRevision(
            revision=number,
            window=window,
            texture=(edge[r0:r1, c0:c1] * 255).astype(np.uint8),
            origin=self.origin + np.array([c0, r0]) / self.px_per_unit,
            px_per_unit=self.px_per_unit,
            normal_world=self.plane.normal,
            distance=self.plane.distance,
        )
