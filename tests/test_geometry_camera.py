"""The pinhole camera: known pixels, exact undistortion over the whole sensor, non-square sensors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvsviz.geometry.camera import Camera

# Coefficients of real lenses: DAVIS240C with a wide lens, DAVIS346 with a strong barrel, a slight pincushion with
# large tangential terms.
WIDE = (-0.368436, 0.150947, -0.000296, -0.000760, 0.0)
BARREL = (-0.4236, 0.2306, 0.0013, -0.0009, 0.0)
TANGENTIAL = (0.12, -0.05, 0.004, -0.006, 0.01)


def cameras() -> list[Camera]:
    return [
        Camera(width=240, height=180, fx=199.09, fy=198.83, cx=132.19, cy=110.71, distortion=WIDE),
        Camera(width=346, height=260, fx=252.0, fy=256.5, cx=171.3, cy=128.9, distortion=BARREL),
        Camera(width=64, height=200, fx=150.0, fy=70.0, cx=20.0, cy=120.0, distortion=TANGENTIAL),
        Camera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0),
    ]


@pytest.mark.parametrize("camera", cameras(), ids=["wide", "barrel", "tangential", "ideal"])
def test_round_trip_over_the_whole_sensor(camera: Camera) -> None:
    x, y = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height))
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    pixels.setflags(write=False)
    back = camera.project(camera.bearings(pixels))
    assert np.abs(back - pixels).max() < 1e-6


def test_origin_is_the_centre_of_the_top_left_pixel() -> None:
    camera = Camera(width=240, height=180, fx=200.0, fy=100.0, cx=0.0, cy=0.0)
    np.testing.assert_array_equal(camera.bearings([[0, 0]]), [[0.0, 0.0]])
    np.testing.assert_array_equal(camera.bearings([[200, 100], [100, 0]]), [[1.0, 1.0], [0.5, 0.0]])
    centred = Camera.guess(5, 3)
    assert (centred.cx, centred.cy) == (2.0, 1.0)
    assert centred.is_guess


def test_distorted_pixel_by_hand() -> None:
    camera = Camera(width=9, height=7, fx=10.0, fy=20.0, cx=4.0, cy=3.0, distortion=(0.1, 0.01, 0.002, 0.003, 0.5))
    x, y = 0.3, -0.2
    r2 = 0.13
    radial = 1 + 0.1 * r2 + 0.01 * r2**2 + 0.5 * r2**3
    xd = x * radial + 2 * 0.002 * x * y + 0.003 * (r2 + 2 * x * x)
    yd = y * radial + 0.002 * (r2 + 2 * y * y) + 2 * 0.003 * x * y
    np.testing.assert_allclose(camera.project([[x, y]]), [[4 + 10 * xd, 3 + 20 * yd]], rtol=1e-15)


def test_bearing_table_is_indexed_row_then_column_and_read_only() -> None:
    camera = cameras()[0]
    table = camera.bearing_table()
    assert table.shape == (180, 240, 2)
    assert table.dtype == np.float32
    assert not table.flags.writeable
    np.testing.assert_allclose(table[10, 200], camera.bearings([[200, 10]])[0], atol=1e-7)
    assert table is camera.bearing_table()


@given(st.integers(1, 50), st.integers(1, 50), st.floats(10, 500), st.floats(10, 500))
def test_ideal_camera_inverts_exactly(width: int, height: int, fx: float, fy: float) -> None:
    camera = Camera(width=width, height=height, fx=fx, fy=fy, cx=width / 3, cy=height / 2)
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]])
    np.testing.assert_allclose(camera.project(camera.bearings(corners)), corners, atol=1e-12)
    np.testing.assert_allclose(
        np.column_stack([camera.bearings(corners), np.ones(4)]) @ camera.matrix.T,
        np.column_stack([corners, np.ones(4)]),
        atol=1e-12,
    )


def test_no_pixels_give_no_bearings() -> None:
    for camera in cameras():
        assert camera.bearings(np.zeros((0, 2))).shape == (0, 2)
        assert camera.project(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    "change",
    [
        {"width": 0},
        {"height": -1},
        {"fx": 0.0},
        {"fy": -3.0},
        {"cx": float("nan")},
        {"distortion": (0.0, 0.0, 0.0, float("inf"), 0.0)},
        {"distortion": (0.0, 0.0, 0.0, 0.0)},
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, object]) -> None:
    values: dict[str, object] = {"width": 4, "height": 3, "fx": 1.0, "fy": 1.0, "cx": 2.0, "cy": 1.5} | change
    with pytest.raises(ValueError, match="expected"):
        Camera(**values)  # pyright: ignore[reportArgumentType]
