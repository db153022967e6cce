"""Prophesee RAW files (EVT2, EVT2.1, EVT3) and DAT files, read block by block."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.formats import evt_kernel
from dvsviz.formats.sink import RecordingSink
from dvsviz.formats.sizes import assumption, require_size
from dvsviz.geometry.camera import Camera

_BLOCK_WORDS = 1 << 17
_DAT_BLOCK = 1 << 18
_MAX_HEADER = 1 << 16
# Event2d and EventCD, the two event types of DAT files that are changes of contrast.
_DAT_TYPES = (0x00, 0x0C)
_DAT_EVENT = np.dtype([("t", "<u4"), ("data", "<u4")])

Columns = tuple[NDArray[np.int64], NDArray, NDArray, NDArray[np.bool_]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """The text lines that start with `%` before the events.

    Attributes:
        end: bytes they take.
        encoding: `EVT2`, `EVT2.1`, `EVT3`, `DAT`, or None where it is none of these.
        size: sensor (width, height), or None where it is not recorded.
    """

    end: int
    encoding: str | None
    size: tuple[int, int] | None


def read_header(head: bytes) -> Header | None:
    """Return the header in the first bytes of a file, or None where there is none."""
    if not head.startswith(b"% "):
        return None
    at, lines = 0, []
    while head[at : at + 1] == b"%":
        end = head.find(b"\n", at, at + 4096)
        if end < 0:
            return None
        line = head[at + 1 : end].decode("ascii", errors="replace").strip()
        at = end + 1
        if line == "end":
            break
        lines.append(line)
    text = "\n".join(lines)
    return Header(end=at, encoding=_encoding(text), size=_size(text))


def _encoding(text: str) -> str | None:
    if found := re.search(r"^format\s+(EVT\d(?:\.\d)?|DAT\d?)", text, re.MULTILINE | re.IGNORECASE):
        name = found[1].upper()
        return {"EVT2.0": "EVT2", "EVT3.0": "EVT3", "EVT21": "EVT2.1", "DAT2": "DAT"}.get(name, name)
    if found := re.search(r"^evt\s+(\d(?:\.\d)?)", text, re.MULTILINE | re.IGNORECASE):
        return {"2": "EVT2", "2.0": "EVT2", "2.1": "EVT2.1", "3": "EVT3", "3.0": "EVT3"}.get(found[1])
    if re.search(r"data file containing .*events|^version\s+[12]\b", text, re.MULTILINE | re.IGNORECASE):
        return "DAT"
    return None


def _size(text: str) -> tuple[int, int] | None:
    found = re.search(r"geometry\s*[: ]\s*(\d{1,5})x(\d{1,5})", text, re.IGNORECASE)
    if found is None:
        width = re.search(r"width[=\s]+(\d{1,5})\b", text, re.IGNORECASE)
        height = re.search(r"height[=\s]+(\d{1,5})\b", text, re.IGNORECASE)
        size = None if width is None or height is None else (int(width[1]), int(height[1]))
    else:
        size = (int(found[1]), int(found[2]))
    return size if size is not None and min(size) >= 1 and max(size) <= 65_535 else None


def convert_prophesee(path: Path, header: Header, sink: RecordingSink) -> None:
    """Read a RAW or DAT file into a recording.

    Raises:
        FormatError: an encoding that is not known, a file cut short, or a sensor's size that is not known.
    """
    if header.encoding == "DAT":

        def blocks() -> Iterator[tuple[float, Columns]]:
            return _dat_blocks(path, header, sink)
    elif header.encoding in evt_kernel.DECODERS:
        encoding = header.encoding

        def blocks() -> Iterator[tuple[float, Columns]]:
            return _raw_blocks(path, header, encoding, sink)
    else:
        hint = "known are EVT2, EVT2.1, EVT3 and DAT"
        raise FormatError("the encoding is not named in the header", path=path, place="header", hint=hint)
    size = sink.options.size or header.size
    if size is None:
        max_x, max_y = 0, 0
        for _, (_t, x, y, _p) in blocks():
            if len(x):
                max_x, max_y = max(max_x, int(x.max())), max(max_y, int(y.max()))
        size = require_size(max_x, max_y, path)
        sink.warn(assumption(size))
    sink.start(Camera.guess(*size))
    for share, (t, x, y, p) in blocks():
        sink.add(t, x, y, p)
        sink.options.report(share)


class EvtDecoder:
    """Decodes the words of one stream, block after block.

    Args:
        encoding: a key of `evt_kernel.DECODERS`.
    """

    def __init__(self, encoding: str) -> None:
        self.word = evt_kernel.WORD_TYPES[encoding]
        self._decode = evt_kernel.DECODERS[encoding]
        self._per_word = evt_kernel.EVENTS_PER_WORD[encoding]
        self._state = np.zeros(evt_kernel.STATE_SIZE, np.int64)

    @property
    def skipped(self) -> int:
        """Events and vectors before the first time word, which have no time."""
        return int(self._state[evt_kernel.SKIPPED])

    def __call__(self, data: bytes) -> Columns:
        """Return t, x, y, is_positive of whole words; the columns may be longer-lived than the data."""
        words = np.frombuffer(data, self.word)
        n = len(words) * self._per_word
        t, x, y = np.empty(n, np.int64), np.empty(n, np.uint16), np.empty(n, np.uint16)
        p = np.empty(n, np.bool_)
        n = self._decode(words, self._state, t, x, y, p)
        return t[:n], x[:n], y[:n], p[:n]


def _raw_blocks(path: Path, header: Header, encoding: str, sink: RecordingSink) -> Iterator[tuple[float, Columns]]:
    decoder, total = EvtDecoder(encoding), path.stat().st_size
    with path.open("rb") as file:
        for data in _pieces(
            file, header.end, _BLOCK_WORDS * decoder.word.itemsize, decoder.word.itemsize, path, sink
        ):
            yield file.tell() / total, decoder(data)


def _dat_blocks(path: Path, header: Header, sink: RecordingSink) -> Iterator[tuple[float, Columns]]:
    total, last, wraps = path.stat().st_size, 0, 0
    with path.open("rb") as file:
        file.seek(header.end)
        kind = file.read(2)
        if len(kind) < 2 or kind[0] not in _DAT_TYPES or kind[1] != _DAT_EVENT.itemsize:
            found = " ".join(f"0x{byte:02x}" for byte in kind) or "nothing"
            hint = "only contrast events of 8 bytes (0x00 or 0x0c, 0x08) are known"
            raise FormatError(f"event type and size {found}", path=path, place=f"byte {header.end}", hint=hint)
        for data in _pieces(file, header.end + 2, _DAT_BLOCK * 8, 8, path, sink):
            rows = np.frombuffer(data, _DAT_EVENT)
            t = rows["t"].astype(np.int64)
            # Times are 32 bits: they wrap after 71 minutes.
            loops = np.cumsum(np.diff(t, prepend=last) < -(1 << 31)) + wraps
            last, wraps = int(t[-1]), int(loops[-1])
            word = rows["data"]
            x, y = (word & 0x3FFF).astype(np.uint16), ((word >> 14) & 0x3FFF).astype(np.uint16)
            yield file.tell() / total, (t + (loops << 32), x, y, (word >> 28) > 0)


def _pieces(file: BinaryIO, start: int, size: int, word: int, path: Path, sink: RecordingSink) -> Iterator[bytes]:
    """Yield the bytes after `start` in blocks of whole words."""
    file.seek(start)
    while data := file.read(size):
        if rest := len(data) % word:
            if not sink.options.repair:
                place = f"byte {file.tell() - rest}"
                hint = "copy it again, or read what is there with --repair"
                raise FormatError("cut short inside an event", path=path, place=place, hint=hint)
            sink.dropped(rest, "bytes of a last event that was cut short")
            data = data[:-rest]
        if data:
            yield data
