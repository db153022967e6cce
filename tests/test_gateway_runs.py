"""Runs in real child processes: they begin, pause, go on, are stopped, fail, and end with the server."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dvsviz.config import TrackerConfig
from dvsviz.gateway.library import Library
from dvsviz.gateway.orders import RunOrder, RunState, Stage
from dvsviz.gateway.runs import Run, Runs
from dvsviz.session.store import open_session
from dvsviz.simulate.simulate import simulate

ROOT = Path(__file__).parents[1]
# Small windows: many of them, so that a run can be caught in the middle.
CONFIG = TrackerConfig(window=2000)


def until(is_so: Callable[[], object], what: str, seconds: float = 120.0) -> None:
    """Wait; compilation of the kernels may be among what is waited for."""
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end, f"after {seconds:g} s it was not so that {what}"
        time.sleep(0.02)


def windows_of(path: Path) -> int:
    return open_session(path).window_count if path.exists() else 0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "wall.h5"
    simulate(path, scene="shapes", motion="handheld", seconds=3.0, seed=2)
    return path


@pytest.fixture
def runs() -> Iterator[Runs]:
    runs = Runs(lambda _: None)
    yield runs
    runs.close()


def test_a_run_pauses_goes_on_and_is_stopped(runs: Runs, recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.h5"
    library = Library(tmp_path, runs)
    run = runs.add(RunOrder(recording=recording, out=out, config=CONFIG))
    waiting = runs.add(RunOrder(recording=recording, out=tmp_path / "b.h5"))
    until(lambda: run.state is RunState.RUNNING, "it runs")
    listed = {entry["name"]: entry for entry in library.entries()}
    assert (listed["a"]["state"], listed["b"]["state"]) == ("starting", "queued")
    assert listed["a"]["stages"] == ["reading", "compiling", "tracking"]
    runs.act("b", "cancel")
    assert waiting.state is RunState.CANCELLED
    until(lambda: windows_of(out) > 5 and run.stage is Stage.TRACKING, "it tracks")
    assert 0 < run.progress["share"] < 1

    runs.act("a", "pause")
    time.sleep(0.5)  # the window that is under way ends, and what was tracked is written
    rested = windows_of(out)
    time.sleep(1.0)
    assert windows_of(out) == rested
    assert open_session(out).is_live
    runs.act("a", "resume")
    until(lambda: windows_of(out) > rested + 2, "it goes on", 20)

    runs.act("a", "cancel")
    until(lambda: run.state is RunState.CANCELLED, "it stops", 20)
    with open_session(out) as session:
        assert not session.complete
        assert not session.is_live
        assert session.checkpoint_at(session.window_count - 1) is not None
    library.scan()
    assert [entry["state"] for entry in library.entries()] == ["incomplete"]


def test_a_run_that_cannot_begin_says_why(runs: Runs, tmp_path: Path) -> None:
    broken = tmp_path / "recordings" / "broken.zip"
    broken.parent.mkdir()
    broken.write_bytes(b"PK\x03\x04 and no more")
    sessions = tmp_path / "sessions"
    run = runs.add(RunOrder(recording=broken, out=sessions / "broken.h5"))
    until(lambda: run.state is RunState.FAILED, "it fails")
    (entry,) = Library(sessions, runs).entries()
    assert entry["state"] == "failed"
    assert "broken.zip" in entry["error"]


def test_a_run_that_gets_ready_is_stopped_at_once(recording: Path, tmp_path: Path) -> None:
    changes: list[str] = []
    runs = Runs(lambda run: changes.append(run.state))
    run = runs.add(RunOrder(recording=recording, out=tmp_path / "a.h5"))
    until(lambda: run.state is RunState.RUNNING, "it runs")
    runs.act("a", "cancel")
    until(lambda: run.state is RunState.CANCELLED, "it is stopped", 8)
    assert not (tmp_path / "a.h5").exists()
    assert changes[-1] == RunState.CANCELLED
    runs.close()


def test_closing_stops_a_run_and_keeps_what_it_found(recording: Path, tmp_path: Path) -> None:
    told: list[Run] = []
    runs = Runs(lambda _: None, told.append)
    run = runs.add(RunOrder(recording=recording, out=tmp_path / "a.h5", config=CONFIG))
    until(lambda: run.stage is Stage.TRACKING and windows_of(tmp_path / "a.h5") > 3, "it tracks")
    from_s = time.monotonic()
    runs.close()
    assert time.monotonic() - from_s < 5
    assert run.state is RunState.CANCELLED
    assert told
    with open_session(tmp_path / "a.h5") as session:
        assert not session.complete
        assert session.window_count > 3


def test_ctrl_c_ends_server_and_run(recording: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "app.py"), str(recording), "--no-browser", "--port", "0"]
    process = subprocess.Popen(
        [*command, "--sessions", str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("http")
        out = tmp_path / "wall.h5"
        until(lambda: windows_of(out) > 3, "it tracks")
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        pids = children.read_text().split() if children.exists() else []
        process.send_signal(signal.SIGINT)
        from_s = time.monotonic()
        rest, errors = process.communicate(timeout=20)
        assert time.monotonic() - from_s < 8
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, rest) == (0, "")
    assert "Traceback" not in errors
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)
    with open_session(out) as session:
        assert session.window_count > 3
        assert not session.is_live
