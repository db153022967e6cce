"""The event camera: log-intensity threshold crossings of every pixel, with their times.

Between two images the log intensity of a pixel is a straight line, low-passed by the photoreceptor. The pixel
compares it with the level it memorised; where the difference reaches a threshold it sends an event at that time,
is blind for the refractory time, and memorises the level it then sees. A leak current raises the difference slowly,
so that an unlit pixel sends positive events of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dvsviz.events.events import Events
from dvsviz.simulate.render import BLOCK

# More events of one pixel within one step than any contrast can cause.
_MOST_A_STEP = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class EventCameraModel:
    """What one event sensor does to light.

    Attributes:
        threshold_on: mean rise of log intensity that makes a positive event.
        threshold_off: mean fall that makes a negative one.
        threshold_sigma: standard deviation of a pixel's thresholds, as a share of the mean.
        refractory_s: blind time after an event.
        bandwidth_hz: cut-off of the photoreceptor's low-pass; 0 for none.
        leak_hz: mean rate of a pixel's positive events without light changes.
        shot_hz: mean rate of a pixel's events of either sign by noise.
        hot_share: share of pixels that fire on their own.
        hot_hz: mean rate of these.
    """

    threshold_on: float = 0.25
    threshold_off: float = 0.25
    threshold_sigma: float = 0.035
    refractory_s: float = 50e-6
    bandwidth_hz: float = 0.0
    leak_hz: float = 0.05
    shot_hz: float = 0.05
    hot_share: float = 1e-4
    hot_hz: float = 20.0

    @property
    def settling_s(self) -> float:
        """Time constant of the low-pass, s; infinite where there is none."""
        return 1 / (2 * np.pi * self.bandwidth_hz) if self.bandwidth_hz > 0 else np.inf

    def __post_init__(self) -> None:
        if not (self.threshold_on > 0 and self.threshold_off > 0 and 0 <= self.threshold_sigma < 0.3):
            raise ValueError("thresholds: expected positive means and a sigma of 0 to 0.3")
        rates = (self.refractory_s, self.bandwidth_hz, self.leak_hz, self.shot_hz, self.hot_share, self.hot_hz)
        if min(rates) < 0:
            raise ValueError("refractory_s, bandwidth_hz, leak_hz, shot_hz, hot_*: expected 0 or more")


@njit(cache=True, nogil=True, error_model="numpy")
def _sense(
    image, last, active, everywhere, columns, level, seen, memory, free_s, on, off, leak, block_s, t1, tau,
    refractory, out_s, out_x, out_y, out_p, count, first_block,
):  # fmt: skip
    """Advance the blocks to time t1; return the block to go on with (their number when done) and the event count."""
    height, width = image.shape
    for block in range(first_block, len(block_s)):
        if not (everywhere or active[block]):
            continue
        if count + BLOCK * BLOCK * _MOST_A_STEP > len(out_s):
            return block, count
        t0 = block_s[block]
        dt = t1 - t0
        if dt <= 0.0:
            continue
        block_s[block] = t1
        decay = np.exp(-dt / tau) if tau > 0.0 else 0.0
        row0, column0 = block // columns * BLOCK, block % columns * BLOCK
        for row in range(row0, min(row0 + BLOCK, height)):
            for column in range(column0, min(column0 + BLOCK, width)):
                # Unsigned, or every access asks whether it counts from the end.
                r, c = np.uint64(row), np.uint64(column)
                x0, light = level[r, c], image[r, c]
                x1 = x0
                # Flat surfaces are of the same light to the bit: no logarithm is taken twice.
                if light != last[r, c]:
                    last[r, c] = light
                    x1 = np.float64(np.log(light))
                    level[r, c] = x1
                y0, y1 = x0, x1
                if tau > 0.0:
                    # Response of a first-order low-pass to a straight line.
                    y0, lag = seen[r, c], (x1 - x0) / dt * tau
                    y1 = x1 - lag + (y0 - x0 + lag) * decay
                    seen[r, c] = y1
                a, b = y0 + leak[r, c] * t0, y1 + leak[r, c] * t1
                if a == b:
                    continue
                free = free_s[r, c]
                if free >= t1:
                    memory[r, c] = b
                    continue
                held, since = memory[r, c], t0
                if free <= t0:
                    # Most pixels see no event in a step.
                    if held - off[r, c] < b < held + on[r, c]:
                        continue
                else:
                    held, since = a + (b - a) * (free - t0) / dt, free
                slope = (b - a) / dt
                threshold = on[r, c] if slope > 0.0 else -off[r, c]
                for _ in range(_MOST_A_STEP):
                    target = held + threshold
                    if (slope > 0.0 and target > b) or (slope < 0.0 and target < b):
                        break
                    t = max(t0 + (target - a) / slope, since)
                    out_s[count], out_x[count], out_y[count], out_p[count] = t, column, row, slope > 0.0
                    count += 1
                    held = target
                    if refractory > 0.0:
                        since = t + refractory
                        free_s[r, c] = since
                        if since >= t1:
                            held = b
                            break
                        held = a + slope * (since - t0)
                memory[r, c] = held
    return len(block_s), count


@njit(cache=True, nogil=True, error_model="numpy")
def _sorted_by_time(t_us, x, y, p, first_us, end_us):
    """Return the events sorted by microsecond, those of one microsecond in their old order."""
    starts = np.zeros(end_us - first_us + 1, np.int64)
    for i in range(len(t_us)):
        starts[t_us[i] - first_us + 1] += 1
    for i in range(1, len(starts)):
        starts[i] += starts[i - 1]
    ts, xs, ys, ps = np.empty_like(t_us), np.empty_like(x), np.empty_like(y), np.empty_like(p)
    for i in range(len(t_us)):
        k = starts[t_us[i] - first_us]
        starts[t_us[i] - first_us] = k + 1
        ts[k], xs[k], ys[k], ps[k] = t_us[i], x[i], y[i], p[i]
    return ts, xs, ys, ps


class EventCamera:
    """The state of every pixel of one sensor.

    Args:
        model: the sensor.
        image: first intensity image (height, width), all above 0.
        t_s: its time, s.
        rng: for the pixels' thresholds and noise.
    """

    def __init__(
        self, model: EventCameraModel, image: NDArray[np.float32], t_s: float, rng: np.random.Generator
    ) -> None:
        shape = image.shape
        self._model, self._rng, self._flushed_s = model, rng, t_s
        self._columns = -(-shape[1] // BLOCK)
        blocks = -(-shape[0] // BLOCK) * self._columns
        sigma = model.threshold_sigma
        self._on = model.threshold_on * np.maximum(1 + sigma * rng.standard_normal(shape), 0.1)
        self._off = model.threshold_off * np.maximum(1 + sigma * rng.standard_normal(shape), 0.1)
        self._leak = np.zeros(shape)
        if model.leak_hz > 0:
            self._leak = model.leak_hz * model.threshold_on * rng.lognormal(-0.045, 0.3, shape)
        self._last = image.copy()
        self._level = np.log(image).astype(np.float64)
        self._seen = self._level.copy()
        # Memorised at an unknown time before: anywhere between the thresholds, as in a sensor that has run a while.
        self._memory = (
            self._seen + self._leak * t_s - rng.uniform(-0.5, 0.5, shape) * np.minimum(self._on, self._off)
        )
        self._free_s = np.full(shape, -np.inf)
        self._block_s = np.full(blocks, t_s)
        self._hot = np.flatnonzero(rng.uniform(size=shape) < model.hot_share)
        self._reserve(1 << 16, 0)

    def _reserve(self, capacity: int, count: int) -> None:
        old = (self._s, self._x, self._y, self._p) if count else None
        self._s, self._p = np.empty(capacity), np.empty(capacity, np.bool_)
        self._x, self._y = np.empty(capacity, np.uint16), np.empty(capacity, np.uint16)
        if old is not None:
            for new, values in zip((self._s, self._x, self._y, self._p), old, strict=True):
                new[:count] = values[:count]
        self._count = count

    def step(self, image: NDArray[np.float32], t_s: float, active: NDArray[np.bool_] | None = None) -> None:
        """Let the pixels see the next image.

        Args:
            image: intensity (height, width), above 0.
            t_s: its time, not before the last one; with a low-pass, within its time constant of it.
            active: (blocks of 4 x 4,) False where the image is known to be as in the last step; None for none.
        """
        # A low-passed pixel goes on changing after its light has stopped to.
        everywhere = active is None or self._model.bandwidth_hz > 0
        flags = np.ones(0, np.bool_) if active is None else active
        tau = self._model.settling_s if self._model.bandwidth_hz > 0 else 0.0
        block = 0
        while True:
            block, self._count = _sense(
                image, self._last, flags, everywhere, self._columns, self._level, self._seen, self._memory,
                self._free_s, self._on, self._off, self._leak, self._block_s, t_s, tau, self._model.refractory_s,
                self._s, self._x, self._y, self._p, self._count, block,
            )  # fmt: skip
            if block == len(self._block_s):
                return
            self._reserve(2 * len(self._s), self._count)

    def flush(self, image: NDArray[np.float32], t_s: float) -> Events:
        """Return the events since the last flush, up to the time `t_s` of the image last seen, in time order."""
        self.step(image, t_s)
        self._add_noise(self._flushed_s, t_s)
        n = self._count
        t_us = np.floor(self._s[:n] * 1e6).astype(np.int64)
        # Blocks and noise are both later than the last flush, but rounding down may put them one microsecond before.
        first_us = int(np.floor(self._flushed_s * 1e6))
        columns = _sorted_by_time(
            t_us, self._x[:n], self._y[:n], self._p[:n], first_us, int(np.floor(t_s * 1e6)) + 1
        )
        self._count, self._flushed_s = 0, t_s
        return Events(t_us=columns[0], x_px=columns[1], y_px=columns[2], is_positive=columns[3])

    def _add_noise(self, start_s: float, end_s: float) -> None:
        rng, (height, width) = self._rng, self._level.shape
        shots = rng.poisson(self._model.shot_hz * height * width * (end_s - start_s))
        pixels = [rng.integers(0, height * width, shots)]
        if len(self._hot):
            hot = rng.poisson(self._model.hot_hz * len(self._hot) * (end_s - start_s))
            pixels.append(self._hot[rng.integers(0, len(self._hot), hot)])
        pixel = np.concatenate(pixels)
        n = len(pixel)
        while self._count + n > len(self._s):
            self._reserve(2 * len(self._s), self._count)
        at = slice(self._count, self._count + n)
        self._s[at] = rng.uniform(start_s, end_s, n)
        self._y[at], self._x[at] = np.divmod(pixel, width)
        self._p[at] = rng.uniform(size=n) < 0.5
        self._count += n
