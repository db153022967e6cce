"""A run from a recording to a session: what it writes, how it is stopped and continued."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dvsviz.config import TrackerConfig
from dvsviz.errors import ConfigError, RunCancelled, SessionError
from dvsviz.evaluate.evaluate import evaluate
from dvsviz.events.events import Events
from dvsviz.events.recording import MemoryEvents, Recording
from dvsviz.formats.open import open_recording
from dvsviz.geometry.camera import Camera
from dvsviz.pipeline import Progress, summarize, track
from dvsviz.session.records import STATUSES, Status
from dvsviz.session.store import open_session
from dvsviz.simulate.simulate import simulate
from dvsviz.tracking.tracker import Tracker

KEYS = [
    "session",
    "recording",
    "motion",
    "windows",
    "tracked_share",
    "losses",
    "events",
    "duration_s",
    "wall_s",
    "events_per_second",
    "real_time_factor",
    "compile_s",
    "evaluation",
    "metric_scale",
]


@pytest.fixture(scope="module")
def recording_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of a wall seen by a small, non-square sensor."""
    path = tmp_path_factory.mktemp("recordings") / "wall.h5"
    simulate(path, seconds=1.0, seed=1, camera=Camera(width=160, height=120, fx=140, fy=140, cx=79.5, cy=59.5))
    return path


@pytest.fixture(scope="module")
def recording(recording_path: Path) -> Recording:
    return open_recording(recording_path)


@pytest.fixture(scope="module")
def whole(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict, list[Progress]]:
    """The recording tracked without interruption."""
    out = tmp_path_factory.mktemp("sessions") / "wall.h5"
    told: list[Progress] = []
    summary = track(recording, TrackerConfig(), out, progress=told.append)
    return out, summary, told


def test_summary_is_the_object_of_the_command_line(
    whole: tuple[Path, dict, list[Progress]], recording: Recording
) -> None:
    out, summary, _ = whole
    assert list(summary) == KEYS
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["session"] == str(out) and summary["recording"] == str(recording.path)
    assert summary["motion"] == "planar"
    assert summary["events"] == recording.events.count
    assert summary["duration_s"] == pytest.approx(recording.duration_s)
    assert summary["events_per_second"] * summary["wall_s"] == pytest.approx(recording.events.count)
    assert summary["real_time_factor"] * summary["wall_s"] == pytest.approx(recording.duration_s, rel=1e-3)
    assert summary["compile_s"] > 0


def test_session_holds_the_run(whole: tuple[Path, dict, list[Progress]], recording: Recording) -> None:
    out, summary, _ = whole
    with open_session(out) as session:
        assert session.complete
        assert session.summary == summary
        assert session.window_count == summary["windows"] > 5
        assert session.header.recording_path == str(recording.path)
        assert session.header.camera == recording.camera
        assert TrackerConfig.from_json(session.header.config_json) == TrackerConfig()
        columns = session.columns()
        assert columns["first_event"][0] == 0 and columns["end_event"][-1] == recording.events.count
        assert np.array_equal(columns["first_event"][1:], columns["end_event"][:-1])
        truth = recording.ground_truth
        assert truth is not None and session.ground_truth is not None
        assert np.array_equal(session.ground_truth.Ts_world_camera, truth.Ts_world_camera)
        assert session.checkpoint_at(session.window_count) is not None
        assert evaluate(session).to_dict() == summary["evaluation"]


def test_simulated_wall_is_tracked(whole: tuple[Path, dict, list[Progress]]) -> None:
    _, summary, _ = whole
    assert summary["losses"] == 0 and summary["tracked_share"] > 0.9
    assert summary["evaluation"]["position_rmse_percent_of_distance"] < 2.5
    assert summary["evaluation"]["rotation_rmse_deg"] < 2


def test_progress_is_told_after_each_window(whole: tuple[Path, dict, list[Progress]]) -> None:
    _, summary, told = whole
    assert [p.window for p in told] == list(range(summary["windows"]))
    assert told[-1].share == 1
    assert all(a.share < b.share for a, b in pairwise(told))
    assert told[-1].recording_s == pytest.approx(summary["duration_s"], abs=1e-3)
    assert all(p.events_per_second > 0 and p.real_time_factor > 0 for p in told)


def stopped(recording: Recording, out: Path, at: int) -> None:
    """Track and stop after window `at`."""
    cancel = threading.Event()

    def progress(now: Progress) -> None:
        # The pipeline looks at it after the next window.
        if now.window == at - 1:
            cancel.set()

    with pytest.raises(RunCancelled, match=f"stopped after window {at}.*--resume"):
        track(recording, TrackerConfig(), out, progress=progress, cancel=cancel)


def test_stopped_run_is_readable_and_continues_to_the_same_result(
    whole: tuple[Path, dict, list[Progress]], recording: Recording, tmp_path: Path
) -> None:
    out = tmp_path / "wall.h5"
    stopped(recording, out, 9)
    with open_session(out) as session:
        assert not session.complete and session.summary is None
        assert session.window_count == 10
    summary = track(recording, None, out, resume=True)
    expected = whole[1]
    for key in ("windows", "tracked_share", "losses", "events", "evaluation"):
        assert summary[key] == pytest.approx(expected[key]), key
    with open_session(out) as session, open_session(whole[0]) as other:
        assert session.complete
        assert np.array_equal(session.Ts_world_camera(), other.Ts_world_camera())
        assert np.array_equal(session.column("status"), other.column("status"))
        assert len(session.keyframes) == len(other.keyframes)


def test_run_killed_before_its_first_checkpoint_starts_over(recording: Recording, tmp_path: Path) -> None:
    out = tmp_path / "wall.h5"

    class Broken(Exception):
        pass

    def fail(now: Progress) -> None:
        raise Broken

    with pytest.raises(Broken):
        track(recording, TrackerConfig(), out, progress=fail)
    with open_session(out) as session:
        assert not session.complete
    assert track(recording, None, out, resume=True)["windows"] > 5


def test_existing_session_is_kept_unless_forced(recording: Recording, tmp_path: Path) -> None:
    out = tmp_path / "wall.h5"
    stopped(recording, out, 3)
    before = out.read_bytes()
    with pytest.raises(SessionError, match=r"already exists.*--force"):
        track(recording, TrackerConfig(), out)
    assert out.read_bytes() == before
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(RunCancelled):
        track(recording, TrackerConfig(), out, force=True, cancel=cancel)
    with open_session(out) as session:
        assert session.window_count == 1


def test_other_files_are_never_replaced(recording: Recording, tmp_path: Path) -> None:
    other = tmp_path / "letter.h5"
    other.write_text("dear diary")
    with pytest.raises(SessionError, match="not a session and is not replaced"):
        track(recording, TrackerConfig(), other, force=True)
    assert other.read_text() == "dear diary"
    with pytest.raises(SessionError, match="is the recording itself"):
        track(recording, TrackerConfig(), recording.path, force=True)


def test_resume_refuses_other_settings_and_other_recordings(recording: Recording, tmp_path: Path) -> None:
    out = tmp_path / "wall.h5"
    stopped(recording, out, 3)
    with pytest.raises(ConfigError, match="motion rotation instead of planar"):
        track(recording, TrackerConfig(motion="rotation"), out, resume=True)
    short = tmp_path / "short.h5"
    simulate(short, seconds=0.2, seed=2)
    with pytest.raises(SessionError, match=r"is a session of .*wall\.h5"):
        track(open_recording(short), None, out, resume=True)
    with pytest.raises(SessionError, match="no such session"):
        track(recording, None, tmp_path / "none.h5", resume=True)


def test_run_without_truth_has_no_evaluation(recording: Recording, tmp_path: Path) -> None:
    cut = replace(recording, ground_truth=None, mean_plane_distance=None)
    assert track(cut, TrackerConfig(window=20_000), tmp_path / "blind.h5")["evaluation"] is None


def statuses(text: str) -> np.ndarray:
    letters = dict(zip("itwlr", STATUSES, strict=True))
    return np.array([STATUSES.index(letters[letter]) for letter in text], np.uint8)


@pytest.mark.parametrize(
    ("text", "share", "losses"),
    [
        ("iitttttttw", 1.0, 0),
        ("ittllrttlt", 5 / 9, 2),
        ("ilrlrlr", 0.0, 1),
        ("iiii", 0.0, 0),
        ("", 0.0, 0),
        ("tttt", 1.0, 0),
    ],
)
def test_share_and_losses_by_hand(text: str, share: float, losses: int) -> None:
    assert summarize(statuses(text)) == {
        "windows": len(text),
        "tracked_share": pytest.approx(share),
        "losses": losses,
    }
    assert STATUSES[:2] == (Status.INITIALIZING, Status.TRACKING)


WARM = """
import sys
from pathlib import Path
from numba.core.registry import CPUDispatcher
from dvsviz.config import TrackerConfig
from dvsviz.formats.open import open_recording
from dvsviz.tracking.warm_up import warm_up
from dvsviz.pipeline import run

def compiled():
    rooms = [module for name, module in sys.modules.items() if name.startswith("dvsviz.")]
    return {
        (kernel.py_func.__qualname__, signature)
        for room in rooms
        for kernel in vars(room).values()
        if isinstance(kernel, CPUDispatcher)
        for signature in kernel.signatures
    }

recording = open_recording(Path(sys.argv[1]))
warm_up(TrackerConfig())
run.warm_up = lambda config: 0.0
before = compiled()
run.track(recording, TrackerConfig(), Path(sys.argv[2]))
late = compiled() - before
assert not late, late
"""


def test_no_kernel_is_compiled_after_the_clock_has_started(recording: Recording, tmp_path: Path) -> None:
    told = subprocess.run(
        [sys.executable, "-c", WARM, str(recording.path), str(tmp_path / "wall.h5")],
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert told.returncode == 0, told.stderr


def _of(t_us: list[int], size: tuple[int, int]) -> Recording:
    n = len(t_us)
    events = Events(
        t_us=np.array(t_us, np.int64),
        x_px=np.arange(n, dtype=np.uint16) % size[0],
        y_px=np.arange(n, dtype=np.uint16) % size[1],
        is_positive=np.ones(n, np.bool_),
    )
    camera = Camera.guess(*size)
    return Recording(path=Path("odd"), name="odd", format="memory", camera=camera, events=MemoryEvents(events))


@pytest.mark.parametrize(
    ("t_us", "size", "said"),
    [
        ([0, 1, 2], (1, 1), "too small"),
        ([0, 1, 2], (4096, 1), "too small"),
        ([-(2**62), 0, 2**62], (64, 48), "years apart"),
    ],
)
def test_what_no_camera_records_is_refused(
    t_us: list[int], size: tuple[int, int], said: str, tmp_path: Path
) -> None:
    with pytest.raises(SessionError, match=said):
        track(_of(t_us, size), None, tmp_path / "s.h5")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("t_us", [[7], [7, 7, 7], [2**62, 2**62 + 5, 2**62 + 90_000], [-(2**62), 1 - 2**62]])
def test_a_few_events_make_a_session(t_us: list[int], tmp_path: Path) -> None:
    summary = track(_of(t_us, (64, 48)), None, tmp_path / "s.h5")
    assert summary["windows"] >= 1
    with open_session(tmp_path / "s.h5") as session:
        assert session.complete and session.column("start_us")[0] == t_us[0]


def test_a_damaged_checkpoint_leaves_the_session_as_it_was(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A number that is none in what is gone on from is told; nothing that was tracked is taken away."""
    out, cancel = tmp_path / "s.h5", threading.Event()

    def stop(progress: Progress) -> None:
        if progress.window >= 3:
            cancel.set()

    packed = Tracker.checkpoint
    monkeypatch.setattr(Tracker, "checkpoint", lambda self: packed(self) | {"velocity": np.full(3, np.nan)})
    with pytest.raises(RunCancelled):
        track(recording, None, out, progress=stop, cancel=cancel)
    before = out.read_bytes()
    with pytest.raises(SessionError, match=r"checkpoint of window \d+: cannot be gone on with .*velocity"):
        track(recording, None, out, resume=True)
    assert out.read_bytes() == before
    with open_session(out) as session:
        assert session.window_count >= 4
