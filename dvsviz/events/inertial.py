"""Inertial measurements that cannot be right: they are told and not used, and what they lie beside is not lost."""

from __future__ import annotations

import numpy as np

from dvsviz.events.recording import Imu, Recording

# The widest range of small gyroscopes is 4,000 degrees/s.
MOST_RAD_S = 70.0
# So long before the first event or after the last one: streams of one clock may begin and end at other moments.
_ANOTHER_CLOCK_US = 1_000_000


def usable_imu(imu: Imu) -> tuple[Imu | None, tuple[str, ...]]:
    """Return the measurements that can be used, in order of time, None for nothing; and sentences about the others.

    Args:
        imu: as recorded: in any order, finite or not.
    """
    said: list[str] = []
    total, t_us, gyro, accel = len(imu.t_us), imu.t_us, imu.gyro, imu.accel
    finite = np.isfinite(gyro).all(axis=1)
    # Not a number is not above the limit.
    slow = ~(np.abs(gyro) > MOST_RAD_S).any(axis=1)
    for good, what in ((finite, "are no numbers"), (slow, f"turn faster than {MOST_RAD_S:g} rad/s")):
        count = total - int(np.count_nonzero(good))
        if count:
            said.append(f"imu: {count} of {total} rates {what} and are not used")
    if not (finite & slow).all():
        good = finite & slow
        t_us, gyro, accel = t_us[good], gyro[good], accel[good]
    if (t_us[1:] < t_us[:-1]).any():
        said.append("imu: its times run backwards and are sorted")
        order = np.argsort(t_us, kind="stable")
        t_us, gyro, accel = t_us[order], gyro[order], accel[order]
    if (t_us[1:] == t_us[:-1]).any():
        t_us, first = np.unique(t_us, return_index=True)
        gyro, accel = gyro[first], accel[first]
    if len(t_us) < 2:
        said.append(f"imu: not used, {len(t_us)} moments tell no motion")
        return None, tuple(said)
    return Imu(t_us=t_us, gyro=gyro, accel=accel), tuple(said)


def imu_warnings(recording: Recording) -> tuple[str, ...]:
    """Return sentences about the inertial measurements of a recording that cannot be used."""
    if recording.imu is None:
        return ()
    imu, said = usable_imu(recording.imu)
    if imu is None:
        return said
    apart_us = max(int(imu.t_us[0]) - recording.last_us, recording.first_us - int(imu.t_us[-1]))
    if apart_us <= _ANOTHER_CLOCK_US:
        return said
    return (*said, "imu: not used, its times are not those of the events: is it on another clock?")
