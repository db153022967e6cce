from pathlib import Path

import numpy as np
import pytest
import session_samples as samples

from dvsviz.errors import FormatError, SessionError
from dvsviz.export.tum import export_tum
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import microseconds, read_tum, seconds_text, write_tum
from dvsviz.session.store import Poses, SessionWriter, open_session

UNIX_US = 1_700_000_000_123_457


def _trajectory(n: int = 20) -> Trajectory:
    rng = np.random.default_rng(3)
    T = se3.pose(se3.exp_so3(rng.normal(size=(n, 3))), rng.normal(size=(n, 3)))
    t_us = UNIX_US + np.cumsum(rng.integers(1, 9, n))
    return Trajectory(t_us=t_us.astype(np.int64), Ts_world_camera=T)


def test_a_tum_file_gives_back_what_was_written_with_every_digit_of_unix_time(tmp_path: Path) -> None:
    truth = _trajectory()
    write_tum(tmp_path / "a.tum", truth)
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back.t_us, truth.t_us)
    np.testing.assert_allclose(back.Ts_world_camera, truth.Ts_world_camera, atol=5e-9)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tum"]


def test_quaternions_are_written_xyzw(tmp_path: Path) -> None:
    turn = se3.pose(se3.exp_so3([0, 0, np.pi / 2]), [1.0, 2.0, 3.0])[None]
    write_tum(tmp_path / "a.tum", Trajectory(t_us=np.array([-1_500_000]), Ts_world_camera=turn))
    words = (tmp_path / "a.tum").read_text().split()
    assert words[:4] == ["-1.500000", "1.000000000", "2.000000000", "3.000000000"]
    np.testing.assert_allclose([float(w) for w in words[4:]], [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)


@pytest.mark.parametrize("t_us", [0, 1, -1, -1_000_001, 999_999, UNIX_US, 2**62 // 1_000_000 * 1_000_000 + 1])
def test_times_are_exact_both_ways(t_us: int) -> None:
    assert microseconds(seconds_text(t_us)) == t_us


def test_times_in_scientific_notation_are_read() -> None:
    assert microseconds("1.468939993123456e+09") == 1_468_939_993_123_456


def test_comments_commas_and_blank_lines_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("# t x y z\n\n0.5,1,2,3,0,0,0,1\n  0.75 1 2 3 0 0 0 1\n")
    back = read_tum(tmp_path / "a.tum")
    assert back.t_us.tolist() == [500_000, 750_000]
    np.testing.assert_array_equal(back.positions[1], [1, 2, 3])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0\n", ("line 2", "8 numbers")),
        ("0 1 2 3 0 0 0 1\n1 1 2 x 0 0 0 1\n", ("line 2", "not a number")),
        ("0 1 2 nan 0 0 0 1\n", ("line 1", "not finite")),
        ("nan 1 2 3 0 0 0 1\n", ("line 1", "not a number")),
        ("1e400 1 2 3 0 0 0 1\n", ("line 1", "not a number")),
        ("0 1 2 3 0 0 0 0\n", ("line 1", "length 0")),
        ("1 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1\n", ("line 2", "not after")),
        ("# nothing\n", ("no poses",)),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    (tmp_path / "bad.tum").write_text(text)
    with pytest.raises(FormatError) as caught:
        read_tum(tmp_path / "bad.tum")
    for word in ("bad.tum", *words):
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_repair_drops_doubles_and_says_how_many(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("0 1 0 0 0 0 0 1\n1 2 0 0 0 0 0 1\n1 3 0 0 0 0 0 1\n2 4 0 0 0 0 0 1\n")
    said: list[str] = []
    back = read_tum(tmp_path / "a.tum", repair=True, warnings=said)
    assert back.positions[:, 0].tolist() == [1, 2, 4]
    assert said == ["a.tum: 1 of 4 poses dropped, their times do not increase"]


def test_a_missing_and_a_binary_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "b.tum").write_bytes(bytes(range(256)))
    for name in ("none.tum", "b.tum"):
        with pytest.raises(FormatError, match=name):
            read_tum(tmp_path / name)


def test_writing_into_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="cannot be written"):
        write_tum(tmp_path / "none" / "a.tum", _trajectory())


@pytest.mark.parametrize("poses", ["refined", "online"])
def test_a_session_is_written_without_its_lost_windows(tmp_path: Path, poses: Poses) -> None:
    windows = 60
    with SessionWriter.create(tmp_path / "s.h5", samples.header()) as writer:
        for k in range(windows):
            writer.append(samples.result(k), samples.updates(k))
    session = open_session(tmp_path / "s.h5")
    # Of the sample's windows every one got a refined pose, the lost ones too.
    lost = {k for k in range(windows) if samples.status(k) in ("lost", "relocalizing") and poses == "online"}
    kept = [k for k in range(windows) if k not in lost]
    assert export_tum(session, tmp_path / "a.tum", poses) == len(kept) == windows - len(lost)
    assert poses == "refined" or len(lost) == 2
    back = read_tum(tmp_path / "a.tum")
    assert back.t_us.tolist() == [samples.result(k).start_us for k in kept]
    wanted = [samples.refined_pose(k, windows) if poses == "refined" else samples.pose(k) for k in kept]
    np.testing.assert_allclose(back.Ts_world_camera, wanted, atol=5e-9)
    assert (tmp_path / "a.tum").read_text().startswith("1700000000.000000 ")


def test_a_session_without_a_pose_is_refused(tmp_path: Path) -> None:
    SessionWriter.create(tmp_path / "s.h5", samples.header()).close()
    with pytest.raises(SessionError, match="no window has a pose"):
        export_tum(open_session(tmp_path / "s.h5"), tmp_path / "a.tum")
    assert not (tmp_path / "a.tum").exists()
