"""Events inside ROS messages: `dvs_msgs/EventArray` and the encodings of `event_camera_msgs/EventPacket`.

Messages are parsed from their bytes: one Python object an event, as a generic reader makes, costs microseconds each.
"""

from __future__ import annotations

import struct
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.formats.prophesee import EvtDecoder

Columns = tuple[NDArray[np.int64], NDArray, NDArray, NDArray[np.bool_]]

_ROS1_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "?")])
# CDR aligns each value to its own size, and 13 bytes of event to 2: times and polarity lie 16 bytes apart from the
# first event on, the pixel of the k-th event at 16 k - 2 but for the first, at 0.
_CDR_EVENT = np.dtype(
    {"names": ["sec", "nsec", "p"], "formats": ["<u4", "<u4", "?"], "offsets": [4, 8, 12], "itemsize": 16}
)


def microseconds_of(nanoseconds: Any) -> Any:
    """Return integer microseconds of integer nanoseconds, halves rounded up."""
    return (nanoseconds + 500) // 1000


def parse_event_array(raw: bytes | memoryview, *, is_ros1: bool) -> tuple[tuple[int, int], Columns]:
    """Return the sensor's (width, height) and the events of a serialized `dvs_msgs/EventArray`.

    Raises:
        ValueError: the bytes are shorter than what they claim to hold.
    """
    data = bytes(raw)
    try:
        # Header: ROS 1 has a sequence number, ROS 2 four bytes of encapsulation; then the stamp, then a text.
        at = 12
        (length,) = struct.unpack_from("<I", data, at)
        at += 4 + length
        if not is_ros1:
            at = -(-(at - 4) // 4) * 4 + 4
        height, width, count = struct.unpack_from("<III", data, at)
    except struct.error as error:
        raise ValueError("the message is cut short") from error
    at += 12
    kind = _ROS1_EVENT if is_ros1 else _CDR_EVENT
    # The padding after the last element is not written in CDR.
    if count and at + count * kind.itemsize - (0 if is_ros1 else 3) > len(data):
        raise ValueError(f"{count} events announced, fewer are there")
    missing = max(0, at + count * kind.itemsize - len(data))
    data += bytes(missing)
    rows = np.frombuffer(data, kind, count, at)
    t = rows["sec"].astype(np.int64) * 1_000_000 + microseconds_of(rows["nsec"].astype(np.int64))
    if is_ros1:
        x, y = rows["x"], rows["y"]
    else:
        pairs = np.frombuffer(data, "<u2", 8 * count, at)
        x, y = np.roll(pairs, 1)[::8].copy(), pairs[::8].copy()
        x[:1], y[:1] = pairs[:1], pairs[1:2]
    return (width, height), (t, x, y, rows["p"].view(np.uint8) > 0)


class PacketDecoder:
    """Decodes the `EventPacket` messages of one topic, in order.

    Raises:
        ValueError: the encoding is not known.
    """

    ENCODINGS = ("evt2", "evt21", "evt3", "libcaer_cmp", "mono")

    def __init__(self, encoding: str) -> None:
        if encoding not in self.ENCODINGS:
            raise ValueError(f"encoding {encoding!r} is not known, known are {', '.join(self.ENCODINGS)}")
        self._encoding = encoding
        names = {"evt2": "EVT2", "evt21": "EVT2.1", "evt3": "EVT3"}
        self._evt = EvtDecoder(names[encoding]) if encoding in names else None
        self._offset_us: int | None = None

    def __call__(self, data: NDArray[np.uint8], time_base_ns: int, stamp_ns: int) -> Columns:
        """Return the events of one packet.

        Prophesee's encodings carry the sensor's own clock: it is shifted by one constant, so that the first event
        has the time of its message, the clock of the bag's other topics.
        """
        if self._evt is not None:
            whole = len(data) - len(data) % self._evt.word.itemsize
            t, x, y, p = self._evt(data[:whole].tobytes())
            if self._offset_us is None and len(t):
                self._offset_us = microseconds_of(stamp_ns) - int(t[0])
            return t + (self._offset_us or 0), x, y, p
        if self._encoding == "mono":
            words = np.frombuffer(data[: len(data) // 8 * 8].tobytes(), "<u8")
            t_ns = (words & 0xFFFFFFFF).astype(np.int64) + time_base_ns
            x, y = ((words >> 32) & 0xFFFF).astype(np.uint16), ((words >> 48) & 0x7FFF).astype(np.uint16)
            return microseconds_of(t_ns), x, y, (words >> 63) > 0
        words = np.frombuffer(data[: len(data) // 2 * 2].tobytes(), "<u2")
        n = 8 * len(words)
        t, x, y, p = np.empty(n, np.int64), np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.bool_)
        n = _decode_libcaer_cmp(words, t, x, y, p)
        return t[:n] + microseconds_of(time_base_ns), x[:n], y[:n], p[:n]


@numba.njit(cache=True, nogil=True)
def _decode_libcaer_cmp(words, t_us, x_px, y_px, is_positive):
    """Return how many events the words of one packet held; times are relative to its base and start at 0."""
    n, high, low, x, base, polarity = 0, 0, 0, 0, 0, 0
    for i in range(len(words)):
        w = np.int64(words[i])
        kind, value = w >> 12, w & 0xFFF
        if kind == 0:
            high = value
        elif kind == 1:
            low = value
        elif kind == 2:
            x = value & 0x7FF
        elif kind == 3:
            t_us[n], x_px[n], y_px[n], is_positive[n] = (high << 12) | low, x, value & 0x7FF, (value >> 11) == 1
            n += 1
        elif kind == 4:
            base, polarity = value & 0x7FF, value >> 11
        elif kind == 5:
            for bit in range(8):
                if (value >> bit) & 1:
                    t_us[n], x_px[n], y_px[n] = (high << 12) | low, x, base + bit
                    is_positive[n] = polarity == 1
                    n += 1
            base += 8
    return n
