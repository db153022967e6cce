"""What a recording holds: the object that `dvsviz info --json` prints."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.events.filters import count_pixels, hot_pixels
from dvsviz.events.recording import Recording
from dvsviz.formats.open import open_recording
from dvsviz.formats.sink import OUT_OF_ORDER

RATE_BINS = 60
# Shorter pauses are common in slow scenes; the tracker ends its windows after this time too.
GAP_US = 100_000
_SHOWN_HOT = 8
_BARS = "▁▂▃▄▅▆▇█"


def describe(path: Path, **options: Any) -> dict[str, Any]:
    """Return what the recording at a path holds, as plain numbers, texts and lists.

    Keys: `format, name, path, events, duration_s, width, height, rate_hz, peak_rate_hz, first_us, last_us,
    positive_share, streams, triggers` (how many of each kind), `calibrated, camera, rate_over_time_hz` (60 equal
    parts of the duration), `sparkline, gaps, longest_gap_s` (pauses of at least 100 ms), `duplicates` (events that
    repeat time, pixel and polarity of the one before them on that pixel), `hot_pixels, hot_share, hot_pixels_at` (x,
    y, events of the loudest eight), `out_of_order` (events that `repair` dropped for it; without repair such a file
    is refused), `filters, events_before_filters, warnings`.

    Args:
        path: the recording.
        options: as of `open_recording`.

    Raises:
        FormatError: the recording cannot be read.
    """
    return describe_recording(open_recording(Path(path), **options))


def describe_recording(recording: Recording) -> dict[str, Any]:
    """Return what an opened recording holds (see `describe`); all its events are read once, in chunks."""
    camera = recording.camera
    first_us, last_us = recording.first_us, recording.last_us
    span_us = max(1, last_us - first_us)
    counts = np.zeros((camera.height, camera.width), np.int64)
    bins = np.zeros(RATE_BINS, np.int64)
    # Time of each pixel's last event, by polarity: an event at the same time is a duplicate.
    last = np.full((2, camera.height, camera.width), -(2**62), np.int64)
    totals = np.zeros(4, np.int64)
    before_us = first_us
    for events in recording.chunks():
        count_pixels(counts, events)
        _scan(
            events.t_us,
            events.x_px,
            events.y_px,
            events.is_positive,
            before_us,
            first_us,
            span_us,
            bins,
            last,
            totals,
        )
        before_us = int(events.t_us[-1])
    n = recording.events.count
    positive, duplicates, gaps, longest_gap_us = (int(total) for total in totals)
    hot = hot_pixels(counts)
    rates = np.asarray(bins * (RATE_BINS * 1e6 / span_us), np.float64)
    frames, truth, imu = recording.frames, recording.ground_truth, recording.imu
    return {
        "format": recording.format,
        "name": recording.name,
        "path": str(recording.path),
        "events": n,
        "duration_s": recording.duration_s,
        "width": camera.width,
        "height": camera.height,
        "rate_hz": n * 1e6 / span_us,
        "peak_rate_hz": float(rates.max()),
        "first_us": first_us,
        "last_us": last_us,
        "positive_share": positive / max(1, n),
        "streams": {
            "events": n,
            "ground_truth": 0 if truth is None else len(truth),
            "imu": 0 if imu is None else len(imu.t_us),
            "frames": 0 if frames is None else len(frames.t_us),
            "triggers": sum(recording.triggers.values()),
        },
        "triggers": recording.triggers,
        "calibrated": not camera.is_guess,
        "camera": {
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "distortion": list(camera.distortion),
        },
        "rate_over_time_hz": [float(rate) for rate in rates],
        "sparkline": sparkline(rates),
        "gaps": gaps,
        "longest_gap_s": longest_gap_us * 1e-6,
        "duplicates": duplicates,
        "hot_pixels": int(np.count_nonzero(hot)),
        "hot_share": float(counts[hot].sum() / max(1, n)),
        "hot_pixels_at": [[int(x), int(y), int(counts[y, x])] for y, x in _loudest(counts, hot)],
        "out_of_order": _out_of_order(recording.warnings),
        "filters": None if recording.filters is None else asdict(recording.filters),
        "events_before_filters": recording.events_before_filters,
        "warnings": list(recording.warnings),
    }


def _out_of_order(warnings: tuple[str, ...]) -> int:
    """Return how many events were dropped on reading for a time that ran backwards."""
    for warning in warnings:
        if found := re.search(rf"(\d+) events?{OUT_OF_ORDER.removeprefix('events')}", warning):
            return int(found[1])
    return 0


def _loudest(counts: NDArray[np.int64], hot: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return row and column (N, 2) of the hot pixels that fire most, the loudest first."""
    at = np.argwhere(hot)
    return at[np.argsort(-counts[hot], kind="stable")][:_SHOWN_HOT]


def sparkline(values: NDArray[np.float64]) -> str:
    """Return one block character a value, eight heights from 0 to the largest value."""
    top = float(np.max(values, initial=0.0))
    if top <= 0:
        return _BARS[0] * len(values)
    levels = np.minimum(len(_BARS) - 1, values / top * len(_BARS)).astype(int)
    return "".join(_BARS[level] for level in levels)


@numba.njit(cache=True, nogil=True)
def _scan(t_us, x_px, y_px, is_positive, before_us, first_us, span_us, bins, last, totals):
    n_bins = len(bins)
    for i in range(len(t_us)):
        t, p = t_us[i], np.int64(is_positive[i])
        bins[min(n_bins - 1, np.int64((t - first_us) / span_us * n_bins))] += 1
        totals[0] += p
        if last[p, y_px[i], x_px[i]] == t:
            totals[1] += 1
        last[p, y_px[i], x_px[i]] = t
        gap = t - before_us
        if gap >= GAP_US:
            totals[2] += 1
        if gap > totals[3]:
            totals[3] = gap
        before_us = t
