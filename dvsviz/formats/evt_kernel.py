"""Decoding of Prophesee's event encodings EVT2, EVT2.1 and EVT3, word by word, with state kept between blocks.

Our own, because the library with a fitting licence (evlib, which checks this one in the tests) holds a whole file in
memory, and because the same encoding travels in ROS messages.
"""

from __future__ import annotations

import numba
import numpy as np

# State between blocks: high part of the time, loops of it, whether it is known, row, low time, vector base, polarity.
HIGH, LOOPS, KNOWN, ROW, LOW, BASE, POLARITY, SKIPPED = range(8)
STATE_SIZE = 8

# At most so many events a word: a vector of EVT2.1 has 32 bits, one of EVT3 has 12.
EVENTS_PER_WORD = {"EVT2": 1, "EVT2.1": 32, "EVT3": 12}
WORD_TYPES = {"EVT2": np.dtype("<u4"), "EVT2.1": np.dtype("<u8"), "EVT3": np.dtype("<u2")}


@numba.njit(cache=True, nogil=True)
def _set_high(state, high, period):
    # The high part falls by nearly its whole range where the clock wraps; small steps back are left as they are.
    if state[KNOWN] and state[HIGH] - high > period // 2:
        state[LOOPS] += 1
    state[HIGH], state[KNOWN] = high, 1


@numba.njit(cache=True, nogil=True)
def decode_evt2(words, state, t_us, x_px, y_px, is_positive):
    """Return how many events the words held; events before the first time are skipped and counted."""
    n = 0
    for i in range(len(words)):
        w = np.int64(words[i])
        kind = w >> 28
        if kind <= 1:
            if not state[KNOWN]:
                state[SKIPPED] += 1
                continue
            t_us[n] = (((state[LOOPS] << 28) + state[HIGH]) << 6) + ((w >> 22) & 0x3F)
            x_px[n], y_px[n], is_positive[n] = (w >> 11) & 0x7FF, w & 0x7FF, kind == 1
            n += 1
        elif kind == 8:
            _set_high(state, w & 0xFFFFFFF, 1 << 28)
    return n


@numba.njit(cache=True, nogil=True)
def decode_evt21(words, state, t_us, x_px, y_px, is_positive):
    """Return how many events the 64-bit words held."""
    n = 0
    for i in range(len(words)):
        low, high = np.int64(words[i] & np.uint64(0xFFFFFFFF)), np.int64(words[i] >> np.uint64(32))
        kind = high >> 28
        if kind <= 1:
            if not state[KNOWN]:
                state[SKIPPED] += 1
                continue
            t = (((state[LOOPS] << 28) + state[HIGH]) << 6) + ((high >> 22) & 0x3F)
            x, y = (high >> 11) & 0x7FF, high & 0x7FF
            for bit in range(32):
                if (low >> bit) & 1:
                    t_us[n], x_px[n], y_px[n], is_positive[n] = t, x + bit, y, kind == 1
                    n += 1
        elif kind == 8:
            _set_high(state, high & 0xFFFFFFF, 1 << 28)
    return n


@numba.njit(cache=True, nogil=True)
def decode_evt3(words, state, t_us, x_px, y_px, is_positive):
    """Return how many events the 16-bit words held; times are 24 bits and wrap every 16.8 s."""
    n = 0
    for i in range(len(words)):
        w = np.int64(words[i])
        kind, value = w >> 12, w & 0xFFF
        if kind == 0x0:
            state[ROW] = value & 0x7FF
        elif kind == 0x2:
            if not state[KNOWN]:
                state[SKIPPED] += 1
                continue
            t_us[n] = (((state[LOOPS] << 12) + state[HIGH]) << 12) + state[LOW]
            x_px[n], y_px[n], is_positive[n] = value & 0x7FF, state[ROW], (value >> 11) == 1
            n += 1
        elif kind == 0x3:
            state[BASE], state[POLARITY] = value & 0x7FF, value >> 11
        elif kind in (0x4, 0x5):
            size = 12 if kind == 0x4 else 8
            if state[KNOWN]:
                t = (((state[LOOPS] << 12) + state[HIGH]) << 12) + state[LOW]
                for bit in range(size):
                    if (value >> bit) & 1:
                        t_us[n], x_px[n], y_px[n] = t, state[BASE] + bit, state[ROW]
                        is_positive[n] = state[POLARITY] == 1
                        n += 1
            else:
                state[SKIPPED] += 1
            state[BASE] += size
        elif kind == 0x6:
            state[LOW] = value
        elif kind == 0x8:
            if not state[KNOWN] or value != state[HIGH]:
                state[LOW] = 0
            _set_high(state, value, 1 << 12)
    return n


DECODERS = {"EVT2": decode_evt2, "EVT2.1": decode_evt21, "EVT3": decode_evt3}
