"""Reading an HDF5 file whose writer was killed or could not close it.

The file's superblock still says "open for writing", so that HDF5 refuses it but for SWMR readers. Those read a piece of
metadata whose checksum is wrong up to 100 times and sleep twice as long each time: a damaged file would hold the
reader for ever. As nobody writes the file any more, it is read as a finished one instead: through a view in which the
superblock's first bytes are those of a closed file. The file itself is not touched.

Superblock version 2 and 3 (HDF5 file format specification, II.A): signature (8 bytes), version, size of offsets, size
of lengths, consistency flags (1 byte each), base address, extension address, end of file, root address (8 each),
checksum (4).
"""

from __future__ import annotations

import io
import os
import struct
from pathlib import Path
from typing import Any, BinaryIO

_HEAD = 48
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_FLAGS_AT, _END_OF_FILE_AT, _CHECKSUM_AT = 11, 28, 44
_MASK = 0xFFFFFFFF


class ClosedView(io.RawIOBase):
    """A read-only file object over a killed writer's file, as if the writer had closed it."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            OSError: it cannot be read, or its superblock is not one of version 2 or 3 with 8-byte addresses.
        """
        self._file: BinaryIO = path.open("rb")
        self._size = os.fstat(self._file.fileno()).st_size
        self._position = 0
        head = self._file.read(_HEAD)
        if len(head) < _HEAD or head[:8] != _SIGNATURE or head[8] not in (2, 3) or head[9:11] != b"\x08\x08":
            self._file.close()
            raise OSError("the superblock is not one of a session file")
        patched = bytearray(head)
        patched[_FLAGS_AT] = 0
        # The end of the file may lag behind, or lie behind a cut: what is there is what counts.
        patched[_END_OF_FILE_AT : _END_OF_FILE_AT + 8] = struct.pack("<Q", self._size)
        patched[_CHECKSUM_AT:] = struct.pack("<I", lookup3(bytes(patched[:_CHECKSUM_AT])))
        self._head = bytes(patched)

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the position in bytes."""
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position and return it."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        self._position = max(0, start + offset)
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the position on and return how many bytes there were."""
        target = memoryview(buffer).cast("B")
        start = self._position
        self._file.seek(start)
        data = bytearray(self._file.read(len(target)))
        if start < _HEAD:
            end = min(_HEAD, start + len(data))
            data[: end - start] = self._head[start:end]
        target[: len(data)] = data
        self._position += len(data)
        return len(data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def lookup3(data: bytes) -> int:
    """Return the 32-bit checksum of HDF5's metadata: Bob Jenkins' lookup3 `hashlittle` with initial value 0."""
    a = b = c = (0xDEADBEEF + len(data)) & _MASK
    if not data:
        return c
    blocks = -(-len(data) // 12)
    words = struct.unpack(f"<{3 * blocks}I", data.ljust(12 * blocks, b"\0"))
    for i in range(0, len(words), 3):
        a, b, c = (a + words[i]) & _MASK, (b + words[i + 1]) & _MASK, (c + words[i + 2]) & _MASK
        if i + 3 < len(words):
            a, b, c = _mix(a, b, c)
    return _final(a, b, c)


def _turn(value: int, bits: int) -> int:
    return ((value << bits) | (value >> (32 - bits))) & _MASK


def _mix(a: int, b: int, c: int) -> tuple[int, int, int]:
    for bits in (4, 6, 8, 16, 19, 4):
        a = ((a - c) & _MASK) ^ _turn(c, bits)
        c = (c + b) & _MASK
        a, b, c = b, c, a
    return a, b, c


def _final(a: int, b: int, c: int) -> int:
    for bits in (14, 11, 25, 16, 4, 14, 24):
        c = ((c ^ b) - _turn(b, bits)) & _MASK
        a, b, c = b, c, a
    # Seven steps turn the names once more than a multiple of three: the last one written is now b.
    return b
