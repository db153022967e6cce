"""Event windows: closed by count or by time, every event in exactly one of them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvsviz.events.events import Events
from dvsviz.events.recording import MemoryEvents, Recording
from dvsviz.events.windows import MAX_WINDOW_US, make_window, read_window, windows
from dvsviz.geometry.camera import Camera

CAMERA = Camera(width=24, height=10, fx=20.0, fy=15.0, cx=11.0, cy=5.0, distortion=(-0.2, 0.05, 0.001, -0.002, 0.0))
UNIX_US = 1_700_000_000_000_000


def recording(t_us: list[int] | np.ndarray) -> Recording:
    n = len(t_us)
    rng = np.random.default_rng(9)
    events = Events(
        t_us=np.asarray(t_us, dtype=np.int64),
        x_px=rng.integers(0, 24, n).astype(np.uint16),
        y_px=rng.integers(0, 10, n).astype(np.uint16),
        is_positive=rng.integers(0, 2, n).astype(bool),
    )
    for column in (events.t_us, events.x_px, events.y_px, events.is_positive):
        column.setflags(write=False)
    return Recording(path=Path("r.h5"), name="r", format="memory", camera=CAMERA, events=MemoryEvents(events))


@pytest.mark.parametrize("start", [0, UNIX_US])
def test_closed_by_count(start: int) -> None:
    got = list(windows(recording(start + np.arange(25) * 10), 10))
    assert [len(w) for w in got] == [10, 10, 5]
    assert [w.index for w in got] == [0, 1, 2]
    assert [(w.first_event, w.end_event) for w in got] == [(0, 10), (10, 20), (20, 25)]
    assert [(w.start_us - start, w.end_us - start) for w in got] == [(0, 100), (100, 200), (200, 241)]
    assert got[1].duration_s == pytest.approx(1e-4, abs=1e-15)
    np.testing.assert_allclose(got[2].t_s, np.arange(5) * 1e-5, atol=1e-15)


def test_closed_by_time_even_where_more_events_were_wanted() -> None:
    got = list(windows(recording(np.arange(25) * 10), 1000, max_duration_us=100))
    assert [len(w) for w in got] == [10, 10, 5]
    assert [(w.start_us, w.end_us) for w in got] == [(0, 100), (100, 200), (200, 241)]


def test_an_event_exactly_at_the_limit_starts_the_next_window() -> None:
    got = list(windows(recording([0, 99, 100, 150]), 1000, max_duration_us=100))
    assert [(w.first_event, w.end_event) for w in got] == [(0, 2), (2, 4)]


def test_a_gap_longer_than_the_limit_makes_no_empty_window() -> None:
    got = list(windows(recording([0, 50, 5_000_000, 5_000_001]), 1000))
    assert [len(w) for w in got] == [2, 2]
    assert (got[0].start_us, got[0].end_us) == (0, MAX_WINDOW_US)
    assert got[1].start_us == 5_000_000


def test_one_event_and_no_event() -> None:
    (only,) = windows(recording([UNIX_US]), 100)
    assert (len(only), only.start_us, only.end_us) == (1, UNIX_US, UNIX_US + 1)
    np.testing.assert_array_equal(only.t_s, [0.0])
    assert list(windows(recording([]), 100)) == []


def test_the_size_is_asked_before_each_window() -> None:
    sizes = iter([1, 2, 3, 100, 100])
    got = list(windows(recording(np.arange(20)), lambda: next(sizes)))
    assert [len(w) for w in got] == [1, 2, 3, 14]


def test_starting_in_the_middle_gives_the_same_windows() -> None:
    rec = recording(np.arange(50) * 7)
    everything = list(windows(rec, 8))
    rest = list(windows(rec, 8, first_event=everything[3].first_event, index=3))
    for a, b in zip(everything[3:], rest, strict=True):
        assert (a.index, a.first_event, a.start_us, a.end_us) == (b.index, b.first_event, b.start_us, b.end_us)
        np.testing.assert_array_equal(a.bearings, b.bearings)


@given(
    st.lists(st.integers(0, 400), min_size=1, max_size=120),
    st.integers(1, 40),
    st.integers(1, 900),
    st.sampled_from([0, -(10**6), UNIX_US]),
)
def test_windows_cover_every_event_exactly_once(steps: list[int], count: int, limit: int, start: int) -> None:
    rec = recording(start + np.cumsum(steps))
    everything = rec.events.read(0, rec.events.count)
    got = list(windows(rec, count, max_duration_us=limit))
    for name in ("t_us", "x_px", "y_px", "is_positive"):
        joined = np.concatenate([getattr(w.events, name) for w in got])
        np.testing.assert_array_equal(joined, getattr(everything, name))
    for k, w in enumerate(got):
        assert w.index == k
        assert 1 <= len(w) <= count
        assert w.start_us == w.events.t_us[0]
        # Events with one time stamp may be split between windows: then `end_us` is that time.
        assert w.start_us <= int(w.events.t_us[-1]) <= w.end_us <= w.start_us + limit
    for a, b in pairwise(got):
        assert a.end_event == b.first_event
        assert a.end_us <= b.start_us
        full = len(a) == count
        assert a.end_us == (min(b.start_us, a.start_us + limit) if full else a.start_us + limit)


def test_bearings_are_those_of_the_pixels() -> None:
    (window,) = windows(recording(np.arange(30)), 100)
    pixels = np.column_stack([window.events.x_px, window.events.y_px]).astype(np.float64)
    np.testing.assert_allclose(window.bearings, CAMERA.bearings(pixels), atol=1e-7)
    assert window.bearings.dtype == np.float32


def test_impossible_windows_are_refused() -> None:
    rec = recording([0, 1, 2])
    with pytest.raises(ValueError, match="count: expected at least 1"):
        read_window(rec, index=0, first_event=0, count=0)
    with pytest.raises(ValueError, match="at least one event"):
        make_window(CAMERA, Events.empty())
    small = Camera(width=3, height=10, fx=1.0, fy=1.0, cx=1.0, cy=1.0)
    with pytest.raises(ValueError, match="inside 3x10"):
        make_window(small, recording(np.arange(40)).events.read(0, 40))
    assert read_window(rec, index=0, first_event=3, count=5) is None
