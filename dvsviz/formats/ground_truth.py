"""True poses from a file beside the events: TUM and Event-Camera-Dataset text, or EuRoC CSV, told by content."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dvsviz.errors import FormatError
from dvsviz.formats.tables import text_rows
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import read_tum

_EUROC = "timestamp [ns], p x y z [m], q w x y z"
# Seconds since 1970 have ten digits, nanoseconds nineteen; a recording's own nanoseconds have seven from 10 ms on.
_NANOSECOND_DIGITS = 15
_MAX_OFFSET_S = 1e12


def read_ground_truth(path: Path, *, offset_s: float = 0.0, repair: bool = False) -> Trajectory:
    """Return the true poses `T_world_camera` of a file.

    Args:
        path: lines of `t px py pz qx qy qz qw` (seconds), or EuRoC's CSV (nanoseconds, quaternion w first; further
            columns are left aside).
        offset_s: seconds to add to the file's times to get the recording's.
        repair: drop poses whose time is not after the one before instead of refusing them.

    Raises:
        FormatError: no such file, or a line that is no pose; it names the line.
    """
    path = Path(path)
    if not np.isfinite(offset_s) or abs(offset_s) > _MAX_OFFSET_S:
        raise FormatError(f"an offset of {offset_s} s", place="--gt-offset", hint="expected finite seconds")
    truth = _read_euroc(path, repair=repair) if _is_euroc(path) else read_tum(path, repair=repair)
    return replace(truth, t_us=truth.t_us + round(offset_s * 1e6))


def _is_euroc(path: Path) -> bool:
    """Tell whether the first line of numbers is parted by commas and starts with whole nanoseconds."""
    if not path.is_file():
        return False  # the reader of text says so
    with path.open("rb") as file:
        head = file.read(1 << 16)
    for line in head.decode("utf-8", errors="replace").splitlines():
        if line.strip() and not line.startswith("#"):
            first = line.split(",")[0].strip()
            return "," in line and first.isdigit() and (len(first) >= _NANOSECOND_DIGITS or b"[ns]" in head)
    return False


def _read_euroc(path: Path, *, repair: bool) -> Trajectory:
    times: list[int] = []
    rows: list[list[float]] = []
    with path.open("rb") as file:
        for number, words in text_rows(file, path):
            try:
                if len(words) < 8:
                    raise ValueError(f"expected at least 8 columns, got {len(words)}")
                # Half a microsecond up, as everywhere that nanoseconds are read.
                t_us, row = (int(words[0]) + 500) // 1000, [float(word) for word in words[1:8]]
                if not np.all(np.isfinite(row)) or abs(np.linalg.norm(row[3:]) - 1) > 0.01:
                    raise ValueError("the pose is not finite, or its quaternion has not length 1")
                if times and t_us <= times[-1]:
                    raise ValueError("its time is not after the one before")
            except ValueError as error:
                if repair:
                    continue
                hint = f"a line is `{_EUROC}`; drop wrong ones with --repair"
                raise FormatError(str(error), path=path, place=f"line {number}", hint=hint) from error
            times.append(t_us)
            rows.append(row)
    if not rows:
        raise FormatError("holds no poses", path=path, hint=f"expected lines of `{_EUROC}`")
    values = np.array(rows, np.float64)
    return Trajectory.from_quaternions(np.array(times, np.int64), values[:, :3], values[:, 3:])
