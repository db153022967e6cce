"""Files that are no sessions, cut off sessions and sessions made to do harm: one line, never a crash."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import session_samples as samples

from dvsviz.errors import SessionError
from dvsviz.session.commits import Commit, read_commit, write_commit
from dvsviz.session.store import Session, SessionWriter, open_session


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("session") / "s.h5"
    with SessionWriter.create(path, samples.header(), chunk_rows=32) as writer:
        writer.set_ground_truth(samples.truth(40))
        for k in range(40):
            writer.append(samples.result(k), samples.updates(k))
        writer.checkpoint(39, {"pose": samples.pose(39)})
        writer.close({"windows": 40})
    return path.read_bytes()


def read_everything(path: Path) -> Session:
    session = open_session(path)
    session.columns()
    session.Ts_world_camera()
    session.trajectory()
    for k in range(session.window_count):
        session.result(k)
    for entry in (*session.keyframes, *session.map_revisions):
        entry.load()
    _ = session.summary, session.failures, session.log, session.bookmarks, session.tags, session.ground_truth
    session.checkpoint_at(10**9)
    return session


def assert_one_line(path: Path) -> str:
    with pytest.raises(SessionError) as caught:
        read_everything(path)
    text = str(caught.value)
    assert "\n" not in text and path.name in text and len(text) < 600
    return text


@pytest.mark.parametrize(
    "content", [b"", b"PK\x03\x04 not ours", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + b"\xff" * 999]
)
def test_a_foreign_file(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "f.h5").write_bytes(content)
    assert_one_line(tmp_path / "f.h5")


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    assert "no such session" in assert_one_line(tmp_path / "none.h5")
    (tmp_path / "folder.h5").mkdir()
    assert_one_line(tmp_path / "folder.h5")


def test_an_hdf5_file_of_another_format_and_of_a_later_version(tmp_path: Path, original: bytes) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["format"] = "dvsviz-recording"
    assert "not a session" in assert_one_line(tmp_path / "other.h5")
    (tmp_path / "later.h5").write_bytes(original)
    with h5py.File(tmp_path / "later.h5", "r+") as file:
        file.attrs["version"] = 2
    assert "version 2" in assert_one_line(tmp_path / "later.h5")


def test_a_session_cut_off_anywhere(tmp_path: Path, original: bytes) -> None:
    rng = np.random.default_rng(1)
    whole = 0
    for size in [1, 8, 47, 48, 100, *rng.integers(100, len(original) - 1, 40).tolist()]:
        path = tmp_path / "cut.h5"
        path.write_bytes(original[:size])
        try:
            # A cut through what lies behind the last row takes nothing away.
            session = read_everything(path)
        except SessionError as error:
            assert "\n" not in str(error) and "cut.h5" in str(error)
        else:
            whole += 1
            np.testing.assert_array_equal(session.Ts_world_camera(False), [samples.pose(k) for k in range(40)])
    assert whole < 10


def test_flipped_bytes_never_crash(tmp_path: Path, original: bytes) -> None:
    rng = np.random.default_rng(2)
    for i in range(60):
        data = bytearray(original)
        # Half of the trials hit the metadata at the beginning.
        end = len(data) if i % 2 else 6000
        for at in rng.integers(0, end, 8):
            data[at] = rng.integers(256)
        path = tmp_path / "flipped.h5"
        path.write_bytes(data)
        try:
            read_everything(path)
        except SessionError as error:
            assert "\n" not in str(error)


def set_count(name: str, count: int) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        commit = read_commit(file)
        assert commit is not None
        write_commit(file, Commit(sequence=commit.sequence + 1, counts=commit.counts | {name: count}))

    return change


def replace(place: str, **options: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[place]
        file.create_dataset(place, **options)

    return change


def put(place: str, value: object, index: object = ...) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[place][index] = value

    return change


def external(file: h5py.File) -> None:
    del file["text"]
    file.create_dataset("text", shape=(100,), dtype="u1", external=[("/etc/passwd", 0, 100)])


def elsewhere(file: h5py.File) -> None:
    del file["windows/status"]
    file["windows/status"] = h5py.ExternalLink("other.h5", "/x")


HARM: dict[str, Callable[[h5py.File], None]] = {
    "more rows than there are": set_count("windows", 10**15),
    "negative rows": set_count("windows", -1),
    "more text than there is": set_count("text", 10**15),
    "a column is missing": lambda f: f.__delitem__("windows/status"),
    "a column is a group": lambda f: (f.__delitem__("windows/omega"), f.create_group("windows/omega"))[0],
    "a column of another type": replace("windows/status", data=np.zeros(40)),
    "a column of another shape": replace("windows/omega", data=np.zeros((40, 4))),
    "a column of text": replace("windows/status", data=["x"] * 40),
    "a column that claims rows it does not hold": replace(
        "windows/start_us", shape=(10**13,), dtype="i8", chunks=(32,)
    ),
    "a compressed column": replace("windows/start_us", data=np.zeros(40, "i8"), chunks=(40,), compression="gzip"),
    "a file of the system": external,
    "a link to another file": elsewhere,
    "a loop": lambda f: (f.__delitem__("log"), f.__setitem__("log", h5py.SoftLink("/log")))[0],
    "no commit": lambda f: f.__delitem__("commit"),
    "both commits torn": put("commit", 7),
    "an unknown status": put("windows/status", 99),
    "an unknown cause": lambda f: (
        f["failures/cause"].resize((1,)),
        set_count("failures", 1)(f),
        put("failures/cause", 99)(f),
    )[0],
    "a refined pose of no window": put("refined_poses/window", 10**6),
    "an image behind the end": put("keyframes/image_first", 10**12),
    "an image that is none": put("images", 0),
    "an image of a negative size": put("keyframes/image_count", -5),
    "a checkpoint that is none": put("states", 0),
    "a checkpoint that unpacks to too much": put("checkpoints/unpacked_count", 2**40),
    "a ground truth that is not finite": put("ground_truth/T_world_camera", np.nan),
    "a summary that is not JSON": lambda f: put("text", ord("{"))(f),
    "no camera": lambda f: f.__delitem__("camera"),
    "a camera without a size": lambda f: f["camera"].attrs.__setitem__("width", -3),
    "a header of another type": lambda f: f.attrs.__setitem__("events", "many"),
    "no name": lambda f: f.attrs.__delitem__("recording_name"),
    "a name that is a number": lambda f: f.attrs.__setitem__("recording_name", 3),
    "commit names that are none": lambda f: f["commit"].attrs.__setitem__("names", 3),
}


@pytest.mark.parametrize("harm", HARM)
def test_a_session_made_to_do_harm_is_one_line(tmp_path: Path, original: bytes, harm: str) -> None:
    path = tmp_path / "harm.h5"
    path.write_bytes(original)
    with h5py.File(path, "r+") as file:
        HARM[harm](file)
    assert_one_line(path)


def test_one_torn_commit_of_two_is_survived(tmp_path: Path, original: bytes) -> None:
    path = tmp_path / "torn.h5"
    path.write_bytes(original)
    with h5py.File(path, "r+") as file:
        commit = read_commit(file)
        assert commit is not None
        file["commit"][(commit.sequence + 1) % 2] = 12345
    assert read_everything(path).window_count == 40


def test_what_lies_behind_the_commit_is_as_if_it_were_not_there(tmp_path: Path, original: bytes) -> None:
    path = tmp_path / "behind.h5"
    path.write_bytes(original)
    with h5py.File(path, "r+") as file:
        commit = read_commit(file)
        assert commit is not None
        fewer = commit.counts | {"windows": 33, "refined_poses": 0, "refinements": 0}
        write_commit(file, Commit(sequence=commit.sequence + 1, counts=fewer))
    session = open_session(path)
    assert session.window_count == 33 and not session.complete
    assert len(session.columns()["status"]) == 33
