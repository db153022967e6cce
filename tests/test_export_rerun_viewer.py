"""A run streamed to the real rerun program, which writes down what reaches it."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import gateway_samples as samples
import pytest

from dvsviz.cli import main
from dvsviz.errors import DvsvizError
from dvsviz.export.rerun import RerunLogger
from dvsviz.export.rerun_viewer import RerunViewer
from dvsviz.export.rrd_file import count_rows
from dvsviz.session.records import TrackerUpdates
from dvsviz.session.store import open_session

WINDOWS = 12


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[tuple[RerunViewer, Path]]:
    """The rerun program without a window: it listens, and saves what it is sent."""
    port, out = free_port(), tmp_path / "seen.rrd"
    program = Path(sys.executable).with_name("rerun")
    process = subprocess.Popen(
        [program, "--port", str(port), "--save", out], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        end = time.monotonic() + 30
        found = RerunViewer(port=port)
        while True:
            try:
                found.look()
                break
            except DvsvizError:
                assert time.monotonic() < end, "rerun does not listen"
                assert process.poll() is None, "rerun has ended"
                time.sleep(0.1)
        yield found, out
    finally:
        process.kill()
        process.wait()


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # the program is still writing it
def test_a_run_reaches_the_viewer_window_by_window(viewer: tuple[RerunViewer, Path], tmp_path: Path) -> None:
    found, out = viewer
    recording = samples.make_recording(tmp_path / "r.h5", WINDOWS)
    with open_session(samples.make_session(tmp_path / "s.h5", recording, WINDOWS)) as session:
        header = session.header
    with RerunLogger(found, header) as logger:
        for k in range(WINDOWS):
            logger.log(samples.result(k), samples.first_updates() if k == 0 else TrackerUpdates())
    end, rows = time.monotonic() + 20, {}
    while rows.get("world/trajectory", 0) < WINDOWS and time.monotonic() < end:
        time.sleep(0.2)
        rows = count_rows(out)
    assert rows["world/camera"] == rows["world/trajectory"] == WINDOWS
    assert rows["world/keyframes"] >= 1


def test_without_a_viewer_it_is_said_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    argv = [
        "serve",
        "--rerun",
        "--rerun-port",
        str(port),
        "--port",
        "0",
        "--no-browser",
        "--sessions",
        str(tmp_path),
    ]
    assert main(argv) == 2
    said = capsys.readouterr().err
    assert f"no rerun viewer listens at 127.0.0.1:{port}" in said
    assert f"`rerun --port {port}`" in said
    assert said.count("\n") == 1


def test_the_stretch_that_was_looked_at_is_marked_in_the_file(tmp_path: Path) -> None:
    recording = samples.make_recording(tmp_path / "r.h5", WINDOWS)
    session = samples.make_session(tmp_path / "s.h5", recording, WINDOWS)
    argv = ["export", str(session), "--to", str(tmp_path / "s.rrd"), "--start", "0.03", "--end", "0.06"]
    assert main(argv) == 0
    told = subprocess.run(
        [Path(sys.executable).with_name("rerun"), "rrd", "print", "-vvv", tmp_path / "s.rrd"],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    ).stdout
    assert "{min: 3, max: 5}" in told[told.index("TimePanelBlueprint:time_selection") :]
