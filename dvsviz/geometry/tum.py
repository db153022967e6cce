"""TUM trajectory files: `t px py pz qx qy qz qw` a line, seconds, metres, quaternions xyzw.

Times cross as text, never as floating point: a 64-bit float of Unix seconds (1.7e9) has steps of 0.24 us.
"""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from dvsviz.errors import FormatError
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory

_COLUMNS = "t px py pz qx qy qz qw"
# int64 microseconds end in the year 294247: a time beyond is a typing error or another unit.
_MAX_US = 2**63 - 1
_MAX_DIGITS = 40
# A quaternion shorter or longer than this is not a rounded unit quaternion.
_NORM_TOLERANCE = 0.01


def read_tum(path: Path, *, repair: bool = False, warnings: list[str] | None = None) -> Trajectory:
    """Return the trajectory of a TUM file; poses are `T_world_camera`, times exact to the microsecond.

    Empty lines and lines that start with `#` are skipped; numbers are parted by blanks or commas.

    Args:
        path: the file.
        repair: drop poses whose time is not after the one before instead of refusing them (files of public
            benchmarks hold a few doubles).
        warnings: gets one sentence about what was dropped.

    Raises:
        FormatError: no such file, a line without eight finite numbers, a quaternion that is not a unit quaternion,
            or times that do not increase; it names the line.
    """
    t_us: list[int] = []
    rows: list[list[float]] = []
    dropped = 0
    try:
        with path.open(encoding="utf-8") as lines:
            for number, line in enumerate(lines, start=1):
                words = line.replace(",", " ").split()
                if not words or words[0].startswith("#"):
                    continue
                t, row = _parse(words, path, f"line {number}")
                if t_us and t <= t_us[-1]:
                    dropped += 1
                    if repair:
                        continue
                    raise FormatError(
                        f"time {words[0]} is not after the one before",
                        path=path,
                        place=f"line {number}",
                        hint="sort the poses by time, or drop such poses with --repair",
                    )
                t_us.append(t)
                rows.append(row)
    except UnicodeDecodeError as error:
        raise FormatError("not a text file", path=path, hint=f"expected lines of `{_COLUMNS}`") from error
    except OSError as error:
        raise FormatError(f"cannot be read: {error.strerror}", path=path, hint="check the path") from error
    if not rows:
        raise FormatError("holds no poses", path=path, hint=f"expected lines of `{_COLUMNS}`")
    if dropped and warnings is not None:
        warnings.append(
            f"{path.name}: {dropped} of {len(rows) + dropped} poses dropped, their times do not increase"
        )
    values = np.array(rows, dtype=np.float64)
    return Trajectory.from_quaternions(
        np.array(t_us, dtype=np.int64), values[:, :3], se3.wxyz_from_xyzw(values[:, 3:])
    )


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a TUM file, times with six decimals, all of them exact.

    The file is written under a temporary name and renamed, so that it is whole or absent.

    Raises:
        FormatError: the file cannot be written.
    """
    numbers = np.concatenate([trajectory.positions, se3.xyzw_from_wxyz(trajectory.quaternions_wxyz)], axis=-1)
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("w", encoding="utf-8", newline="\n") as out:
            for t, row in zip(trajectory.t_us.tolist(), numbers.tolist(), strict=True):
                out.write(f"{seconds_text(t)} {' '.join(f'{value:.9f}' for value in row)}\n")
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise FormatError(
            f"cannot be written: {error.strerror}", path=path, hint="check the folder and the free space"
        ) from error


def seconds_text(t_us: int) -> str:
    """Return integer microseconds as seconds with six decimals, exact: 1700000000000001 gives 1700000000.000001."""
    sign, value = ("-", -t_us) if t_us < 0 else ("", t_us)
    return f"{sign}{value // 1_000_000}.{value % 1_000_000:06d}"


def microseconds(text: str) -> int:
    """Return seconds written as decimal text as integer microseconds, rounded half to even.

    Raises:
        ValueError: the text is not a finite number or beyond int64 microseconds.
    """
    if len(text) > _MAX_DIGITS:
        raise ValueError(f"time: expected at most {_MAX_DIGITS} characters, got {len(text)}")
    try:
        value = Decimal(text)
        if not value.is_finite() or abs(value) > _MAX_US // 1_000_000:
            raise ValueError(f"time: expected finite seconds, got {text!r}")
        return int((value * 1_000_000).to_integral_value())
    except InvalidOperation as error:
        raise ValueError(f"time: expected a number, got {text!r}") from error


def _parse(words: list[str], path: Path, place: str) -> tuple[int, list[float]]:
    if len(words) != 8:
        raise FormatError(
            f"expected 8 numbers, got {len(words)}", path=path, place=place, hint=f"a line is `{_COLUMNS}`"
        )
    try:
        t_us = microseconds(words[0])
        row = [float(word) for word in words[1:]]
    except ValueError as error:
        raise FormatError(
            f"not a number in {' '.join(words)!r:.80}", path=path, place=place, hint=f"a line is `{_COLUMNS}`"
        ) from error
    if not np.all(np.isfinite(row)):
        raise FormatError("the pose is not finite", path=path, place=place, hint="remove the line")
    norm = float(np.linalg.norm(row[3:]))
    if abs(norm - 1) > _NORM_TOLERANCE:
        raise FormatError(
            f"the quaternion has length {norm:.6g}",
            path=path,
            place=place,
            hint=f"expected a unit quaternion in the order of `{_COLUMNS}`",
        )
    return t_us, row
