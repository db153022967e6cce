"""`dvsviz replay` and `dvsviz track --live` as two programs."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dvsviz.cli import main
from dvsviz.formats.open import open_recording
from dvsviz.live.server import EventServer
from dvsviz.simulate.simulate import simulate


def test_a_replay_is_tracked_and_recorded_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wall, out, record = tmp_path / "wall.h5", tmp_path / "live.h5", tmp_path / "record.h5"
    simulate(wall, scene="shapes", motion="handheld", seconds=1.0, seed=2)
    command = [sys.executable, "-m", "dvsviz", "replay", str(wall), "--listen", "0"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    ) as replaying:
        assert replaying.stdout is not None
        found = re.search(r"(aedat4\+tcp://\S+)", replaying.stdout.readline())
        assert found is not None
        code = main(["track", "--live", found[1], "--out", str(out), "--record", str(record), "--json"])
        assert replaying.wait(20) == 0
    said = capsys.readouterr()
    assert code == 0
    live = json.loads(said.out)["live"]
    count = open_recording(wall).events.count
    assert live["received"] == count == open_recording(record).events.count
    assert 0 < live["used_share"] <= 1 and live["latency_median_ms"] > 0
    assert "no calibration" in said.err and "was lost" in said.err


def test_a_receiver_whose_tracker_has_gone_ends_without_a_word() -> None:
    with EventServer("127.0.0.1", 0, width=64, height=48) as server:
        command = [sys.executable, "-m", "dvsviz.live.receiver", f"aedat4+tcp://127.0.0.1:{server.port}"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with subprocess.Popen(command, **pipes) as receiving:
            assert receiving.stdin is not None
            assert receiving.stdout is not None
            assert receiving.stderr is not None
            receiving.stdout.close()
            receiving.stdin.close()
            assert receiving.wait(60) == 0
            assert b"Traceback" not in receiving.stderr.read()
