"""Small tables of text, `t` in seconds and then numbers: poses, inertial measurements, lists of frames."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import microseconds

_MAX_LINE = 10_000


def text_rows(file: BinaryIO, path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number, words) of each line that is neither empty nor a comment; commas part words too."""
    lines = io.BufferedReader(_Raw(file)) if not hasattr(file, "readline") else file
    number = 0
    while line := lines.readline(_MAX_LINE):
        number += 1
        if len(line) >= _MAX_LINE:
            raise FormatError(
                "not a text file of short lines", path=path, place=f"line {number}", hint="copy it again"
            )
        words = line.decode("utf-8", errors="replace").lstrip("\ufeff").replace(",", " ").split()
        if words and not words[0].startswith("#"):
            yield number, words


class _Raw(io.RawIOBase):
    def __init__(self, file: BinaryIO) -> None:
        self._inner = file

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        data = self._inner.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)


def read_table(
    file: BinaryIO, path: Path, names: str, *, repair: bool, increasing: bool
) -> tuple[NDArray[np.int64], NDArray[np.float64], int]:
    """Return times (N,) in microseconds, values (N, K), and how many lines were dropped.

    Args:
        file: what is read.
        path: named in errors.
        names: of all columns, the first being the time in seconds; in errors.
        repair: drop lines that are wrong instead of refusing the file.
        increasing: whether times must increase; else they may also repeat.

    Raises:
        FormatError: a line without so many finite numbers, or a time that runs backwards.
    """
    times: list[int] = []
    rows: list[list[float]] = []
    dropped = 0
    for number, words in text_rows(file, path):
        try:
            t, row = _row(words, names)
            if times and (t < times[-1] or (increasing and t == times[-1])):
                raise ValueError(f"time {words[0]} is not after the one before")
        except ValueError as error:
            if not repair:
                hint = "correct or remove the line, or drop it with --repair"
                raise FormatError(str(error), path=path, place=f"line {number}", hint=hint) from error
            dropped += 1
            continue
        times.append(t)
        rows.append(row)
    values = np.array(rows, np.float64).reshape(len(rows), len(names.split()) - 1)
    return np.array(times, np.int64), values, dropped


def _row(words: list[str], names: str) -> tuple[int, list[float]]:
    if len(words) != len(names.split()):
        raise ValueError(f"expected {len(names.split())} numbers `{names}`, got {len(words)}")
    try:
        t = microseconds(words[0])
        row = [float(word) for word in words[1:]]
    except ValueError as error:
        raise ValueError(f"not a number in `{' '.join(words)[:80]}`") from error
    if not np.all(np.isfinite(row)):
        raise ValueError(f"not a finite number in `{' '.join(words)[:80]}`")
    return t, row


def read_poses(file: BinaryIO, path: Path, *, repair: bool) -> tuple[Trajectory, int]:
    """Return the poses of `t px py pz qx qy qz qw` lines, and how many were dropped.

    Raises:
        FormatError: a line that is no pose, or a quaternion of length 0.
    """
    t, values, dropped = read_table(file, path, "t px py pz qx qy qz qw", repair=repair, increasing=True)
    q = se3.wxyz_from_xyzw(values[:, 3:])
    norm = np.linalg.norm(q, axis=1)
    wrong = np.abs(norm - 1) > 0.01
    if wrong.any():
        if not repair:
            i = int(np.argmax(wrong))
            message = f"the quaternion at {t[i]} us has length {norm[i]:.6g}"
            hint = "correct or remove the line, or drop it with --repair"
            raise FormatError(message, path=path, place=f"pose {i}", hint=hint)
        dropped += int(wrong.sum())
        t, values, q = t[~wrong], values[~wrong], q[~wrong]
    return Trajectory.from_quaternions(t, values[:, :3], q), dropped
