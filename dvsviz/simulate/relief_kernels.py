"""The ray caster of scenes with depth, compiled: which rectangle a bearing meets first, and its light."""

from __future__ import annotations

import numpy as np
from numba import njit

from dvsviz.simulate.render import BLOCK, bilinear, bilinear_inside


@njit(cache=True, nogil=True, error_model="numpy")
def _hit(Hs, limits, chosen, count, x, y):
    """Return the nearest of the chosen patches along a bearing, or -1, and its inverse depth."""
    best, nearest = -1, 1e-6
    for i in range(count):
        k = chosen[i]
        w = Hs[k, 2, 0] * x + Hs[k, 2, 1] * y + Hs[k, 2, 2]
        if w <= nearest:
            continue
        u = Hs[k, 0, 0] * x + Hs[k, 0, 1] * y + Hs[k, 0, 2]
        v = Hs[k, 1, 0] * x + Hs[k, 1, 1] * y + Hs[k, 1, 2]
        if u >= 0.0 and v >= 0.0 and u < limits[k, 0] * w and v < limits[k, 1] * w:
            best, nearest = k, w
    return best, nearest


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(Hs, texel, areas, pixel_area, data, offsets, shapes, k, w, x, y):
    """Return the light from patch k along a bearing whose inverse depth is w."""
    u = (Hs[k, 0, 0] * x + Hs[k, 0, 1] * y + Hs[k, 0, 2]) / w
    v = (Hs[k, 1, 0] * x + Hs[k, 1, 1] * y + Hs[k, 1, 2]) / w
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
def _candidates(Hs, limits, boxes, given, count, bounds, inverse_depths, out):
    """Write those of `given` that may be seen in a rectangle of bearings to `out`; return how many, and which is alone.

    Inverse depth and the borders of a patch are affine in the bearing: what holds at four corners holds between them.
    A patch that covers the rectangle hides all that are farther at all four corners. -1 where none is alone.

    `Hs`, `limits` and `boxes` are those of `render`; `given` holds numbers of patches, the first `count` of which are
    asked for, `bounds` is (x0, y0, x1, y1), `inverse_depths` (N, 4) is to work in, `out` may be `given`.
    """
    found, cover, nearness = 0, -1, 0.0
    for i in range(count):
        k = given[i]
        if (
            boxes[k, 0] >= bounds[2]
            or boxes[k, 2] <= bounds[0]
            or boxes[k, 1] >= bounds[3]
            or boxes[k, 3] <= bounds[1]
        ):
            continue
        width, height = limits[k, 0], limits[k, 1]
        missed, anywhere, ahead, behind, total = 0b1111, 0, False, False, 0.0
        for c in range(4):
            x, y = bounds[2 if c & 1 else 0], bounds[3 if c & 2 else 1]
            w = Hs[k, 2, 0] * x + Hs[k, 2, 1] * y + Hs[k, 2, 2]
            u = Hs[k, 0, 0] * x + Hs[k, 0, 1] * y + Hs[k, 0, 2]
            v = Hs[k, 1, 0] * x + Hs[k, 1, 1] * y + Hs[k, 1, 2]
            outside = (u < 0.0) | (v < 0.0) << 1 | (u >= width * w) << 2 | (v >= height * w) << 3
            missed &= outside
            anywhere |= outside
            ahead, behind = ahead or w > 1e-6, behind or w <= 1e-6
            inverse_depths[k, c] = w
            total += w
        if missed or not ahead:
            continue
        out[found] = k
        found += 1
        if anywhere == 0 and not behind and total > nearness:
            cover, nearness = k, total
    if cover < 0:
        return found, -1
    left = 0
    for i in range(found):
        k = out[i]
        hidden = True
        for c in range(4):
            hidden = hidden and inverse_depths[k, c] < inverse_depths[cover, c]
        if not hidden:
            out[left] = k
            left += 1
    return left, (cover if left == 1 else -1)


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
    # Values of their own: what is written to the image might else be what is read from an array.
    h00, h01, h02 = scale * H[0, 0], scale * H[0, 1], scale * H[0, 2]
    h10, h11, h12 = scale * H[1, 0], scale * H[1, 1], scale * H[1, 2]
    h20, h21, h22 = H[2, 0], H[2, 1], H[2, 2]
    offset_a, rows_a, columns_a = offsets[level], shapes[level, 0], shapes[level, 1]
    offset_b, rows_b, columns_b = offsets[level + 1], shapes[level + 1, 0], shapes[level + 1, 1]
    row1, column1 = min(row0 + BLOCK, height), min(column0 + BLOCK, width)
    # What is read lies between the outermost pixels, and two texels of the coarser level beyond.
    inside = True
    for c in range(4):
        row, column = (row1 - 1 if c & 1 else row0), (column1 - 1 if c & 2 else column0)
        x, y = bearings[row, column, 0], bearings[row, column, 1]
        w = 1.0 / (h20 * x + h21 * y + h22)
        u, v = (h00 * x + h01 * y + h02) * w, (h10 * x + h11 * y + h12) * w
        inside = inside and 4.0 < u < columns_a - 4.0 and 4.0 < v < rows_a - 4.0
    for row in range(row0, row1):
        for column in range(column0, column1):
            x, y = bearings[row, column, 0], bearings[row, column, 1]
            w = 1.0 / (h20 * x + h21 * y + h22)
            u, v = np.float32((h00 * x + h01 * y + h02) * w), np.float32((h10 * x + h11 * y + h12) * w)
            if inside:
                fine = bilinear_inside(data, offset_a, columns_a, u - half, v - half)
                coarse = bilinear_inside(data, offset_b, columns_b, half * u - half, half * v - half)
            else:
                fine = bilinear(data, offset_a, rows_a, columns_a, u - half, v - half, False)
                coarse = bilinear(data, offset_b, rows_b, columns_b, half * u - half, half * v - half, False)
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
def _blend(
    Hs, limits, chosen, count, texel, areas, area, data, offsets, shapes, background, pixel, found, sums
):  # fmt: skip
    """Return the light of a pixel that sees several surfaces: 4 x 4 rays say how much it sees of each, and where.

    Each surface is read once, in the middle of its rays, over their share of the pixel: a row (n, x, y) of `sums` each.
    """
    slots, empty = 0, 0
    for i in range(16):
        a, b = (i % 4 - 1.5) / 4, (i // 4 - 1.5) / 4
        x = pixel[0, 0] + a * pixel[1, 0] + b * pixel[2, 0]
        y = pixel[0, 1] + a * pixel[1, 1] + b * pixel[2, 1]
        k, _ = _hit(Hs, limits, chosen, count, x, y)
        if k < 0:
            empty += 1
            continue
        slot = 0
        while slot < slots and found[slot] != k:
            slot += 1
        if slot == slots:
            found[slot] = k
            sums[slot, 0], sums[slot, 1], sums[slot, 2] = 0.0, 0.0, 0.0
            slots += 1
        sums[slot, 0] += 1.0
        sums[slot, 1] += x
        sums[slot, 2] += y
    total = empty * background
    for slot in range(slots):
        k, n = found[slot], sums[slot, 0]
        x, y = sums[slot, 1] / n, sums[slot, 2] / n
        w = Hs[k, 2, 0] * x + Hs[k, 2, 1] * y + Hs[k, 2, 2]
        total += n * _shade(Hs, texel, areas, area * n / 16, data, offsets, shapes, k, w, x, y)
    return total / 16


@njit(cache=True, nogil=True, error_model="numpy")
def _mixed_block(
    bearings, Hs, limits, chosen, count, texel, areas, area, data, offsets, shapes, background, row0, column0, image,
    hits, pixel, found, sums,
):  # fmt: skip
    """Write the light of a block that sees several surfaces; `hits` (BLOCK + 1, BLOCK + 1) are those of its corners."""
    row1, column1 = min(row0 + BLOCK, image.shape[0]), min(column0 + BLOCK, image.shape[1])
    for i in range(row1 - row0 + 1):
        for j in range(column1 - column0 + 1):
            # The upper left corner of a pixel; of the last row and column the other side of the pixel before.
            row, column = min(row0 + i, row1 - 1), min(column0 + j, column1 - 1)
            a, b = (-0.5 if column0 + j < column1 else 0.5), (-0.5 if row0 + i < row1 else 0.5)
            _corners(bearings, row, column, pixel)
            x = pixel[0, 0] + a * pixel[1, 0] + b * pixel[2, 0]
            y = pixel[0, 1] + a * pixel[1, 1] + b * pixel[2, 1]
            hits[i, j], _ = _hit(Hs, limits, chosen, count, x, y)
    for i in range(row1 - row0):
        for j in range(column1 - column0):
            row, column = row0 + i, column0 + j
            x, y = float(bearings[row, column, 0]), float(bearings[row, column, 1])
            k, w = _hit(Hs, limits, chosen, count, x, y)
            if hits[i, j] != k or hits[i, j + 1] != k or hits[i + 1, j] != k or hits[i + 1, j + 1] != k:
                _corners(bearings, row, column, pixel)
                image[row, column] = _blend(
                    Hs,
                    limits,
                    chosen,
                    count,
                    texel,
                    areas,
                    area,
                    data,
                    offsets,
                    shapes,
                    background,
                    pixel,
                    found,
                    sums,
                )
            elif k < 0:
                image[row, column] = background
            else:
                image[row, column] = _shade(Hs, texel, areas, area, data, offsets, shapes, k, w, x, y)


@njit(cache=True, nogil=True, error_model="numpy")
def _has_moved(Hs, limits, chosen, count, sole, areas, area, corners, still_px, last, last_hit, now, now_hit):
    """Return whether the surfaces at centre and corners of a block are others, or moved by `still_px` and more.

    Where another surface may be in view between these five, it has. What is seen, and where on it, is written to
    `now_hit` (5,) and `now` (5, 2).
    """
    moved, same, seen = False, True, 0
    for i in range(5):
        x, y = corners[i, 0], corners[i, 1]
        k = sole
        if sole >= 0:
            w = Hs[k, 2, 0] * x + Hs[k, 2, 1] * y + Hs[k, 2, 2]
        else:
            k, w = _hit(Hs, limits, chosen, count, x, y)
        now_hit[i] = k
        moved = moved or k != last_hit[i]
        same, is_new = same and k == now_hit[0], k >= 0
        for j in range(i):
            is_new = is_new and k != now_hit[j]
        seen += 1 if is_new else 0
        if k >= 0:
            r = 1.0 / w
            u = (Hs[k, 0, 0] * x + Hs[k, 0, 1] * y + Hs[k, 0, 2]) * r
            v = (Hs[k, 1, 0] * x + Hs[k, 1, 1] * y + Hs[k, 1, 2]) * r
            now[i, 0], now[i, 1] = u, v
            du, dv = u - last[i, 0], v - last[i, 1]
            moved = moved or du * du + dv * dv >= still_px * still_px * (areas[k] * area * (r * r * r))
    return moved or (seen < count and not same)


@njit(cache=True, nogil=True, error_model="numpy")
def render(
    bearings, block_bearings, block_area, block_bounds, tile_bounds, tile_blocks, columns, Hs, limits, boxes, seen,
    texel, areas, data, offsets, shapes, last, last_hit, still_px, background, image, active,
):  # fmt: skip
    """Write the light of the blocks that may have changed into `image`; see `ReliefView.render`.

    `Hs` (N, 3, 3) take bearings to (u, v, 1) times inverse depth in the N patches, `limits` (N, 2) are their sizes,
    `boxes` (N, 4) their bounds in bearings, `areas` (N,) the determinants; `last` and `last_hit` are kept a block.
    `block_bounds` (B, 4) and `tile_bounds` (T, 4) hold all that is looked at in them; `tile_blocks` (T, n) are numbers
    of blocks, -1 for none. What a tile does not see, its blocks need not look for.
    """
    all_seen, ahead = np.empty(len(Hs), np.int64), 0
    for k in range(len(Hs)):
        if seen[k]:
            all_seen[ahead] = k
            ahead += 1
    in_tile, chosen = np.empty(len(Hs), np.int64), np.empty(len(Hs), np.int64)
    inverse_depths, found, sums = np.empty((len(Hs), 4)), np.empty(16, np.int64), np.empty((16, 3))
    hits = np.empty((BLOCK + 1, BLOCK + 1), np.int64)
    now, now_hit, pixel = np.empty((5, 2)), np.empty(5, np.int64), np.empty((3, 2))
    for tile in range(len(tile_bounds)):
        in_tile_count, tile_sole = _candidates(
            Hs, limits, boxes, all_seen, ahead, tile_bounds[tile], inverse_depths, in_tile
        )
        for block in tile_blocks[tile]:
            if block < 0:
                continue
            count, sole = 1, tile_sole
            if sole < 0:
                count, sole = _candidates(
                    Hs, limits, boxes, in_tile, in_tile_count, block_bounds[block], inverse_depths, chosen
                )
            area = block_area[block]
            active[block] = _has_moved(
                Hs, limits, chosen, count, sole, areas, area, block_bearings[block], still_px, last[block],
                last_hit[block], now, now_hit,
            )  # fmt: skip
            if not active[block]:
                continue
            for i in range(5):
                last_hit[block, i], last[block, i, 0], last[block, i, 1] = now_hit[i], now[i, 0], now[i, 1]
            row0, column0 = block // columns * BLOCK, block % columns * BLOCK
            if sole >= 0:
                x, y = block_bearings[block, 0, 0], block_bearings[block, 0, 1]
                w = Hs[sole, 2, 0] * x + Hs[sole, 2, 1] * y + Hs[sole, 2, 2]
                texels = np.sqrt(areas[sole] * area / (w * w * w)) / texel[sole]
                _fill_block(
                    bearings, Hs[sole], texel[sole], texels, data, offsets[sole], shapes[sole], row0, column0, image
                )
                continue
            _mixed_block(
                bearings, Hs, limits, chosen, count, texel, areas, area, data, offsets, shapes, background, row0,
                column0, image, hits, pixel, found, sums,
            )  # fmt: skip


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
