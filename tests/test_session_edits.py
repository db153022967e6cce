from pathlib import Path

import numpy as np
import pytest
import session_samples as samples
from test_session_store import check, write

from dvsviz.errors import SessionError
from dvsviz.session.packing import decode_png, encode_png, pack_state, unpack_state
from dvsviz.session.store import (
    Origin,
    SessionWriter,
    add_bookmark,
    delete,
    delete_bookmark,
    open_session,
    rename,
    set_tags,
)


def test_bookmarks_and_tags_of_a_finished_session(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    write(path, 40)
    reader = open_session(path)
    first = add_bookmark(path, 30, "schöner Bogen")
    second = add_bookmark(path, 7, "start")
    set_tags(path, ("wall", "fast"))
    reader.refresh()
    assert [(b.bookmark, b.window, b.text) for b in reader.bookmarks] == [
        (second, 7, "start"),
        (first, 30, "schöner Bogen"),
    ]
    assert reader.tags == ("wall", "fast")
    delete_bookmark(path, second)
    third = add_bookmark(path, 1, "new")
    reader.refresh()
    assert [b.bookmark for b in reader.bookmarks] == [third, first] and third not in (first, second)
    check(reader, 40)
    assert reader.complete and reader.summary == {"windows": 40, "evaluation": None}
    with pytest.raises(SessionError, match="no window 40"):
        add_bookmark(path, 40, "beyond")
    assert [p.name for p in tmp_path.iterdir()] == ["s.h5"]


def test_a_live_session_is_edited_by_its_writer_only(tmp_path: Path) -> None:
    writer = write(tmp_path / "s.h5", 10, close=False)
    with pytest.raises(SessionError, match="being written"):
        add_bookmark(tmp_path / "s.h5", 3, "no")
    number = writer.add_bookmark(3, "yes")
    other = writer.add_bookmark(4, "wrong")
    writer.delete_bookmark(other)
    writer.set_tags(("live",))
    writer.close()
    session = open_session(tmp_path / "s.h5")
    assert [b.bookmark for b in session.bookmarks] == [number]
    assert session.tags == ("live",)


def test_a_session_is_renamed_unless_the_name_is_taken_or_none(tmp_path: Path) -> None:
    write(tmp_path / "s.h5", 5)
    assert rename(tmp_path / "s.h5", "Wand 2") == tmp_path / "Wand 2.h5"
    check(open_session(tmp_path / "Wand 2.h5"), 5)
    write(tmp_path / "s.h5", 6)
    with pytest.raises(SessionError, match="already exists"):
        rename(tmp_path / "s.h5", "Wand 2")
    for name in ("../out", "", ".hidden", "a/b", "a\nb", "x" * 200):
        with pytest.raises(SessionError, match="cannot be a session's name"):
            rename(tmp_path / "s.h5", name)
    with pytest.raises(SessionError):
        rename(tmp_path / "none.h5", "x")


def test_an_interrupted_session_can_be_bookmarked_and_stays_incomplete(tmp_path: Path) -> None:
    writer = write(tmp_path / "s.h5", 5, close=False)
    writer.abandon()
    add_bookmark(tmp_path / "s.h5", 2, "here it stopped")
    session = open_session(tmp_path / "s.h5")
    assert not session.complete and len(session.bookmarks) == 1
    with SessionWriter.resume(tmp_path / "s.h5") as resumed:
        resumed.append(samples.result(5))
        assert resumed.add_bookmark(5, "on") == 1
    assert len(open_session(tmp_path / "s.h5").bookmarks) == 2


def test_states_come_back_with_their_types() -> None:
    state = {
        "f": np.linspace(0, 1, 6).reshape(2, 3)[:, ::2],
        "i": np.array(3, np.int32),
        "b": np.array([True, False]),
        "empty": np.zeros((0, 4), np.float32),
        "text": np.array(["a", "größe"]),
    }
    for array in state.values():
        array.setflags(write=False)
    back = unpack_state(*pack_state(state), place="here")
    assert list(back) == list(state)
    for name, array in state.items():
        np.testing.assert_array_equal(back[name], array)
        assert back[name].dtype == array.dtype and back[name].shape == array.shape
    with pytest.raises(ValueError, match="numbers or text"):
        pack_state({"o": np.array([None])})


def test_images_come_back_and_a_bomb_is_refused() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    np.testing.assert_array_equal(decode_png(encode_png(image), place="here"), image)
    bomb = bytearray(encode_png(image))
    bomb[16:24] = b"\x7f\xff\xff\xff\x7f\xff\xff\xff"
    with pytest.raises(ValueError, match="too large"):
        decode_png(bytes(bomb), place="here")


def test_only_a_session_at_rest_is_deleted(tmp_path: Path) -> None:
    writer = write(tmp_path / "busy.h5", 5, close=False)
    with pytest.raises(SessionError, match="is being written"):
        delete(tmp_path / "busy.h5")
    writer.abandon()
    delete(tmp_path / "busy.h5")
    assert not (tmp_path / "busy.h5").exists()
    for name, data in {"notes.txt": b"mine", "recording.h5": b"\x89HDF\r\n\x1a\n and more"}.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(SessionError):
            delete(tmp_path / name)
        assert (tmp_path / name).read_bytes() == data
    with pytest.raises(SessionError):
        delete(tmp_path / "none.h5")


def test_a_branch_begins_with_the_windows_of_its_origin(tmp_path: Path) -> None:
    write(tmp_path / "s.h5", 60)
    add_bookmark(tmp_path / "s.h5", 3, "mine")
    T = samples.pose(25)
    origin = Origin(
        session="s", created="c", window=25, config_json="{}", changes={"window": (None, 5)}, T_world_camera=T
    )
    header = samples.header(origin=origin, start_us=samples.FIRST_US, end_us=samples.FIRST_US + 1_000_000)
    with SessionWriter.branch(tmp_path / "s.h5", tmp_path / "b.h5", header, windows=25) as writer:
        assert writer.window_count == 25
        for k in range(25, 31):
            writer.append(samples.result(k), samples.updates(k))
    branch = open_session(tmp_path / "b.h5")
    check(branch, 31)
    assert branch.bookmarks == () and branch.tags == () and branch.summary is None
    found = branch.header.origin
    assert found is not None and found.T_world_camera is not None
    assert (found.session, found.window, found.changes) == ("s", 25, {"window": (None, 5)})
    assert np.array_equal(found.T_world_camera, T)
    assert branch.header.part_s == (0.0, 1.0)
    assert open_session(tmp_path / "s.h5").header.origin is None
    with pytest.raises(SessionError, match="already exists"):
        SessionWriter.branch(tmp_path / "s.h5", tmp_path / "b.h5", header, windows=3)
