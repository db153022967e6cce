"""The command line as a user meets it: one object on standard output, one line of error, exit codes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from dvsviz.cli import arguments, main, simulation_arguments
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.tum import write_tum
from dvsviz.session.store import open_session
from dvsviz.simulate.flights import FlightName
from dvsviz.simulate.motion import MotionName
from dvsviz.simulate.rooms import ReliefName
from dvsviz.simulate.scenes import SceneName
from dvsviz.simulate.simulate import simulate

EVENTS = "0.000100 10 20 1\n0.000200 11 21 0\n0.000300 12 22 1\n"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "wall.h5"
    simulate(path, seconds=0.6, seed=1, camera=Camera(width=160, height=120, fx=140, fy=140, cx=79.5, cy=59.5))
    return path


@pytest.fixture(scope="module")
def session(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sessions") / "wall.h5"
    assert main(["track", str(recording), "--out", str(path)]) == 0
    return path


def run(
    *argv: object, cwd: Path | None = None, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "dvsviz", *map(str, argv)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, **(env or {})},
        timeout=120,
        check=False,
    )


def one_error(capsys: pytest.CaptureFixture[str], *argv: object) -> str:
    """Run in this process, expect an error, and return its one line."""
    capsys.readouterr()
    assert main([str(word) for word in argv]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("dvsviz: error: ") and said.err.count("\n") == 1
    return said.err


# --- options ---------------------------------------------------------------------------------------------------


def test_help_is_quick_and_says_every_command() -> None:
    start = time.perf_counter()
    told = run("--help")
    took = time.perf_counter() - start
    assert told.returncode == 0 and told.stderr == ""
    for command in arguments.COMMANDS:
        assert re.search(rf"\b{command}\b", told.stdout), command
    # Half a second on an idle machine; the bound only catches a heavy import, which takes two and more.
    code = "import sys, dvsviz.cli.arguments; assert not {'numpy', 'numba', 'viser'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    assert took < 30


@pytest.mark.parametrize("command", sorted(arguments.COMMANDS))
def test_every_command_has_help_with_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: dvsviz {command}" in text
    assert "Example" in text or command == "doctor"


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert not stop.value.code
    assert re.fullmatch(r"dvsviz \d+\.\d+\.\d+\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ([], "Expected one of"),
        (["trak", "r.h5"], "trak"),
        (["track", "r.h5", "--colour", "red"], "--colour"),
        (["track"], "RECORDING"),
        (["track", "r.h5", "--size", "240"], "expected WIDTHxHEIGHT such as 240x180, got 240"),
        (
            ["track", "r.h5", "--motion", "planer"],
            "expected one of planar, translation, rotation, auto, got planer",
        ),
        (["track", "r.h5", "--window", "many"], "expected a whole number, got many"),
        (["evaluate", "r.h5", "--align", "affine"], "sim3"),
        (["serve", "--port", "http"], "--port"),
    ],
)
def test_wrong_options_say_so_in_one_line(argv: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said in one_error(capsys, *argv)


def test_choices_are_those_of_the_simulator() -> None:
    assert (*get_args(SceneName), *get_args(ReliefName), "room") == simulation_arguments.SCENES
    assert (*get_args(MotionName), *get_args(FlightName)) == simulation_arguments.MOTIONS


# --- commands --------------------------------------------------------------------------------------------------


def test_track_prints_one_object_that_evaluate_repeats(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tracked = run("track", recording, "--json", cwd=tmp_path)
    assert tracked.returncode == 0, tracked.stderr
    assert tracked.stderr == ""
    summary = json.loads(tracked.stdout)
    assert summary["session"] == str(Path("sessions") / "wall.h5")
    assert main(["evaluate", str(tmp_path / "sessions" / "wall.h5"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == summary["evaluation"]


def test_sessions_go_where_the_environment_says(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DVSVIZ_SESSIONS", str(tmp_path / "mine"))
    assert main(["track", str(recording), "--window", "20000"]) == 0
    with open_session(tmp_path / "mine" / "wall.h5") as session:
        assert session.complete and '"window": 20000' in session.header.config_json


def test_info_of_a_recording_and_of_a_session(
    recording: Path, session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = []
    for path in (recording, session):
        capsys.readouterr()
        assert main(["info", str(path), "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    for key in ("events", "duration_s", "width", "height"):
        assert found[0][key] == pytest.approx(found[1][key])
    assert (found[0]["width"], found[0]["height"]) == (160, 120)
    assert found[0]["format"] != found[1]["format"] == "dvsviz-session"
    assert found[1]["complete"] is True and found[1]["windows"] > 5
    assert main(["info", str(session)]) == 0
    assert "160" in capsys.readouterr().out


def test_evaluate_prints_a_table_and_takes_tum_files(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(session), "--align", "se3", "--poses", "online"]) == 0
    assert re.search(r"alignment\s+se3", capsys.readouterr().out)
    with open_session(session) as opened:
        assert opened.ground_truth is not None
        write_tum(tmp_path / "truth.tum", opened.ground_truth)
        write_tum(tmp_path / "estimate.tum", opened.trajectory())
    assert main(["evaluate", str(session), "--json"]) == 0
    own = json.loads(capsys.readouterr().out)
    argv = ["evaluate", str(tmp_path / "estimate.tum"), "--truth", str(tmp_path / "truth.tum"), "--json"]
    assert main(argv) == 0
    files = json.loads(capsys.readouterr().out)
    assert files["position_rmse_m"] == pytest.approx(own["position_rmse_m"], abs=1e-6)
    assert files["rotation_rmse_deg"] == pytest.approx(own["rotation_rmse_deg"], abs=1e-4)
    assert "--truth" in one_error(capsys, "evaluate", tmp_path / "estimate.tum")


def test_batch_tables_what_worked_and_names_what_did_not(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = [
        "batch",
        str(recording),
        str(tmp_path / "none.h5"),
        "--sessions",
        str(tmp_path / "s"),
        "--window",
        "20000",
    ]
    assert main(argv) == 2
    said = capsys.readouterr()
    assert said.out.splitlines()[0].split()[0] == "session" and said.out.splitlines()[1].startswith("wall ")
    assert "none.h5: no such file" in said.err
    assert main([*argv, "--json"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert found["runs"] == []
    assert [entry["recording"] for entry in found["failed"]] == [str(recording), str(tmp_path / "none.h5")]
    assert "already exists" in found["failed"][0]["error"]


def test_simulate_writes_a_recording_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "r.h5"
    argv = [
        "simulate",
        "--scene",
        "stripes",
        "--motion",
        "slider",
        "--seconds",
        "0.1",
        "--seed",
        "4",
        "--out",
        str(out),
    ]
    assert main(argv) == 0
    assert "already exists" in one_error(capsys, *argv)
    assert "seconds: expected" in one_error(capsys, "simulate", "--seconds", "-1", "--out", tmp_path / "q.h5")


def test_export_writes_what_the_ending_says(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("x.rrd", "x.tum"):
        assert main(["export", str(session), "--to", str(tmp_path / name)]) == 0
        assert capsys.readouterr().out == ""
    assert (tmp_path / "x.rrd").read_bytes().startswith(b"RRF")
    with open_session(session) as opened:
        assert len((tmp_path / "x.tum").read_text().splitlines()) == opened.window_count
    assert main(["export", str(session), "--to", str(tmp_path / "x.tum"), "--force", "--poses", "online"]) == 0


def test_track_logs_to_rerun_meanwhile(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["track", str(recording), "--window", "20000", "--out", str(tmp_path / "s.h5")]
    assert main([*argv, "--rerun", str(tmp_path / "s.rrd"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["session"] == str(tmp_path / "s.h5")
    assert (tmp_path / "s.rrd").read_bytes().startswith(b"RRF")
    assert "s.rrd: already exists" in one_error(
        capsys, "track", recording, "--out", tmp_path / "t.h5", "--rerun", tmp_path / "s.rrd"
    )


def test_serve_prints_its_address_and_stops_at_ctrl_c(tmp_path: Path) -> None:
    argv = ["serve", "--port", "0", "--no-browser", "--sessions", str(tmp_path / "s")]
    with subprocess.Popen(
        [sys.executable, "-m", "dvsviz", *argv], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None
        address = server.stdout.readline()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/#token=\S+\n", address)
        port = re.findall(r":(\d+)/", address)[0]
        taken = run("serve", "--port", port, "--no-browser", cwd=tmp_path)
        assert taken.returncode == 2 and f"port {port} is in use" in taken.stderr
        assert taken.stderr.count("\n") == 1 and taken.stdout == ""
        time.sleep(1.0)
        server.send_signal(signal.SIGINT)
        said, complained = server.communicate(timeout=60)
    assert server.returncode in (0, 130)
    assert "Traceback" not in complained and "http" not in said


def test_doctor_says_what_it_finds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DVSVIZ_SESSIONS", str(tmp_path / "new" / "sessions"))
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["packages"]["numpy"] == np.__version__
    assert found["sessions"] == str(tmp_path / "new" / "sessions") and found["processors"] >= 1
    assert not (tmp_path / "new").exists()
    assert main(["doctor"]) == 0
    assert "packages" in capsys.readouterr().out


def test_existing_sessions_are_kept(session: Path, recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--force" in one_error(capsys, "track", recording, "--out", session)
    assert "is complete" in one_error(capsys, "track", recording, "--out", session, "--resume")
    assert "no such session" in one_error(
        capsys, "track", recording, "--out", session.with_name("x.h5"), "--resume"
    )
    assert "say one of them" in one_error(capsys, "track", recording, "--out", session, "--resume", "--force")
    assert "not a session" in one_error(capsys, "evaluate", recording)
    assert "name x.rrd, x.tum" in one_error(capsys, "export", session, "--to", session.with_suffix(".txt"))
    assert "already exists" in one_error(capsys, "export", session, "--to", _touched(session.with_suffix(".tum")))


def _touched(path: Path) -> Path:
    path.touch()
    return path


# --- bad input: one line that names the file, the place and what to do -----------------------------------------


def _folder(path: Path, events: str = EVENTS, **others: str) -> Path:
    path.mkdir()
    (path / "events.txt").write_text(events)
    for name, text in others.items():
        (path / f"{name}.txt").write_text(text)
    return path


def _truncated_zip(path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.txt", EVENTS * 1000)
    path.write_bytes(path.read_bytes()[:-40])
    return path


BAD = {
    "missing file": (lambda d: d / "none.zip", "none.zip", "check the path"),
    "empty events": (lambda d: _folder(d / "r", ""), "events.txt", ""),
    "letters in a number": (lambda d: _folder(d / "r", EVENTS + "0.0004 1x 20 1\n"), "events.txt, line 4", ""),
    "unsorted time": (lambda d: _folder(d / "r", EVENTS + "0.000050 1 20 1\n"), "events.txt, line 4", "--repair"),
    "pixel outside": (lambda d: _folder(d / "r", EVENTS + "0.000400 240 20 1\n"), "events.txt, line 4", "--size"),
    "truncated zip": (lambda d: _truncated_zip(d / "r.zip"), "r.zip", ""),
    "calibration of 4 numbers": (lambda d: _folder(d / "r", calib="199 199 120 90\n"), "calib.txt", ""),
    "NaN pose": (
        lambda d: _folder(d / "r", groundtruth="0.0 0 0 0 0 0 0 1\n0.1 nan 0 0 0 0 0 1\n"),
        "groundtruth.txt, line 2",
        "",
    ),
}


def _check_complaint(said: str, name: str) -> None:
    _, where, hint = BAD[name]
    lines = said.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("dvsviz: error: "), said
    assert where in lines[0] and hint in lines[0] and "; " in lines[0]


@pytest.mark.parametrize("name", sorted(BAD))
def test_bad_input_is_one_line_and_exit_code_2(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _check_complaint(one_error(capsys, "track", BAD[name][0](tmp_path), "--json"), name)
    assert not (tmp_path / "sessions").exists()


def test_bad_input_ends_the_process_without_a_traceback(tmp_path: Path) -> None:
    told = run("track", BAD["letters in a number"][0](tmp_path), "--json", cwd=tmp_path)
    assert told.returncode == 2 and told.stdout == ""
    _check_complaint(told.stderr, "letters in a number")


# --- interruptions ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def long_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("long") / "long.h5"
    simulate(path, seconds=2.5, seed=1, camera=Camera(width=160, height=120, fx=140, fy=140, cx=79.5, cy=59.5))
    return path


def _begun(recording: Path, out: Path, windows: int) -> tuple[subprocess.Popen[str], int]:
    """Start to track in another process and return it with the windows seen once there are enough of them."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dvsviz", "track", str(recording), "--out", str(out), "--window", "3000"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
        if out.exists():
            with open_session(out) as session:
                if session.window_count >= windows:
                    return process, session.window_count
    process.kill()
    pytest.fail(f"the run did not get to window {windows}: {process.communicate()}")


def test_killed_run_leaves_a_session_that_opens_and_resumes(
    long_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "long.h5"
    process, seen = _begun(long_recording, out, 30)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=30)
    assert main(["info", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["state"] == "incomplete" and found["complete"] is False
    assert found["windows"] >= seen
    assert main(["evaluate", str(out)]) == 0
    assert "incomplete" in capsys.readouterr().err
    assert "--resume" in one_error(capsys, "track", long_recording, "--out", out)
    assert main(["track", str(long_recording), "--out", str(out), "--resume", "--json"]) == 0
    resumed = json.loads(capsys.readouterr().out)
    with open_session(out) as session:
        assert session.complete and session.window_count == resumed["windows"]
        assert np.array_equal(session.column("first_event")[1:], session.column("end_event")[:-1])
        assert session.column("end_event")[-1] == session.header.events


def test_ctrl_c_stops_cleanly_and_says_how_to_go_on(long_recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "long.h5"
    process, seen = _begun(long_recording, out, 10)
    process.send_signal(signal.SIGINT)
    said, complained = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said == ""
    assert re.fullmatch(r"dvsviz: .*long\.h5: stopped after window \d+; continue with --resume\n", complained)
    with open_session(out) as session:
        assert not session.complete and session.window_count >= seen
        assert session.checkpoint_at(session.window_count) is not None
