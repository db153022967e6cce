"""What the simulator writes besides our own recording: the TUM RGB-D layout and the UZH text, read back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvsviz.events.events import Events
from dvsviz.events.recording import Imu, MemoryEvents, Recording
from dvsviz.formats.hdf5 import read_recording
from dvsviz.formats.open import open_recording
from dvsviz.formats.uzh_writer import write_uzh
from dvsviz.geometry.camera import Camera
from dvsviz.registration.frames import open_frames
from dvsviz.simulate.motion import slider
from dvsviz.simulate.relief import ReliefView
from dvsviz.simulate.render import PixelGrid
from dvsviz.simulate.rgbd import PERFECT, RgbdModel, simulate_rgbd
from dvsviz.simulate.rooms import make_relief
from dvsviz.simulate.simulate import simulate, wall
from dvsviz.simulate.texture import Texture, make_texture

SMALL = Camera(
    width=90, height=60, fx=80.1, fy=80.3, cx=44.5, cy=29.7, distortion=(-0.05, 0.01, 1e-4, -2e-4, 0.003)
)


def test_rgbd_is_read_back_as_it_was_seen(tmp_path: Path) -> None:
    out = tmp_path / "flight"
    simulate_rgbd(out, scene="boxes", seconds=0.4, rate_hz=10.0, camera=SMALL, model=PERFECT, seed=3)
    frames = open_frames(out)
    assert frames.camera == SMALL
    assert frames.t_us.tolist() == [0, 100_000, 200_000, 300_000, 400_000]
    assert frames.ground_truth is not None
    poses = frames.ground_truth.at(frames.t_us).Ts_world_camera
    view = ReliefView(PixelGrid.of(SMALL), make_relief("boxes", np.random.default_rng([3, 1])))
    for k in (0, 4):
        frame = frames.read(k)
        assert frame.depth is not None
        true = view.depth(poses[k])
        # Half a unit of 1/5000 m; the poses are written with nine decimals.
        assert np.nanmax(np.abs(frame.depth - true)) < 0.5 / 5000 + 1e-6
        assert np.isfinite(frame.depth).all()
        assert frame.grey.std() > 5
    assert np.linalg.norm(poses[4, :3, 3] - poses[0, :3, 3]) > 0.001


def test_noise_and_holes_of_the_rgbd_camera(tmp_path: Path) -> None:
    for name, model in (("ideal", PERFECT), ("real", RgbdModel())):
        simulate_rgbd(
            tmp_path / name, scene="planes", motion=slider(speed=0.1, start=0.0), seconds=0.1, rate_hz=10.0,
            camera=SMALL, model=model,
        )  # fmt: skip
    ideal, real = (open_frames(tmp_path / name).read(1).depth for name in ("ideal", "real"))
    assert ideal is not None and real is not None
    assert 0.01 < np.isnan(real).mean() < 0.3
    error = (real - ideal)[np.isfinite(real)] / ideal[np.isfinite(real)] ** 2
    assert error.std() == pytest.approx(0.0015, rel=0.05)


def test_events_and_rgbd_of_one_seed_are_one_flight(tmp_path: Path) -> None:
    simulate_rgbd(tmp_path / "frames", scene="boxes", motion="circle", seconds=0.2, camera=SMALL, seed=5)
    simulate(tmp_path / "a.h5", scene="boxes", motion="circle", seconds=0.2, camera=SMALL, seed=5)
    events, frames = read_recording(tmp_path / "a.h5").ground_truth, open_frames(tmp_path / "frames").ground_truth
    assert events is not None and frames is not None
    both = events.t_us[frames.covers(events.t_us)]
    there = events.at(both).Ts_world_camera
    assert np.allclose(there, frames.at(both).Ts_world_camera, atol=1e-5)


def test_rgbd_of_a_wall_is_the_wall_of_the_events(tmp_path: Path) -> None:
    """Light: the intensity frames of the recording. Depth: the plane."""
    options: dict = {
        "scene": "poster",
        "motion": "shake",
        "seconds": 0.3,
        "camera": SMALL,
        "seed": 2,
        "tilt_deg": 20.0,
    }
    simulate(tmp_path / "a.h5", frames_hz=10.0, **options)
    simulate_rgbd(tmp_path / "frames", rate_hz=10.0, model=PERFECT, **options)
    recording, frames = read_recording(tmp_path / "a.h5"), open_frames(tmp_path / "frames")
    assert recording.frames is not None and frames.ground_truth is not None
    first = frames.read(0)
    # The next frames of a recording are those of its next step, not of a time.
    difference = recording.frames.read(0).astype(int) - first.grey
    assert np.abs(difference).max() <= 2 and first.grey.std() > 20
    T, plane = frames.ground_truth.at(frames.t_us).Ts_world_camera[3], wall(1.0, 20.0)
    rays = SMALL.bearing_table().reshape(-1, 2)
    seen = plane.seen_from(T)
    expected = -seen.distance / (np.column_stack([rays, np.ones(len(rays))]) @ seen.normal)
    depth = frames.read(3).depth
    assert depth is not None
    np.testing.assert_allclose(depth.ravel(), expected, atol=1.5e-4)


def test_an_open_shutter_blurs_along_the_motion(tmp_path: Path) -> None:
    """Stripes that move by one period while it is open are gone; the depth is as it was."""

    def stripes(rng: np.random.Generator, bounds: tuple, texel: float) -> Texture:
        columns, rows = int((bounds[2] - bounds[0]) / texel), int((bounds[3] - bounds[1]) / texel)
        u = bounds[0] + (np.arange(columns) + 0.5) * texel
        image = np.repeat(0.5 + 0.4 * np.sin(2 * np.pi * u / 0.1)[None], rows, axis=0)
        return make_texture(image.astype(np.float32), texel=texel, left=bounds[0], top=bounds[1])

    options: dict = {
        "scene": stripes,
        "motion": slider(speed=1.0),
        "seconds": 0.4,
        "camera": SMALL,
        "model": PERFECT,
    }
    for name, exposure in (("sharp", 0.0), ("half", 0.05), ("gone", 0.1)):
        simulate_rgbd(tmp_path / name, rate_hz=5.0, exposure_s=exposure, tilt_deg=0.0, **options)
    sharp, half, gone = (open_frames(tmp_path / name).read(1) for name in ("sharp", "half", "gone"))
    assert gone.grey.std() < 0.03 * sharp.grey.std()
    # The mean of a sinusoid over half its period is 2 / pi of it.
    assert half.grey.std() == pytest.approx(2 / np.pi * sharp.grey.std(), rel=0.03)
    assert sharp.depth is not None and gone.depth is not None
    np.testing.assert_array_equal(sharp.depth, gone.depth)


def test_rgbd_refuses_rates_exposures_and_walls_behind(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rate_hz"):
        simulate_rgbd(tmp_path / "a", rate_hz=0.0)
    with pytest.raises(ValueError, match="exposure_s"):
        simulate_rgbd(tmp_path / "a", exposure_s=0.1)
    with pytest.raises(ValueError, match="tilt_deg"):
        simulate_rgbd(tmp_path / "a", scene="shapes", motion="handheld", tilt_deg=90)
    assert not (tmp_path / "a").exists()


def same(a: Recording, b: Recording) -> None:
    ea, eb = a.events.read(0, a.events.count), b.events.read(0, b.events.count)
    for name in ("t_us", "x_px", "y_px", "is_positive"):
        assert np.array_equal(getattr(ea, name), getattr(eb, name)), name
    assert a.camera == b.camera


def test_uzh_text_reads_back_equal(tmp_path: Path) -> None:
    simulate(tmp_path / "a.h5", seconds=0.3, camera=SMALL, frames_hz=20.0)
    written = read_recording(tmp_path / "a.h5")
    write_uzh(written, tmp_path / "text")
    read = open_recording(tmp_path / "text")
    assert read.format == "UZH text"
    same(written, read)
    assert written.ground_truth is not None and read.ground_truth is not None
    assert np.array_equal(written.ground_truth.t_us, read.ground_truth.t_us)
    assert np.allclose(written.ground_truth.Ts_world_camera, read.ground_truth.Ts_world_camera, atol=1e-14)
    assert written.imu is not None and read.imu is not None
    for name in ("t_us", "gyro", "accel"):
        assert np.array_equal(getattr(written.imu, name), getattr(read.imu, name)), name
    assert written.frames is not None and read.frames is not None
    assert np.array_equal(written.frames.t_us, read.frames.t_us)
    for k in range(len(read.frames.t_us)):
        assert np.array_equal(written.frames.read(k), read.frames.read(k))


def test_uzh_text_of_bare_events_at_hard_times(tmp_path: Path) -> None:
    events = Events(
        t_us=np.array([0, 1, 999_999, 1_000_000, 1_700_000_000_000_001]),
        x_px=np.array([0, 9, 10, 89, 5], np.uint16),
        y_px=np.array([59, 0, 7, 10, 5], np.uint16),
        is_positive=np.array([True, False, True, True, False]),
    )
    imu = Imu(t_us=np.array([5, 9]), gyro=np.ones((2, 3)), accel=np.full((2, 3), np.nan))
    bare = Recording(path=tmp_path, name="a", format="none", camera=SMALL, events=MemoryEvents(events), imu=imu)
    write_uzh(bare, tmp_path / "text")
    lines = (tmp_path / "text" / "events.txt").read_text().splitlines()
    assert lines == [
        "0.000000 0 59 1", "0.000001 9 0 0", "0.999999 10 7 1", "1.000000 89 10 1", "1700000000.000001 5 5 0",
    ]  # fmt: skip
    # A clock that jumps by 54 years is repaired away or refused when it is read: without it, all comes back.
    write_uzh(replace(bare, events=MemoryEvents(events[:4])), tmp_path / "text")
    read = open_recording(tmp_path / "text")
    same(replace(bare, events=MemoryEvents(events[:4])), read)
    assert read.imu is None and read.frames is None and read.ground_truth is None
