"""The chain of packets of an AEDAT4 file, walked before the library reads it.

dv-processing decompresses without end where a compressed packet breaks off early, as it does in a file that lost some
bytes: so it is given only files whose packets and whose frames of compressed blocks are whole.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO, NoReturn

from dvsviz.errors import FormatError

_MAX_HEADER = 1 << 24
_LZ4_MAGIC, _ZSTD_MAGIC = 0x184D2204, 0xFD2FB528
_NONE, _LZ4, _LZ4_HIGH, _ZSTD, _ZSTD_HIGH = range(5)


def check_packets(path: Path) -> None:
    """Check that the packets lead from the header to the end, or to the table of packets, and that each is whole.

    Raises:
        FormatError: with the byte at which the file is damaged or cut short.
    """
    total = path.stat().st_size
    with path.open("rb") as file:
        file.readline(64)
        compression, table = _header(file, path)
        at = file.tell()
        end = table if table >= 0 else total
        if not at <= end <= total:
            _refuse(path, at, "the table of packets lies outside the file")
        while at < end:
            head = file.read(8)
            size = struct.unpack("<ii", head)[1] if len(head) == 8 else -1
            if size < 0 or at + 8 + size > end:
                _refuse(path, at, "a packet is damaged or cut short")
            _check_frame(file, size, compression, path)
            at = file.seek(at + 8 + size)
        if table >= 0:
            _check_frame(file, total - table, compression, path)


def _header(file: BinaryIO, path: Path) -> tuple[int, int]:
    """Return (compression, position of the table of packets or -1) of the flatbuffer that starts the file."""
    start = file.tell()
    try:
        (size,) = struct.unpack("<I", file.read(4))
        if not 8 <= size <= _MAX_HEADER:
            raise ValueError(f"{size} bytes")
        data = file.read(size)
        if len(data) < size:
            raise ValueError("cut short")
        (root,) = struct.unpack_from("<I", data, 0)
        (back,) = struct.unpack_from("<i", data, root)
        vtable = root - back
        if vtable < 0:
            raise ValueError("no table")
        (length,) = struct.unpack_from("<H", data, vtable)
        offsets = [
            struct.unpack_from("<H", data, vtable + 4 + 2 * k)[0] if length >= 6 + 2 * k else 0 for k in (0, 1)
        ]
        compression = struct.unpack_from("<i", data, root + offsets[0])[0] if offsets[0] else _NONE
        table = struct.unpack_from("<q", data, root + offsets[1])[0] if offsets[1] else -1
    except (struct.error, ValueError):
        _refuse(path, start, "the header is damaged or cut short")
    return compression, table


def _check_frame(file: BinaryIO, size: int, compression: int, path: Path) -> None:
    """Check that the compressed blocks at the file's position end where the packet ends."""
    at = file.tell()
    if compression in (_LZ4, _LZ4_HIGH):
        whole = _lz4_end(file, at + size) == at + size
    elif compression in (_ZSTD, _ZSTD_HIGH):
        whole = _zstd_end(file, at + size) == at + size
    else:
        return
    if not whole:
        _refuse(path, at, "a packet is damaged or cut short")


def _lz4_end(file: BinaryIO, end: int) -> int:
    """Return where an LZ4 frame ends, -1 where it does not end before `end`."""
    head = file.read(7)
    if len(head) < 7 or struct.unpack_from("<I", head)[0] != _LZ4_MAGIC:
        return -1
    flags = head[4]
    file.seek((8 if flags & 0x08 else 0) + (4 if flags & 0x01 else 0), 1)
    block_checksum, content_checksum = (4 if flags & 0x10 else 0), (4 if flags & 0x04 else 0)
    while file.tell() + 4 <= end:
        word = file.read(4)
        if len(word) < 4:
            return -1
        block = struct.unpack("<I", word)[0]
        if block == 0:
            return file.seek(content_checksum, 1)
        file.seek((block & 0x7FFFFFFF) + block_checksum, 1)
    return -1


def _zstd_end(file: BinaryIO, end: int) -> int:
    """Return where a zstd frame ends, -1 where it does not end before `end`."""
    head = file.read(5)
    if len(head) < 5 or struct.unpack_from("<I", head)[0] != _ZSTD_MAGIC:
        return -1
    flags = head[4]
    single = bool(flags & 0x20)
    content = (1 if single else 0, 2, 4, 8)[flags >> 6]
    file.seek((0 if single else 1) + (0, 1, 2, 4)[flags & 3] + content, 1)
    while file.tell() + 3 <= end:
        word = file.read(3)
        if len(word) < 3:
            return -1
        block = int.from_bytes(word, "little")
        # A run of one byte is stored as that byte; its size is the length of the run.
        file.seek(1 if (block >> 1) & 3 == 1 else block >> 3, 1)
        if block & 1:
            return file.seek(4 if flags & 0x04 else 0, 1)
    return -1


def _refuse(path: Path, at: int, message: str) -> NoReturn:
    raise FormatError(message, path=path, place=f"byte {at}", hint="copy it again")
