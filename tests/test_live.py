"""Streams: what is served is received, thinned by the rule where nobody keeps up, and carried on after a break."""

import multiprocessing
import statistics
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

from dvsviz.errors import DvsvizError
from dvsviz.events.events import Events, joined
from dvsviz.events.recording import MemoryEvents, Recording
from dvsviz.geometry.camera import Camera
from dvsviz.live.network import parse_address
from dvsviz.live.receiver import connect
from dvsviz.live.recorder import Recorder
from dvsviz.live.server import EventServer, LiveError, replay
from dvsviz.live.source import LiveEvents
from dvsviz.live.windows import MAX_LAG_US, SLOW_LAG_US, LiveWindows

W, H = 96, 64


def events(n: int = 100_000, start_us: int = 5_000_000, span_us: int = 500_000, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    return Events(
        t_us=start_us + np.sort(rng.integers(0, span_us, n)).astype(np.int64),
        x_px=rng.integers(0, W, n).astype(np.uint16),
        y_px=rng.integers(0, H, n).astype(np.uint16),
        is_positive=rng.integers(0, 2, n).astype(bool),
    )


def recording(source: Events | LiveEvents) -> Recording:
    held = source if isinstance(source, LiveEvents) else MemoryEvents(source)
    return Recording(path=Path("r"), name="r", format="live", camera=Camera.guess(W, H), events=held)


def serve(pipe: Connection) -> None:
    """Serve the events in a process of its own: the library's client lets no other thread run while it connects."""
    with EventServer("127.0.0.1", 0, width=W, height=H) as server:
        pipe.send(server.port)
        server.wait_for_client()
        replay(recording(events()), server)


def assert_same(a: Events, b: Events) -> None:
    for name in ("t_us", "x_px", "y_px", "is_positive"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_everything_served_is_received_and_recorded() -> None:
    sent, recorded = events(), []
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=serve, args=(theirs,), daemon=True)
    process.start()
    assert ours.poll(30)
    port = ours.recv()
    recorder = Recorder(recorded.append)
    live = LiveEvents(lambda: connect(f"aedat4+tcp://127.0.0.1:{port}"), retry_s=0.1, record=recorder.put)
    assert live.size == (W, H)
    made = LiveWindows(recording(live), lambda: 2000, max_duration_us=100_000)
    windows = list(made)
    process.join(10)
    assert process.exitcode == 0
    assert live.received == len(sent) and live.figures.dropped == 0
    recorder.close()
    assert_same(joined(recorded), sent)
    # Each window is what its indices say, in order; none is larger than wanted.
    for k, window in enumerate(windows):
        assert window.index == k and len(window) <= 2000 and window.end_us >= window.events.t_us[-1]
        assert_same(window.events, sent[window.first_event : window.end_event])
    found = made.summary()
    assert found["received"] == len(sent) and 0 < found["latency_median_ms"] < 1000
    if found["skips"] == 0:
        assert found["used_share"] == 1 and windows[-1].end_event == len(sent)


class Burst:
    """A stream that is there at once, and far ahead of whoever reads it."""

    size = (W, H)

    @property
    def arrived_s(self) -> float:
        return time.monotonic()

    def __init__(self, *parts: Events) -> None:
        self._parts = list(parts)

    def read(self) -> Events | None:
        if not self._parts:
            raise ConnectionError("it ended")
        return self._parts.pop(0)

    def close(self) -> None:
        self._parts.clear()


class Paced(Burst):
    """10 ms of a stream every 10 ms."""

    began = 0.0

    def read(self) -> Events | None:
        self.began = self.began or time.monotonic()
        if self._parts and time.monotonic() - self.began < (self._parts[0].t_us[-1] - 5_000_000) * 1e-6:
            return None
        return super().read()


def paced(sent: Events) -> LiveEvents:
    parts = [sent[k : k + 1000] for k in range(0, len(sent), 1000)]
    return LiveEvents(lambda: Paced(*parts), retry_s=0.0)


def test_a_slow_tracker_leaves_windows_out() -> None:
    # Long enough that a busy machine, on which steps take longer, knows the tracker is slow before it ends.
    sent = events(500_000, span_us=5_000_000)
    live, lags = paced(sent), []
    made = LiveWindows(recording(live), lambda: 2000, max_duration_us=100_000)
    for window in made:
        lags.append(live.newest_us - window.start_us)
        assert_same(window.events, sent[window.first_event : window.end_event])
        # Three times as long as the window lasts: no lag could be worked off.
        time.sleep(0.06 if not live.is_ended else 0)
    found = made.summary()
    assert found["skips"] >= 2 and 0.1 < found["used_share"] < 0.8
    assert max(lags) < MAX_LAG_US
    # From where it is known that the tracker is slow, the lag stays at the lower limit and the time of a step.
    assert statistics.median(lags[-15:]) < SLOW_LAG_US + 100_000


def test_a_single_long_step_loses_nothing() -> None:
    sent, live_sizes, stretches = events(200_000, span_us=2_000_000), [], []
    live, stretch = paced(sent), [1.0]

    def told(value: float) -> None:
        stretch[0] = value
        stretches.append(value)

    made = LiveWindows(recording(live), lambda: int(2000 * stretch[0]), max_duration_us=100_000, stretch=told)
    for window in made:
        live_sizes.append(len(window))
        time.sleep(0.6 if window.index == 10 else 0.004)
    found = made.summary()
    assert found["used_share"] == 1 and found["skips"] == 0
    # What waited was taken in windows of twice the size.
    assert max(stretches) == 2.0 and 4000 in live_sizes[11:14]
    assert found["latency_max_ms"] > 500 > found["latency_median_ms"]


def test_a_broken_stream_is_carried_on_with_a_gap() -> None:
    first, second = events(3000, span_us=30_000), events(2000, start_us=0, span_us=20_000, seed=1)
    streams, said = [Burst(first), Burst(second)], []

    def opened() -> Burst:
        if not streams:
            raise LiveError("gone")
        return streams.pop(0)

    live = LiveEvents(opened, retry_s=1.2, report=said.append)
    windows = list(LiveWindows(recording(live), lambda: 1000, max_duration_us=100_000))
    got = joined([window.events for window in windows])
    assert live.figures.reconnects == 1 and live.received == 5000
    assert np.all(np.diff(got.t_us) >= 0)
    pause_us = int(np.diff(got.t_us).max())
    assert 300_000 < pause_us < 3_000_000
    assert "was lost" in said[0] and "there again" in said[1] and "did not come back" in said[-1]


def test_wrong_events_are_dropped_and_counted() -> None:
    good = events(100, span_us=1000)
    x = good.x_px.copy()
    x[3] = W
    t = good.t_us.copy()
    t[50] -= 5000
    live = LiveEvents(
        lambda: Burst(Events(t_us=t, x_px=x, y_px=good.y_px, is_positive=good.is_positive)), retry_s=0
    )
    assert live.wait_for_first()
    assert (live.received, live.figures.dropped) == (98, 2)


def test_a_recording_that_cannot_be_written_ends_the_run() -> None:
    def full(_: Events) -> None:
        raise OSError("no space left")

    recorder = Recorder(full)
    recorder.put(events(10))
    with pytest.raises(DvsvizError, match="cannot be written"):
        recorder.close()


def test_a_quiet_stream_still_gives_windows() -> None:
    sent = events(50, span_us=1000)

    class Quiet(Burst):
        def read(self) -> Events | None:
            return super().read() if self._parts else None

    live = LiveEvents(lambda: Quiet(sent), max_wait_us=50_000)
    window = next(iter(LiveWindows(recording(live), lambda: 4000, max_duration_us=50_000)))
    assert_same(window.events, sent)
    live.close()
    assert live.is_ended


@pytest.mark.parametrize("where", ["tcp://x", "http://a:1", "aedat4+tcp://:7", "aedat4+tcp://h:99999"])
def test_addresses_that_are_none(where: str) -> None:
    with pytest.raises(LiveError, match=r"is no stream; expected aedat4\+tcp://HOST:PORT"):
        parse_address(where)


def test_nobody_there() -> None:
    server = EventServer("127.0.0.1", 0, width=W, height=H)
    server.close()
    with pytest.raises(LiveError, match="nothing answers at"):
        connect(f"aedat4+tcp://127.0.0.1:{server.port}")
    assert parse_address("aedat4+tcp://cam.local:7777") == ("cam.local", 7777)
    with EventServer("127.0.0.1", 0, width=W, height=H) as taken, pytest.raises(DvsvizError, match="cannot listen"):
        EventServer("127.0.0.1", taken.port, width=W, height=H)


def test_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    with EventServer("127.0.0.1", 0, width=W, height=H) as server:
        start = time.monotonic()
        replay(recording(events(1000, span_us=400_000)), server, speed=4.0)
        assert 0.09 < time.monotonic() - start < 1.0
        with pytest.raises(ValueError, match="speed"):
            replay(recording(events(10)), server, speed=0)
