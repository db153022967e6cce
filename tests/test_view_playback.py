"""The image cache, the single slot, and shapes of the 3-D scene."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from gateway_samples import CAMERA, make_recording, make_session

from dvsviz.formats.open import open_recording
from dvsviz.geometry import se3
from dvsviz.session.records import STATUSES, MapRevision, Status
from dvsviz.session.store import open_session
from dvsviz.view import geometry3d
from dvsviz.view.cache import EncodedImage, ImageCache
from dvsviz.view.images import ImageKind, ImageOptions
from dvsviz.view.playback import Drawn, Mailbox, Renderer, Seek
from dvsviz.view.shown import ShownSession, weak_words


def image(size: int) -> EncodedImage:
    return EncodedImage(kind="raw", mime="image/png", data=bytes(size), width=1, height=1)


def test_the_cache_holds_no_more_bytes_than_it_may() -> None:
    cache = ImageCache(1000)
    for k in range(100):
        cache.put(k, image(90))
        assert cache.bytes_held <= 1000
    assert len(cache) == 11
    assert 99 in cache
    assert 0 not in cache


def test_what_was_used_stays() -> None:
    cache = ImageCache(300)
    for k in "abc":
        cache.put(k, image(100))
    cache.get("a")
    cache.put("d", image(100))
    assert [k in cache for k in "abcd"] == [True, False, True, True]
    cache.put("a", image(250))
    assert cache.bytes_held == 250
    cache.put("huge", image(301))
    assert "huge" not in cache
    with pytest.raises(ValueError, match="max_bytes"):
        ImageCache(0)


@pytest.fixture
def shown(tmp_path: Path) -> ShownSession:
    recording = make_recording(tmp_path / "r.h5", 60)
    session = open_session(make_session(tmp_path / "s.h5", recording, 60))
    return ShownSession(session, open_recording(recording))


def seek(shown: ShownSession, window: int) -> Seek:
    return Seek(shown=shown, window=window, request=window, kinds=(ImageKind.RAW,), options=ImageOptions())


def test_the_latest_seek_takes_the_slot(shown: ShownSession) -> None:
    box = Mailbox()
    for k in range(5):
        box.put(seek(shown, k))
    taken = box.take(0)
    assert taken is not None
    assert taken.window == 4
    assert box.take(0) is None
    box.close()
    assert box.take() is None


def test_a_renderer_draws_the_last_seek_and_then_its_neighbours(shown: ShownSession) -> None:
    cache = ImageCache(10_000_000)
    sent: list[int] = []
    first_waits, go_on, last = threading.Event(), threading.Event(), threading.Event()

    def send(drawn: Drawn) -> None:
        sent.append(drawn.seek.window)
        first_waits.set()
        go_on.wait(10)
        if drawn.seek.window == 30:
            last.set()

    renderer = Renderer("test", cache, send, lambda text, _: pytest.fail(text), None)
    renderer.start()
    renderer.mailbox.put(seek(shown, 0))
    assert first_waits.wait(10)
    for k in range(1, 31):  # a slow tab: these come while the first is on its way
        renderer.mailbox.put(seek(shown, k))
    go_on.set()
    assert last.wait(10)
    assert sent == [0, 30]
    neighbour = (shown.generation, 46, ImageKind.RAW, ImageOptions(), -1)
    for _ in range(200):
        if neighbour in cache:
            break
        threading.Event().wait(0.02)
    assert neighbour in cache
    renderer.mailbox.close()
    renderer.join(5)
    assert not renderer.is_alive()


def test_the_map_image_lies_on_the_plane() -> None:
    normal = se3.exp_so3([0.2, -0.3, 0.0]) @ np.array([0.0, 0.0, -1.0])
    revision = MapRevision(
        revision=0,
        window=0,
        texture=np.zeros((60, 90), np.uint8),
        origin=np.array([-1.0, -0.5]),
        px_per_unit=30.0,
        normal_world=normal,
        distance=1.3,
    )
    width, height, position, wxyz = geometry3d.map_image_pose(revision)
    assert (width, height) == pytest.approx((3.0, 2.0))
    R = se3.rotation_from_quaternion(wxyz)
    for x, y in ((-1, -1), (1, -1), (0.5, 1)):
        p = position + R @ np.array([x, y, 0.0])
        assert normal @ p + 1.3 == pytest.approx(0.0, abs=1e-9)
    # Half a pixel lies around the outermost pixel centres.
    top_left = position + R @ np.array([-1.5 + 1 / 60, -1.0 + 1 / 60, 0.0])
    np.testing.assert_allclose(R.T @ top_left, [-1.0, -0.5, 1.3], atol=1e-9)


def test_long_paths_are_thinned_and_keep_their_ends() -> None:
    Ts = se3.pose(position=np.column_stack([np.arange(100_000.0), np.zeros(100_000), np.zeros(100_000)]))
    points, colours = geometry3d.status_path(Ts, np.ones(100_000, np.uint8))
    assert 0.7 * geometry3d.MAX_SEGMENTS < len(points) <= geometry3d.MAX_SEGMENTS
    assert points[0, 0, 0] == 0
    assert points[-1, 1, 0] == 99_999
    assert colours.shape == (len(points), 2, 3)
    empty, _ = geometry3d.status_path(Ts[:1], np.ones(1, np.uint8))
    assert empty.shape == (0, 2, 3)


def test_a_thinned_path_keeps_every_loss_and_wastes_nothing_on_rest() -> None:
    # A circle, then as long a rest, with two lost windows in it that lie between the kept ones.
    angle = np.concatenate([np.linspace(0, 2 * np.pi, 20_000), np.full(20_000, 2 * np.pi)])
    Ts = se3.pose(position=np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))]))
    status = np.full(len(angle), STATUSES.index(Status.TRACKING), np.uint8)
    status[7001:7003] = STATUSES.index(Status.LOST)
    points, colours = geometry3d.status_path(Ts, status)
    lost = np.all(colours[:, 0] == geometry3d.line_rgb(geometry3d.STATUS_RGB[Status.LOST]), axis=1)
    assert lost.sum() == 1
    lengths = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    assert lengths.sum() == pytest.approx(2 * np.pi, rel=1e-4)
    assert (lengths > 1e-6).sum() > 0.85 * len(points)
    # Each segment begins where the one before it ends.
    np.testing.assert_array_equal(points[1:, 0], points[:-1, 1])


def test_of_many_keyframes_some_are_drawn_the_ends_among_them() -> None:
    chosen = geometry3d.thinned(3334, geometry3d.MAX_KEYFRAMES)
    assert len(chosen) == geometry3d.MAX_KEYFRAMES and (np.diff(chosen) > 0).all()
    assert (chosen[0], chosen[-1]) == (0, 3333)
    assert geometry3d.thinned(7, geometry3d.MAX_KEYFRAMES).tolist() == list(range(7))


def test_field_of_view_of_a_sensor_that_is_not_square() -> None:
    fov, aspect = geometry3d.field_of_view(CAMERA)
    assert fov == pytest.approx(2 * np.arctan(16 / 41))
    assert aspect == pytest.approx((48 / 40) / (32 / 41))


def test_weak_directions_in_words() -> None:
    assert weak_words(np.array([0, 0.7, 0, 0.71, 0, 0])) == "motion along x and rotation about y"
    assert weak_words(np.array([0, 0, 0.02, 0, 0, 1.0])) == "motion along z"
    assert weak_words(np.zeros(6)) == ""
    assert weak_words(np.full(6, np.nan)) == ""


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_a_path_beyond_measure_is_drawn_somehow() -> None:
    Ts = se3.pose(position=np.random.default_rng(1).normal(size=(5000, 3)) * 1e200)
    points, _ = geometry3d.status_path(Ts, np.ones(5000, np.uint8))
    assert 0 < len(points) <= geometry3d.MAX_SEGMENTS
