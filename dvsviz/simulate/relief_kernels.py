"""The ray caster of scenes with depth, compiled: which rectangle a bearing meets first, and its light."""

from __future__ import annotations

import numpy as np
from numba import njit

from dvsviz.simulate.render import BLOCK, bilinear


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
def _sole(Hs, limits, chosen, count, x0, y0, x1, y1):
    """Return the patch that alone is seen in a rectangle of bearings, or -1 where it is not plain that there is one.

    Inverse depth and the borders of a patch are affine in the bearing: what holds at four corners holds between them.
    """
    nearest = np.full(4, 0.0)
    sole = -1
    for i in range(count):
        k = chosen[i]
        H = Hs[k]
        missed, covers, before, behind, ahead = 0b1111, True, True, True, False
        for c in range(4):
            x, y = (x1 if c & 1 else x0), (y1 if c & 2 else y0)
            w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            u, v = H[0, 0] * x + H[0, 1] * y + H[0, 2], H[1, 0] * x + H[1, 1] * y + H[1, 2]
            outside = (u < 0.0) | (v < 0.0) << 1 | (u >= limits[k, 0] * w) << 2 | (v >= limits[k, 1] * w) << 3
            missed &= outside
            ahead = ahead or w > 1e-6
            covers = covers and w > 1e-6 and outside == 0
            before, behind = before and w > nearest[c], behind and w <= nearest[c]
        if missed or not ahead or (behind and sole >= 0):
            continue
        if not covers or not before:
            # It may hide what was found, or be hidden by what comes: the pixels have to tell.
            return -1
        sole = k
        for c in range(4):
            x, y = (x1 if c & 1 else x0), (y1 if c & 2 else y0)
            nearest[c] = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    return sole


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_block(bearings, H, texel, texels, data, offsets, shapes, row0, column0, image):
    """Write the light of one patch into a block; `texels` is how many of its texels a pixel covers."""
    height, width = image.shape
    top = len(offsets) - 1
    exact = min(np.log2(max(texels, 1.0)), float(top))
    level = min(int(exact), top - 1)
    part = np.float32(exact - level)
    scale = 1.0 / (texel * (1 << level))
    half = np.float32(0.5)
    for row in range(row0, min(row0 + BLOCK, height)):
        for column in range(column0, min(column0 + BLOCK, width)):
            x, y = bearings[row, column, 0], bearings[row, column, 1]
            w = scale / (H[2, 0] * x + H[2, 1] * y + H[2, 2])
            u = np.float32((H[0, 0] * x + H[0, 1] * y + H[0, 2]) * w)
            v = np.float32((H[1, 0] * x + H[1, 1] * y + H[1, 2]) * w)
            fine = bilinear(data, offsets[level], shapes[level, 0], shapes[level, 1], u - half, v - half, False)
            coarse = bilinear(
                data, offsets[level + 1], shapes[level + 1, 0], shapes[level + 1, 1],
                half * u - half, half * v - half, False,
            )  # fmt: skip
            image[row, column] = fine + part * (coarse - fine)


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
def render(
    bearings, block_bearings, block_area, columns, Hs, limits, boxes, seen, texel, areas, data, offsets, shapes,
    last, last_hit, still_px, background, image, active,
):  # fmt: skip
    """Write the light of the blocks that may have changed into `image`; see `ReliefView.render`.

    `Hs` (N, 3, 3) take bearings to (u, v, 1) times inverse depth in the N patches, `limits` (N, 2) are their sizes,
    `boxes` (N, 4) their bounds in bearings, `areas` (N,) the determinants; `last` and `last_hit` are kept a block.
    """
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
        sole = _sole(Hs, limits, chosen, count, x0 - margin, y0 - margin, x1 + margin, y1 + margin)
        if sole >= 0:
            chosen[0], count = sole, 1
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
        if sole >= 0:
            x, y = block_bearings[block, 0, 0], block_bearings[block, 0, 1]
            w = Hs[sole, 2, 0] * x + Hs[sole, 2, 1] * y + Hs[sole, 2, 2]
            texels = np.sqrt(areas[sole] * area / (w * w * w)) / texel[sole]
            _fill_block(
                bearings, Hs[sole], texel[sole], texels, data, offsets[sole], shapes[sole], row0, column0, image
            )
            continue
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
def depths(bearings, Hs, limits, seen, out):
    """Write the depth along each bearing (M, 2) into `out` (M,), NaN where there is no surface."""
    chosen, count = np.empty(len(Hs), np.int64), 0
    for k in range(len(Hs)):
        if seen[k]:
            chosen[count] = k
            count += 1
    for i in range(len(bearings)):
        k, w = _hit(Hs, limits, chosen, count, float(bearings[i, 0]), float(bearings[i, 1]))
        out[i] = 1.0 / w if k >= 0 else np.nan
