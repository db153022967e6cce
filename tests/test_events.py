"""Events and recordings: validation, slicing, the in-memory source, first and last times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvsviz.events.events import Events
from dvsviz.events.recording import MemoryEvents, Recording
from dvsviz.geometry.camera import Camera


def make_events(t_us: np.ndarray) -> Events:
    n = len(t_us)
    events = Events(
        t_us=np.asarray(t_us, dtype=np.int64),
        x_px=(np.arange(n) % 7).astype(np.uint16),
        y_px=(np.arange(n) % 5).astype(np.uint16),
        is_positive=np.arange(n) % 2 == 0,
    )
    for column in (events.t_us, events.x_px, events.y_px, events.is_positive):
        column.setflags(write=False)
    return events


def make_recording(events: Events) -> Recording:
    camera = Camera(width=7, height=5, fx=6.0, fy=5.0, cx=3.0, cy=2.0)
    return Recording(path=Path("r.h5"), name="r", format="memory", camera=camera, events=MemoryEvents(events))


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("t_us", np.zeros(3, np.float64)),
        ("t_us", np.zeros((3, 1), np.int64)),
        ("x_px", np.zeros(2, np.uint16)),
        ("x_px", np.zeros(3, np.int16)),
        ("y_px", np.zeros(3, np.int64)),
        ("is_positive", np.zeros(3, np.uint8)),
        ("is_positive", np.zeros(4, np.bool_)),
    ],
)
def test_columns_of_wrong_shape_or_type_are_refused(column: str, values: np.ndarray) -> None:
    columns = {
        "t_us": np.zeros(3, np.int64),
        "x_px": np.zeros(3, np.uint16),
        "y_px": np.zeros(3, np.uint16),
        "is_positive": np.zeros(3, np.bool_),
    }
    assert len(Events(**columns)) == 3  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="expected"):
        Events(**(columns | {column: values}))  # pyright: ignore[reportArgumentType]


def test_slices_are_views_and_empty_is_empty() -> None:
    events = make_events(np.arange(10) * 100)
    part = events[2:5]
    assert len(part) == 3
    assert part.t_us.base is events.t_us
    np.testing.assert_array_equal(part.x_px, [2, 3, 4])
    assert len(Events.empty()) == 0


def test_events_are_frozen() -> None:
    with pytest.raises(AttributeError):
        make_events(np.arange(3)).t_us = np.zeros(3)  # pyright: ignore[reportAttributeAccessIssue]


@given(st.lists(st.integers(0, 50), max_size=40).map(sorted), st.integers(-5, 60), st.integers(-5, 60))
def test_memory_source_equals_the_slow_definition(times: list[int], first: int, end: int) -> None:
    source = MemoryEvents(make_events(np.array(times, dtype=np.int64)))
    assert source.count == len(times)
    expected = [t for i, t in enumerate(times) if first <= i < end]
    np.testing.assert_array_equal(source.read(first, end).t_us, expected)
    later = [i for i, t in enumerate(times) if t >= first]
    assert source.index_at(first) == (later[0] if later else len(times))


def test_recording_knows_its_times() -> None:
    start = 1_700_000_000_000_000
    recording = make_recording(make_events(start + np.arange(2501) * 1000))
    assert (recording.first_us, recording.last_us) == (start, start + 2_500_000)
    assert recording.duration_s == pytest.approx(2.5, abs=1e-12)
    chunks = list(recording.chunks(1000))
    assert [len(chunk) for chunk in chunks] == [1000, 1000, 501]
    assert int(chunks[1].t_us[0]) == start + 1_000_000
    nothing = make_recording(Events.empty())
    assert (nothing.first_us, nothing.last_us, nothing.duration_s) == (0, 0, 0.0)
    assert list(nothing.chunks()) == []
