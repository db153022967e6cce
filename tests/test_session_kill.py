"""A process that writes a session is killed at random instants; another process reads what it wrote."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import session_samples as samples
from test_session_store import check

from dvsviz.errors import SessionError
from dvsviz.session.killed import lookup3
from dvsviz.session.store import SessionWriter, open_session

# Says, after each window, which one it appended and when, so that a loss can be measured against the kill.
WRITER = """
import os, sys, time
from pathlib import Path
import session_samples as samples
from dvsviz.session.killed import lookup3
from dvsviz.session.store import SessionWriter
writer = SessionWriter.create(Path(sys.argv[1]), samples.header())
stamps = os.open(sys.argv[1] + ".stamps", os.O_WRONLY | os.O_CREAT)
for k in range(100_000):
    writer.append(samples.result(k), samples.updates(k))
    if k % 40 == 39:
        writer.checkpoint(k, {"pose": samples.pose(k)})
    os.write(stamps, f"{k} {time.monotonic()}\\n".encode())
    time.sleep(float(sys.argv[2]))
"""


def start(path: Path, pause_s: float = 0.002) -> subprocess.Popen[bytes]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    return subprocess.Popen([sys.executable, "-c", WRITER, str(path), str(pause_s)], env=environment)


def wait_for(path: Path, process: subprocess.Popen[bytes]) -> None:
    limit = time.monotonic() + 60
    while not path.exists():
        assert process.poll() is None and time.monotonic() < limit
        time.sleep(0.002)


def kill(process: subprocess.Popen[bytes]) -> float:
    at = time.monotonic()
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    return at


def appended_before(path: Path, t: float) -> int:
    stamps = path.parent / (path.name + ".stamps")
    lines = stamps.read_text().splitlines() if stamps.exists() else []
    return sum(float(line.split()[1]) < t for line in lines)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose writer was killed after about 150 windows."""
    path = tmp_path_factory.mktemp("killed") / "k.h5"
    process = start(path)
    wait_for(path, process)
    session = open_session(path)
    while session.refresh() < 150:
        time.sleep(0.01)
    kill(process)
    return path


def test_after_a_kill_at_any_instant_at_most_the_last_second_is_missing(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    # From the very moment the file appears on.
    for i, delay in enumerate([0.0, *rng.uniform(0.0, 1.0, 4)]):
        path = tmp_path / f"{i}.h5"
        process = start(path)
        wait_for(path, process)
        time.sleep(delay)
        at = kill(process)
        session = open_session(path)
        assert not session.complete and not session.is_live
        assert session.summary is None
        assert session.window_count >= appended_before(path, at - 1.0)
        check(session, session.window_count)
        assert [k.image[0, 0] for k in session.keyframes] == [k % 256 for k in range(len(session.keyframes))]
        assert len(session.keyframes) == -(-session.window_count // 10)
        if (found := session.checkpoint_at(10**9)) is not None:
            np.testing.assert_array_equal(found[1]["pose"], samples.pose(found[0]))


def test_another_process_reads_while_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "live.h5"
    process = start(path, 0.0005)
    try:
        wait_for(path, process)
        session = open_session(path)
        counts = [session.window_count]
        while len(set(counts)) < 6:
            counts.append(session.refresh())
            np.testing.assert_array_equal(
                session.columns()["start_us"], samples.FIRST_US + samples.WINDOW_US * np.arange(counts[-1])
            )
            assert session.is_live and not session.complete
            time.sleep(0.05)
        assert counts == sorted(counts)
        with pytest.raises(SessionError, match="being written"):
            SessionWriter.resume(path)
    finally:
        kill(process)
    assert not session.is_live
    session.refresh()
    check(session, session.window_count)


def test_a_killed_session_is_resumed_without_a_loss_and_ends_complete(killed: Path, tmp_path: Path) -> None:
    path = tmp_path / "k.h5"
    path.write_bytes(killed.read_bytes())
    before = open_session(path)
    n = before.window_count
    with SessionWriter.resume(path) as writer:
        assert writer.window_count == n
        check(open_session(path), n)
        for k in range(n, n + 30):
            writer.append(samples.result(k), samples.updates(k))
        writer.close({"windows": n + 30})
    # A reader that was open all the time sees the file change under it.
    assert before.refresh() == n + 30
    for session in (before, open_session(path)):
        check(session, n + 30)
        assert session.complete and session.summary == {"windows": n + 30}
    assert len(session.keyframes) == -(-(n + 30) // 10)
    with h5py.File(path, "r"):
        pass
    with pytest.raises(SessionError, match="complete"):
        SessionWriter.resume(path)
    assert [p.name for p in tmp_path.iterdir()] == ["k.h5"]


def test_a_resumed_session_can_go_back_to_a_checkpoint(killed: Path, tmp_path: Path) -> None:
    path = tmp_path / "k.h5"
    path.write_bytes(killed.read_bytes())
    found = open_session(path).checkpoint_at(100)
    assert found is not None and found[0] == 79
    with SessionWriter.resume(path, windows=found[0] + 1) as writer:
        assert writer.window_count == 80
        writer.flush()
        cut = open_session(path)
        check(cut, 80)
        assert [k.window for k in cut.keyframes] == list(range(0, 80, 10))
        assert len(cut.failures) == 1 and len(cut.map_revisions) == 8
        last = cut.checkpoint_at(10**9)
        assert last is not None and last[0] == 79
        for k in range(80, 90):
            writer.append(samples.result(k), samples.updates(k))
    check(open_session(path), 90)


def test_a_plain_open_of_a_killed_session_is_what_the_store_works_around(killed: Path) -> None:
    with pytest.raises(OSError, match="already open for write"):
        h5py.File(killed, "r")
    with h5py.File(killed, "r", swmr=True) as file:
        assert file.attrs["format"] == "dvsviz-session"


def test_the_checksum_is_the_published_one() -> None:
    # The vectors of its author (lookup3.c, 2006).
    assert lookup3(b"") == 0xDEADBEEF
    assert lookup3(b"Four score and seven years ago") == 0x17770551


def test_a_full_disk_is_said_in_one_line_and_what_was_stored_stays(tmp_path: Path) -> None:
    script = """
import resource, signal, sys
from pathlib import Path
import numpy as np
import session_samples as samples
from dvsviz.errors import SessionError
from dvsviz.session.killed import lookup3
from dvsviz.session.store import SessionWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
writer = SessionWriter.create(Path(sys.argv[1]), samples.header())
for k in range(50):
    writer.append(samples.result(k), samples.updates(k))
writer.flush()
size = Path(sys.argv[1]).stat().st_size
resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
try:
    for k in range(50, 4000):
        writer.append(samples.result(k))
        if k == 2000:
            writer.checkpoint(k, {"noise": np.random.default_rng(0).normal(size=1_000_000)})
            writer.flush()
except SessionError as error:
    print(error)
try:
    writer.abandon()
except SessionError:
    print("abandoned")
"""
    path = tmp_path / "full.h5"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], env=environment, capture_output=True, text=True, timeout=60
    )
    lines = done.stdout.splitlines()
    assert "cannot be written" in lines[0] and "free space" in lines[0], (done.stdout, done.stderr)
    session = open_session(path)
    assert session.window_count >= 50 and not session.complete
