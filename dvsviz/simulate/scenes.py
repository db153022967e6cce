"""Scenes: pictures painted on a wall, as linear intensity.

Each painter fills a rectangle `(left, top, right, bottom)` of the wall's map coordinates, in metres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from dvsviz.simulate.texture import Texture, make_texture

Array = NDArray[np.float64]
Bounds = tuple[float, float, float, float]
SceneName = Literal["shapes", "poster", "stripes", "checkerboard"]
Painter = Callable[[np.random.Generator, Bounds, float], Texture]

# Paper and ink under room light: over a threshold of 0.25, seven events of a pixel an edge.
PAPER, INK = 0.80, 0.14


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(image, polygon, value, u0, v0, texel):
    """Paint a polygon (texel coordinates by u0, v0, texel) with the share of each texel that it covers."""
    rows, columns = image.shape
    u, v = (polygon[:, 0] - u0) / texel - 0.5, (polygon[:, 1] - v0) / texel - 0.5
    n = len(u)
    near = np.empty(n, np.int64)
    for j in range(max(int(np.floor(v.min())) - 1, 0), min(int(np.ceil(v.max())) + 2, rows)):
        # Only edges that reach this row can cover a part of its texels.
        count = 0
        for k in range(n):
            k2 = k + 1 if k + 1 < n else 0
            if min(v[k], v[k2]) <= j + 1 and max(v[k], v[k2]) >= j - 1:
                near[count] = k
                count += 1
        for i in range(max(int(np.floor(u.min())) - 1, 0), min(int(np.ceil(u.max())) + 2, columns)):
            inside = False
            nearest = 1e30
            for e in range(count):
                k = near[e]
                k2 = k + 1 if k + 1 < n else 0
                ax, ay, bx, by = u[k] - i, v[k] - j, u[k2] - i, v[k2] - j
                if (ay > 0) != (by > 0) and ax - ay * (bx - ax) / (by - ay) > 0:
                    inside = not inside
                ex, ey = bx - ax, by - ay
                s = min(max(-(ax * ex + ay * ey) / max(ex * ex + ey * ey, 1e-18), 0.0), 1.0)
                dx, dy = ax + s * ex, ay + s * ey
                nearest = min(nearest, dx * dx + dy * dy)
            distance = np.sqrt(nearest)
            # Covered share of a texel whose centre is this far inside or outside of a straight edge.
            share = min(max(0.5 + (distance if inside else -distance), 0.0), 1.0)
            if share > 0.0:
                image[j, i] = (1.0 - share) * image[j, i] + share * value


def fill_polygon(
    image: NDArray[np.float32], polygon: ArrayLike, value: float, *, left: float, top: float, texel: float
) -> None:
    """Paint a polygon (N, 2), in metres, into an intensity image in place, with smooth borders."""
    _fill(image, np.ascontiguousarray(polygon, dtype=np.float64), value, left, top, texel)


def blank(bounds: Bounds, texel: float, value: float = PAPER) -> NDArray[np.float32]:
    """Return a wall (rows, columns) of one intensity that covers the bounds."""
    left, top, right, bottom = bounds
    size = (int(np.ceil((bottom - top) / texel)), int(np.ceil((right - left) / texel)))
    return np.full(size, value, dtype=np.float32)


def regular(rng: np.random.Generator, centre: ArrayLike, radius: float, corners: int) -> Array:
    """Return a regular polygon (corners, 2) in a random orientation."""
    a = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(corners) / corners
    return np.asarray(centre) + radius * np.stack([np.cos(a), np.sin(a)], axis=1)


def ellipse(rng: np.random.Generator, centre: ArrayLike, radius: float, ratio: float) -> Array:
    """Return an ellipse as a polygon (64, 2); `ratio` of the axes, in a random orientation."""
    a, turn = 2 * np.pi * np.arange(64) / 64, rng.uniform(0, np.pi)
    p = radius * np.stack([np.cos(a), ratio * np.sin(a)], axis=1)
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray(centre) + p @ np.array([[c, s], [-s, c]])


def star(rng: np.random.Generator, centre: ArrayLike, radius: float, points: int = 5) -> Array:
    """Return a star (2 points, 2) in a random orientation."""
    a = rng.uniform(0, 2 * np.pi) + np.pi * np.arange(2 * points) / points
    r = np.where(np.arange(2 * points) % 2 == 0, radius, 0.45 * radius)
    return np.asarray(centre) + r[:, None] * np.stack([np.cos(a), np.sin(a)], axis=1)


def random_shape(rng: np.random.Generator, centre: ArrayLike, radius: float) -> Array:
    """Return a random polygon (N, 2): triangle to hexagon, bar, ellipse or star."""
    kind = int(rng.integers(0, 8))
    if kind < 4:
        return regular(rng, centre, radius, kind + 3)
    if kind == 4:
        long, thin = radius, radius * rng.uniform(0.3, 0.7)
        a = rng.uniform(0, np.pi)
        c, s = np.cos(a), np.sin(a)
        corners = np.array([[-long, -thin], [long, -thin], [long, thin], [-long, thin]])
        return np.asarray(centre) + corners @ np.array([[c, s], [-s, c]])
    if kind == 5:
        return star(rng, centre, 1.15 * radius)
    return ellipse(rng, centre, radius, rng.uniform(0.5, 1.0))


def shape_layout(
    rng: np.random.Generator, bounds: Bounds, *, spacing: float, radius: tuple[float, float]
) -> list[Array]:
    """Return random shapes on a jittered hexagonal layout: no holes, no overlaps, no repetition."""
    left, top, right, bottom = bounds
    shapes = []
    pitch = spacing * np.sqrt(3) / 2
    for row in range(int(np.floor(top / pitch)), int(np.ceil(bottom / pitch)) + 1):
        for column in range(int(np.floor(left / spacing)), int(np.ceil(right / spacing)) + 1):
            size = rng.uniform(*radius)
            slack = max(spacing / 2 - 1.1 * size, 0.0)
            centre = np.array([(column + 0.5 * (row % 2)) * spacing, row * pitch]) + rng.uniform(-slack, slack, 2)
            shapes.append(random_shape(rng, centre, size))
    return shapes


def paint(shapes: Sequence[Array], bounds: Bounds, texel: float, *, ink: float = INK) -> Texture:
    """Return a white wall with the polygons on it."""
    image = blank(bounds, texel)
    for polygon in shapes:
        fill_polygon(image, polygon, ink, left=bounds[0], top=bounds[1], texel=texel)
    return make_texture(image, texel=texel, left=bounds[0], top=bounds[1])


def shapes(rng: np.random.Generator, bounds: Bounds, texel: float, *, size: float = 1.0) -> Texture:
    """Return black shapes on a white wall, about 9 of them in a square metre; `size` scales all lengths."""
    layout = shape_layout(rng, bounds, spacing=0.36 * size, radius=(0.06 * size, 0.115 * size))
    return paint(layout, bounds, texel)


def poster(rng: np.random.Generator, bounds: Bounds, texel: float, *, contrast: float = 0.9) -> Texture:
    """Return a dense natural texture: leaves of all sizes and greys that cover each other, with 1/f noise on them.

    Args:
        rng: paints it.
        bounds: of the wall, m.
        texel: m.
        contrast: standard deviation of the log intensity.
    """
    left, top, right, bottom = bounds
    log = blank(bounds, texel, 0.0)
    area = (right - left) * (bottom - top)
    for _ in range(int(700 * area)):
        centre = np.array([rng.uniform(left, right), rng.uniform(top, bottom)])
        # Areas fall with the cube of the radius, as those of the things in photographs do.
        radius = 0.016 * rng.uniform(0.006, 1.0) ** -0.5
        polygon = random_shape(rng, centre, radius)
        fill_polygon(log, polygon, rng.normal(0, 1.0), left=left, top=top, texel=texel)
    log += 0.4 * natural_noise(rng, log.shape)
    image = np.exp(np.clip(contrast * (log - log.mean()) / log.std(), -1.6, 1.2) - 1.2).astype(np.float32)
    return make_texture(image, texel=texel, left=left, top=top)


def natural_noise(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return an image (rows, columns) with the falling amplitude spectrum of natural images, variance 1."""
    rows, columns = size
    fy, fx = np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None, :]
    f = np.maximum(np.hypot(fy, fx), 2.0 / max(rows, columns))
    spectrum = np.fft.rfft2(rng.standard_normal((rows, columns))) / f**1.3
    spectrum[0, 0] = 0
    out = np.fft.irfft2(spectrum, s=(rows, columns))
    return (out / out.std()).astype(np.float32)


def stripes(rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
    """Return vertical stripes of random widths: along them nothing can be seen."""
    image = blank(bounds, texel)
    left, top, right, bottom = bounds
    x = left
    while x < right:
        width = rng.uniform(0.015, 0.06)
        bar = [(x, top - 1), (x + width, top - 1), (x + width, bottom + 1), (x, bottom + 1)]
        fill_polygon(image, bar, INK, left=left, top=top, texel=texel)
        x += width + rng.uniform(0.02, 0.1)
    return make_texture(image, texel=texel, left=left, top=top)


def picture(image: NDArray[np.uint8], *, width: float = 2.0) -> Painter:
    """Return a painter of one's own image in the middle of the wall, mirrored beyond its borders.

    Args:
        image: grey values (rows, columns) with the gamma of a display, 2.2: light is their power.
        width: of the image on the wall, m.
    """
    if image.ndim != 2 or min(image.shape) < 2:
        size = f"{image.shape[1]}x{image.shape[0]}" if image.ndim == 2 else str(image.shape)
        raise ValueError(f"image: expected grey values, at least 2x2, got {size}")
    if int(image.min()) == int(image.max()):
        raise ValueError("image: expected something to be seen in it, all is of one grey value")
    # Black paper still reflects a little: the logarithm of the light has to be finite.
    light = np.maximum((image / np.float32(255)) ** np.float32(2.2), np.float32(0.02)).astype(np.float32)

    def paint_it(rng: np.random.Generator, bounds: Bounds, texel: float) -> Texture:
        left, top, right, bottom = bounds
        columns = max(round(width / texel), 2)
        rows = max(round(columns * light.shape[0] / light.shape[1]), 2)
        is_smaller = columns < light.shape[1]
        scaled = cv2.resize(
            light, (columns, rows), interpolation=cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
        )
        across = _mirrored(int(np.ceil((right - left) / texel)), left / texel + columns / 2, columns)
        down = _mirrored(int(np.ceil((bottom - top) / texel)), top / texel + rows / 2, rows)
        shown = np.asarray(scaled[np.ix_(down, across)], dtype=np.float32)
        return make_texture(shown, texel=texel, left=left, top=top)

    return paint_it


def _mirrored(count: int, first: float, size: int) -> NDArray[np.int64]:
    """Return `count` indices into `size` texels from position `first` on, running back and forth beyond them."""
    k = np.floor(first + np.arange(count) + 0.5).astype(np.int64) % (2 * size)
    return np.where(k < size, k, 2 * size - 1 - k)


def checkerboard(rng: np.random.Generator, bounds: Bounds, texel: float, *, square: float = 0.1) -> Texture:
    """Return squares of `square` metres, with their origin shifted at random."""
    image = blank(bounds, texel)
    rows, columns = image.shape
    shift = rng.uniform(0, 2 * square, 2)
    u = bounds[0] + shift[0] + (np.arange(columns * 4) + 0.5) * texel / 4
    v = bounds[1] + shift[1] + (np.arange(rows * 4) + 0.5) * texel / 4
    # The product of two square waves of mean zero, each averaged over a texel.
    wave_u = np.where(np.floor(u / square) % 2 == 0, 1.0, -1.0).reshape(columns, 4).mean(axis=1)
    wave_v = np.where(np.floor(v / square) % 2 == 0, 1.0, -1.0).reshape(rows, 4).mean(axis=1)
    image[:] = (PAPER + INK) / 2 + (PAPER - INK) / 2 * np.outer(wave_v, wave_u)
    return make_texture(image, texel=texel, left=bounds[0], top=bounds[1])


PAINTERS: dict[str, Painter] = {
    "shapes": shapes,
    "poster": poster,
    "stripes": stripes,
    "checkerboard": checkerboard,
}
