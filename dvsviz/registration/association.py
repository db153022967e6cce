"""Which colour image was taken with which depth image, where the files give no times: seen in the images alone.

Numbered files of a colour and a depth stream carry the same number where both arrived, but either stream may lose an
image: from there on equal numbers are a frame apart. Depth steps lie on the outlines of the colour image that was taken
with them, and beside those of its neighbours as far as the camera moved.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dvsviz.registration.rig import depth_steps, outlines

Array = NDArray[np.float64]

# Colour images so many numbers before and after are looked at.
_REACH = 2
# Log gain in agreement that a change must bring, over all frames that follow, to be believed. One frame of a moving
# camera brings 0.1 to 0.4 (a hand-held Kinect at 20 degrees a second), noise up to 0.1 now and then; a still one 0.
_CHANGE_COST = 0.7
# Long sequences are looked at here and there first: every frame costs 50 ms.
_SAMPLES = 40


def colour_offsets(
    count: int, grey: Callable[[int], NDArray[np.uint8]], depth: Callable[[int], NDArray[np.float32] | None]
) -> NDArray[np.int64]:
    """Return offsets (count,): depth image k was taken with colour image `k + offset[k]`, which may lie outside.

    The offsets are those whose agreement is highest in the sum over the sequence, less a cost for each change, so that
    a still camera, or one that sees no depth steps, keeps the numbers.

    Args:
        count: number of frames.
        grey: gives the intensity image (height, width) of a number.
        depth: gives the depth image (height, width) of a number in the colour camera, NaN where none; or None.
    """
    kept: dict[int, NDArray[np.float32]] = {}

    def agreement(frames: NDArray[np.int64]) -> Array:
        """Return log agreements (frames, offsets)."""
        out = np.full((len(frames), 2 * _REACH + 1), np.nan)
        for row, k in enumerate(frames.tolist()):
            seen = depth(k)
            steps, is_measured = (None, None) if seen is None else depth_steps(seen)
            for number in [n for n in kept if n < k - _REACH]:
                del kept[number]
            for column, number in enumerate(range(k - _REACH, k + _REACH + 1)):
                if steps is None or is_measured is None or not 0 <= number < count:
                    continue
                if number not in kept:
                    kept[number] = outlines(grey(number))
                outline = kept[number]
                out[row, column] = np.log(outline[steps].mean() / outline[is_measured].mean())
        kept.clear()
        # An image that is not there says nothing: its offset is taken to be as bad as the worst.
        worst = np.where(np.isnan(out), np.inf, out).min(axis=1, initial=np.inf)
        return np.where(np.isnan(out), np.where(np.isfinite(worst), worst, 0.0)[:, None], out)

    samples = np.unique(np.linspace(0, count - 1, min(count, _SAMPLES)).astype(np.int64))
    found = _best_path(agreement(samples))
    offsets = found[np.searchsorted(samples, np.arange(count), side="right") - 1]
    for i in np.flatnonzero((np.diff(found) != 0) & (np.diff(samples) > 1)).tolist():
        between = np.arange(samples[i], samples[i + 1] + 1)
        offsets[between] = _best_path(agreement(between), first=int(found[i]), last=int(found[i + 1]))
    return offsets


def _best_path(gains: Array, first: int = 0, last: int | None = None) -> NDArray[np.int64]:
    """Return the offsets (N,) of the highest sum of gains (N, offsets) less the cost of changes (Viterbi's algorithm).

    Args:
        gains: of each frame and offset.
        first: offset before the first frame: another one costs its change.
        last: offset of the last frame, where it is known.
    """
    offsets = np.arange(-_REACH, _REACH + 1)
    cost = _CHANGE_COST * np.abs(offsets[:, None] - offsets)
    total, came_from = gains[0] - _CHANGE_COST * np.abs(offsets - first), []
    for row in gains[1:]:
        # The first of equal sums wins: equal sums keep the offset, as every change costs.
        ways = total[:, None] - cost
        came_from.append(ways.argmax(axis=0))
        total = ways.max(axis=0) + row
    at = int(total.argmax()) if last is None else last + _REACH
    path = [at]
    for step in reversed(came_from):
        path.append(int(step[path[-1]]))
    return offsets[path[::-1]].astype(np.int64)
