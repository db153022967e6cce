"""The chain of packets of an AEDAT4 file, walked and unpacked before the library reads it.

dv-processing decompresses without end where a compressed packet is damaged or breaks off early: so it is given only
files whose packets are whole, or a copy of those that are.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from dvsviz.errors import FormatError

_MAX_HEADER = 1 << 24
_MAX_PACKET = 256 << 20
# What so few bytes unpack to fits into memory, whatever they are.
_BLOCK = 1 << 12
_COPIED = 1 << 20
_NONE, _LZ4, _LZ4_HIGH, _ZSTD, _ZSTD_HIGH = range(5)
_NO_TABLE = struct.pack("<q", -1)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Header:
    """What the flatbuffer at the file's start says.

    Attributes:
        compression: of every packet.
        table: position of the table of packets; -1 where there is none.
        table_at: where that position is stored; -1 where it is not.
        end: first byte of the first packet.
    """

    compression: int
    table: int
    table_at: int
    end: int


def check_packets(path: Path) -> None:
    """Check that the packets lead from the header to the end, or to the table of packets, and that each unpacks.

    Raises:
        FormatError: with the byte at which the file is damaged or cut short.
    """
    total = path.stat().st_size
    with path.open("rb") as file:
        header = _header(file, path)
        end = header.table if header.table >= 0 else total
        if not header.end <= end <= total:
            _refuse(path, header.end, "cut short: the table of packets is missing")
        at = header.end
        while at < end:
            size = _size(file, at, end)
            if size < 0 or not _unpacks(file, at + 8, size, header.compression):
                _refuse(path, at, "a packet is damaged or cut short")
            at += 8 + size
        if header.table >= 0 and not _unpacks(file, end, total - end, header.compression):
            _refuse(path, end, "the table of packets is damaged")


def copy_whole_packets(path: Path, out: Path) -> tuple[int, int]:
    """Write a file of the packets that are whole and return how many were left out, and how many bytes at the end.

    Raises:
        FormatError: the header is damaged.
    """
    total, dropped = path.stat().st_size, 0
    with path.open("rb") as file, out.open("wb") as copy:
        header = _header(file, path)
        end = header.table if header.end <= header.table <= total else total
        file.seek(0)
        copy.write(file.read(header.end))
        at = header.end
        while at < end and (size := _size(file, at, end)) >= 0:
            if _unpacks(file, at + 8, size, header.compression):
                _copy(file, at, 8 + size, copy)
            else:
                dropped += 1
            at += 8 + size
        if header.table_at >= 0:
            # The library then looks for the packets itself.
            copy.seek(header.table_at)
            copy.write(_NO_TABLE)
    return dropped, end - at


def _copy(file: BinaryIO, at: int, size: int, copy: BinaryIO) -> None:
    file.seek(at)
    for left in range(size, 0, -_COPIED):
        copy.write(file.read(min(left, _COPIED)))


def _size(file: BinaryIO, at: int, end: int) -> int:
    """Return the size of the packet at a position, -1 where it is not whole."""
    file.seek(at)
    head = file.read(8)
    size = struct.unpack("<ii", head)[1] if len(head) == 8 else -1
    return size if size >= 0 and at + 8 + size <= end else -1


def _header(file: BinaryIO, path: Path) -> _Header:
    file.readline(64)
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
    at = start + 4 + root + offsets[1] if offsets[1] else -1
    return _Header(compression=compression, table=table, table_at=at, end=start + 4 + size)


def _unpacks(file: BinaryIO, at: int, size: int, compression: int) -> bool:
    """Tell whether a packet's compressed bytes unpack, to the last one and to no absurd size."""
    # Needed for this format alone.
    import lz4.frame
    import zstandard

    if compression in (_LZ4, _LZ4_HIGH):
        unpacker: Any = lz4.frame.LZ4FrameDecompressor()
    elif compression in (_ZSTD, _ZSTD_HIGH):
        unpacker = zstandard.ZstdDecompressor(max_window_size=_MAX_PACKET).decompressobj()
    else:
        return True
    file.seek(at)
    left, unpacked = size, 0
    try:
        while left > 0 and not unpacker.eof:
            data = file.read(min(left, _BLOCK))
            left -= len(data)
            unpacked += len(unpacker.decompress(data))
            if unpacked > _MAX_PACKET or not data:
                return False
    except (RuntimeError, EOFError, zstandard.ZstdError):
        return False
    return bool(unpacker.eof) and left == 0 and not unpacker.unused_data


def _refuse(path: Path, at: int, message: str) -> NoReturn:
    hint = "copy it again, or read what is there with --repair"
    raise FormatError(message, path=path, place=f"byte {at}", hint=hint)
