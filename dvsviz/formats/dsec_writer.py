"""Writing of events in DSEC's HDF5 layout: `events/{t,x,y,p}`, `ms_to_idx`, `t_offset`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dvsviz.errors import FormatError
from dvsviz.events.recording import Recording

_MAX_US = 2**32


def write_dsec(recording: Recording, out: Path) -> None:
    """Write the events of a recording; times are 32-bit microseconds after `t_offset`.

    The layout holds neither calibration, poses nor frames; DSEC keeps those in other files.

    Raises:
        FormatError: the recording is longer than 32 bits of microseconds (71 minutes), or the file cannot be made.
    """
    first_us, span_us = recording.first_us, recording.last_us - recording.first_us
    if span_us >= _MAX_US:
        hint = "convert parts of it with --start and --end"
        raise FormatError("longer than 71 minutes, which DSEC's times cannot hold", path=out, hint=hint)
    partial = out.with_name(f".{out.name}.part")
    try:
        with h5py.File(partial, "w") as file:
            group = file.create_group("events")
            kinds = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}
            n = recording.events.count
            stored: Any = {"chunks": (min(n, 1 << 16),), "compression": "gzip", "shuffle": True}
            columns = {name: group.create_dataset(name, (n,), kind, **stored) for name, kind in kinds.items()}
            file["t_offset"] = np.int64(first_us)
            # As in DSEC, the k-th entry is the first event at or after the k-th millisecond.
            index = np.zeros(span_us // 1000 + 1, np.uint64)
            at, next_ms = 0, 0
            for events in recording.chunks():
                end, t = at + len(events), events.t_us - first_us
                columns["t"][at:end], columns["x"][at:end], columns["y"][at:end] = t, events.x_px, events.y_px
                columns["p"][at:end] = events.is_positive
                last_ms = int(t[-1]) // 1000 + 1
                marks = 1000 * np.arange(next_ms, last_ms)
                index[next_ms:last_ms] = at + np.searchsorted(t, marks)
                at, next_ms = end, last_ms
            file["ms_to_idx"] = index
            file.attrs.update(width=recording.camera.width, height=recording.camera.height)
        partial.replace(out)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise FormatError(f"cannot be written ({error})", path=out, hint="choose another folder") from error
