"""Pictures with known answers, on a sensor that is not square."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from gateway_samples import CAMERA

from dvsviz.events.events import Events
from dvsviz.events.windows import EventWindow, make_window
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane
from dvsviz.session.records import MapRevision
from dvsviz.view import images
from dvsviz.view.images import ImageOptions
from dvsviz.view.moving import MovingWindow, Polarities
from dvsviz.view.picture import Picture


def window_of(pixels: list[tuple[int, int]], positive: bool = True, camera: Camera = CAMERA) -> EventWindow:
    n = len(pixels)
    events = Events(
        t_us=np.arange(n, dtype=np.int64),
        x_px=np.array([x for x, _ in pixels], np.uint16),
        y_px=np.array([y for _, y in pixels], np.uint16),
        is_positive=np.full(n, positive),
    )
    for column in (events.t_us, events.x_px, events.y_px, events.is_positive):
        column.flags.writeable = False
    return make_window(camera, events)


WALL = Plane(normal=np.array([0.0, 0.0, -1.0]))


def still(window: EventWindow, T_world_camera: np.ndarray | None = None) -> MovingWindow:
    T = np.eye(4) if T_world_camera is None else T_world_camera
    return MovingWindow(window=window, T_world_camera=T, omega=np.zeros(3), velocity=np.zeros(3))


def lit(picture: Picture) -> set[tuple[int, int]]:
    """Columns and rows of the pixels that are not background."""
    rows, columns = np.nonzero(np.any(picture.rgb() != images.BACKGROUND, axis=-1))
    return {(int(x), int(y)) for x, y in zip(columns, rows, strict=True)}


CORNERS = [(0, 0), (47, 0), (0, 31), (47, 31), (20, 5)]


def test_one_event_is_one_sharp_pixel() -> None:
    picture = images.raw_picture([window_of(CORNERS)], CAMERA, ImageOptions())
    assert (picture.width, picture.height) == (48, 32)
    assert lit(picture) == set(CORNERS)


@pytest.mark.parametrize(("positive", "rgb"), [(True, images.POSITIVE), (False, images.NEGATIVE)])
def test_polarity_has_its_colour(positive: bool, rgb: tuple[int, int, int]) -> None:
    window = window_of([(20, 5)] * 3, positive)
    colour = images.raw_picture([window], CAMERA, ImageOptions()).rgb()[5, 20]
    np.testing.assert_allclose(colour, rgb, atol=2)
    grey = images.raw_picture([window], CAMERA, ImageOptions(polarity=False)).rgb()[5, 20]
    np.testing.assert_allclose(grey, images.NEUTRAL, atol=2)


def test_undistorted_raw_pixels_lie_where_the_camera_says() -> None:
    camera = replace(CAMERA, distortion=(-0.3, 0.05, 0.001, -0.002, 0.0))
    x, y = 3, 2
    bx, by = camera.bearings([(x, y)])[0]
    expected = (round(camera.fx * bx + camera.cx), round(camera.fy * by + camera.cy))
    inner = (24, 16)
    found = lit(images.raw_picture([window_of([(x, y), inner], camera=camera)], camera, ImageOptions()))
    inside = 0 <= expected[0] < 48 and 0 <= expected[1] < 32
    assert found == ({expected, inner} if inside else {inner})


def test_motion_is_taken_out() -> None:
    # A point that moves 1000 px/s to the left while the camera moves to the right; the window starts at its right.
    n, speed = 21, 1000.0
    t = np.arange(n) * 1000
    x = np.round(40 - speed * t * 1e-6).astype(np.uint16)
    events = Events(t_us=t.astype(np.int64), x_px=x, y_px=np.full(n, 9, np.uint16), is_positive=np.ones(n, bool))
    moving = replace(still(make_window(CAMERA, events)), velocity=np.array([speed / CAMERA.fx, 0.0, 0.0]))
    picture = images.warped_picture([moving], np.eye(4), WALL, CAMERA, ImageOptions(polarity=False))
    row, column = np.unravel_index(int(picture.pixels.argmax()), picture.pixels.shape)
    assert (column, row) == (40, 9)
    assert {x for x, _ in lit(picture)} <= {39, 40, 41}


def test_the_map_is_seen_from_the_pose() -> None:
    texture = np.zeros((64, 96), dtype=np.uint8)
    texture[22, 66] = 255
    revision = MapRevision(
        revision=0,
        window=0,
        texture=texture,
        origin=np.array([-1.2, -0.8]),
        px_per_unit=40.0,
        normal_world=np.array([0.0, 0.0, -1.0]),
        distance=1.0,
    )
    u, v = -1.2 + 66 / 40, -0.8 + 22 / 40
    T = se3.pose(se3.exp_so3([0.02, -0.03, 0.1]), [0.1, -0.15, 0.05])
    seen = images.map_seen_from(revision, T, CAMERA)
    p = se3.inverse(T) @ np.array([u, v, 1.0, 1.0])
    x, y = CAMERA.fx * p[0] / p[2] + CAMERA.cx, CAMERA.fy * p[1] / p[2] + CAMERA.cy
    row, column = np.unravel_index(int(seen.argmax()), seen.shape)
    assert abs(column - x) <= 1
    assert abs(row - y) <= 1
    away = se3.pose(se3.exp_so3([0.0, np.pi, 0.0]))
    assert not images.map_seen_from(revision, away, CAMERA).any(), "behind the camera there is no map"


def test_explained_and_unexplained_edges_differ() -> None:
    # The left half of the wall is known as edges, the right half is empty.
    texture = np.zeros((64, 96), dtype=np.uint8)
    texture[:, :48] = 255
    revision = MapRevision(
        revision=0,
        window=0,
        texture=texture,
        origin=np.array([-1.2, -0.8]),
        px_per_unit=40.0,
        normal_world=np.array([0.0, 0.0, -1.0]),
        distance=1.0,
    )
    window = window_of([(5, 10)] * 3 + [(40, 20)] * 3)
    rgb = images.overlay_picture([still(window)], np.eye(4), revision, CAMERA, ImageOptions()).rgb()
    np.testing.assert_allclose(rgb[10, 5], images.EXPLAINED, atol=3)
    np.testing.assert_allclose(rgb[20, 40], images.UNEXPLAINED, atol=3)
    np.testing.assert_allclose(rgb[25, 5], images.MAP, atol=3)
    np.testing.assert_allclose(rgb[5, 40], images.BACKGROUND, atol=3)
    bare = images.overlay_picture([still(window)], np.eye(4), None, CAMERA, ImageOptions()).rgb()
    np.testing.assert_allclose(bare[10, 5], images.UNEXPLAINED, atol=3)


def test_a_lost_pose_behind_the_plane_is_still_drawn() -> None:
    T = se3.pose(position=[0.0, 0.0, 3.0])
    picture = images.warped_picture([still(window_of([(20, 5)]), T)], T, WALL, CAMERA, ImageOptions())
    assert lit(picture) >= {(20, 5)}


def test_png_is_lossless() -> None:
    rng = np.random.default_rng(3)
    picture = Picture(
        pixels=rng.integers(0, 256, (32, 48)).astype(np.uint8),
        palette=rng.integers(0, 256, (256, 3)).astype(np.uint8),
    )
    decoded = cv2.imdecode(np.frombuffer(picture.png(), np.uint8), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(decoded, picture.rgb())


@pytest.mark.parametrize("scale", [0, 5])
def test_scale_is_bounded(scale: int) -> None:
    with pytest.raises(ValueError, match="scale"):
        ImageOptions(scale=scale)


def test_only_the_wanted_polarity_is_drawn() -> None:
    both = [window_of([(20, 5)] * 3), window_of([(30, 9)] * 3, positive=False)]
    on = lit(images.raw_picture(both, CAMERA, ImageOptions(events=Polarities.ON)))
    off = lit(
        images.warped_picture(
            [still(w) for w in both], np.eye(4), WALL, CAMERA, ImageOptions(events=Polarities.OFF)
        )
    )
    assert on == {(20, 5)}
    assert off == {(30, 9)}


def test_several_windows_are_laid_on_each_other_by_their_poses() -> None:
    # The camera has moved 4 px to the right and turned a little: the second window shows the same point elsewhere.
    T = se3.pose(se3.exp_so3([0.0, 0.02, 0.05]), [4 / CAMERA.fx, 0.0, 0.1])
    seen_from_first = (20, 12)
    p = np.array([*CAMERA.bearings([seen_from_first])[0], 1.0])
    q = (se3.inverse(T) @ [*p, 1.0])[:3]
    x, y = CAMERA.fx * q[0] / q[2] + CAMERA.cx, CAMERA.fy * q[1] / q[2] + CAMERA.cy
    second = window_of([(round(x), round(y))])
    parts = [still(window_of([seen_from_first])), still(second, T)]
    picture = images.warped_picture(parts, np.eye(4), WALL, CAMERA, ImageOptions(polarity=False))
    row, column = np.unravel_index(int(picture.pixels.argmax()), picture.pixels.shape)
    assert (column, row) == seen_from_first
    assert {(abs(u - 20) <= 1, abs(v - 12) <= 1) for u, v in lit(picture)} == {(True, True)}


@pytest.mark.parametrize("wrong", [{"windows": 0}, {"windows": 65}, {"ms": -1.0}, {"ms": 1001.0}])
def test_accumulation_is_bounded(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ImageOptions(**wrong)  # type: ignore[arg-type]
