"""The gyroscope as a prior: turns, bias, and stretches that say nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_tracking_panorama import CAMERA, seen

from dvsviz.config import TrackerConfig
from dvsviz.errors import ConfigError
from dvsviz.events.events import Events
from dvsviz.events.inertial import imu_warnings, usable_imu
from dvsviz.events.recording import Imu, MemoryEvents, Recording
from dvsviz.events.windows import windows
from dvsviz.geometry import se3
from dvsviz.session.records import Status
from dvsviz.tracking import constants as c
from dvsviz.tracking.gyro import Gyro, prior_by_gyro
from dvsviz.tracking.tracker import Tracker

BIAS = np.array([0.03, -0.05, 0.02])
_EPOCH_US = 1_700_000_000_000_000


def swing(t_s: np.ndarray) -> np.ndarray:
    """Return rotations (N, 3, 3) of a camera that turns to and fro: at 0.75 s the other way round."""
    t = np.asarray(t_s, dtype=np.float64)
    return se3.exp_so3(np.stack([0.1 * np.sin(5 * t), 0.5 * np.sin(2 * np.pi * t / 1.5), 0 * t], axis=-1))


def measured(seconds: float, start_us: int = 0) -> Imu:
    """Return a 1 kHz sensor's rates of `swing`, with a bias and noise."""
    t = np.arange(-5, round(seconds * 1000) + 5) * 1e-3
    h = 1e-5
    gyro = se3.log_so3(np.swapaxes(swing(t - h), 1, 2) @ swing(t + h)) / (2 * h)
    noise = 0.003 * np.random.default_rng(1).standard_normal(gyro.shape)
    t_us = start_us + np.round(t * 1e6).astype(np.int64)
    return Imu(t_us=t_us, gyro=gyro + BIAS + noise, accel=np.full_like(gyro, np.nan))


def test_turn_is_that_of_the_camera() -> None:
    """Integrated rates less the bias give the rotation, wherever between samples it starts, in Unix time too."""
    gyro = Gyro(measured(2.0, _EPOCH_US))
    gyro.bias = BIAS
    for a, b in ((0.1003, 0.1009), (0.2, 0.23), (0.4001, 1.3337)):
        start, end = _EPOCH_US + round(a * 1e6), _EPOCH_US + round(b * 1e6)
        Ra, Rb = swing(np.array([a, b]))
        assert se3.rotation_angle(gyro.turn(start, end).T @ (Ra.T @ Rb)) < 5e-4
        assert gyro.covers(start, end)
    assert not gyro.covers(_EPOCH_US - 10_000, _EPOCH_US + 10_000)
    assert not gyro.covers(_EPOCH_US + 1_000_000, _EPOCH_US + 9_000_000)


def test_gaps_and_missing_rates_are_not_covered() -> None:
    imu = measured(1.0)
    away = (imu.t_us < 300_000) | (imu.t_us > 300_000 + 2 * c.GYRO_GAP_US)
    gyro = Gyro(Imu(t_us=imu.t_us[away], gyro=imu.gyro[away], accel=imu.accel[away]))
    assert gyro.covers(100_000, 200_000)
    assert not gyro.covers(250_000, 450_000)
    rates = imu.gyro.copy()
    rates[600] = np.nan
    assert not Gyro(Imu(t_us=imu.t_us, gyro=rates, accel=imu.accel)).covers(550_000, 650_000)


def test_bias_is_learnt_and_packed() -> None:
    """Ten seconds of well-tracked poses bring the bias to a twentieth of itself, and its deviation down with it."""
    gyro, rng = Gyro(measured(10.0)), np.random.default_rng(2)
    first = prior_by_gyro(gyro, 0.03, 0.03)
    for t_us in range(0, 10_000_000, 30_000):
        R = swing(np.array([t_us * 1e-6]))[0] @ se3.exp_so3(0.003 * rng.standard_normal(3))
        gyro.learn(t_us, R)
    assert np.abs(gyro.bias - BIAS).max() < 0.004
    assert np.sqrt(gyro.variance) < 0.01
    assert prior_by_gyro(gyro, 0.03, 0.03)[0, 0] > first[0, 0]
    # Unseen for a second: the turn and the position are known less well.
    later = prior_by_gyro(gyro, 0.03, 1.0)
    assert later[0, 0] < first[0, 0]
    assert later[3, 3] < first[3, 3]
    again = Gyro(measured(10.0))
    again.unpack(gyro.pack())
    assert np.array_equal(again.bias, gyro.bias)
    assert np.array_equal(again.turn(100_000, 400_000), gyro.turn(100_000, 400_000))


def blinded(events: Events, start_us: int, end_us: int) -> Events:
    """Return events of which a stretch keeps one in fifty, thrown all over the sensor."""
    rng = np.random.default_rng(3)
    inside = (events.t_us >= start_us) & (events.t_us < end_us)
    keep = ~inside | (rng.random(len(events)) < 0.02)
    x = np.where(inside, rng.integers(0, CAMERA.width, len(events)), events.x_px).astype(np.uint16)
    y = np.where(inside, rng.integers(0, CAMERA.height, len(events)), events.y_px).astype(np.uint16)
    return Events(t_us=events.t_us[keep], x_px=x[keep], y_px=y[keep], is_positive=events.is_positive[keep])


@pytest.fixture(scope="module")
def blank() -> Recording:
    """A camera that swings, and sees nothing while it turns round."""
    return Recording(
        path=Path("swing"),
        name="swing",
        format="memory",
        camera=CAMERA,
        events=MemoryEvents(blinded(seen(swing, 1.7), 700_000, 1_150_000)),
        imu=measured(1.7),
    )


@pytest.mark.parametrize("imu", ["auto", "off"])
def test_a_blank_stretch(blank: Recording, imu: str) -> None:
    """With the gyroscope the turn goes on through the blank; without it the camera is lost, or far off."""
    config = TrackerConfig(motion="rotation", imu=imu)  # pyright: ignore[reportArgumentType]
    tracker = Tracker(CAMERA, config, blank.imu)
    results, errors = [], []
    for window in windows(blank, lambda: tracker.window_size):
        results.append(tracker.step(window))
        tracker.take_updates()
        R = swing(np.array([0.0, window.start_us * 1e-6]))
        errors.append(se3.rotation_angle(results[-1].T_world_camera[:3, :3].T @ R[0].T @ R[1]))
    inside = np.array([700_000 < r.start_us < 1_150_000 for r in results])
    worst_deg = float(np.degrees(np.array(errors)[inside].max()))
    lost = any(r.status in (Status.LOST, Status.RELOCALIZING) for r in results)
    if imu == "off":
        assert lost or worst_deg > 5.0
        return
    assert not lost
    assert worst_deg < 2.5
    assert {r.status for r, blind in zip(results, inside, strict=True) if blind} >= {Status.WEAK}
    assert results[-1].status is Status.TRACKING
    assert np.degrees(errors[-1]) < 1.5


def test_setting_is_checked() -> None:
    with pytest.raises(ConfigError, match="imu: expected one of auto, off"):
        TrackerConfig(imu="on")  # pyright: ignore[reportArgumentType]


def test_measurements_that_cannot_be_right_are_told_and_not_used() -> None:
    """What is left is in order and finite, and the recorded arrays stay as they were."""
    imu = measured(1.0)
    gyro, back = imu.gyro.copy(), imu.t_us[::-1].copy()
    gyro[100:200], gyro[300] = np.nan, 1e12
    for column in (imu.t_us, imu.gyro, gyro, back):
        column.setflags(write=False)
    found, said = usable_imu(replace(imu, gyro=gyro))
    assert found is not None and len(found.t_us) == len(imu.t_us) - 101 and np.isfinite(found.gyro).all()
    assert [line.split(" rates ")[0] for line in said] == ["imu: 100 of 1010", "imu: 1 of 1010"]
    found, said = usable_imu(replace(imu, t_us=back))
    assert found is not None and (np.diff(found.t_us) > 0).all() and "backwards" in said[0]
    assert np.array_equal(found.gyro, imu.gyro[::-1])
    assert usable_imu(imu)[1] == ()
    for few in (replace(imu, t_us=np.zeros_like(imu.t_us)), replace(imu, gyro=np.full_like(gyro, np.inf))):
        assert usable_imu(few)[0] is None and "not used" in usable_imu(few)[1][-1]


def test_a_gyroscope_on_another_clock_is_told(blank: Recording) -> None:
    assert blank.imu is not None and imu_warnings(blank) == ()
    for shift in (-(10**12), 2**62):
        said = imu_warnings(replace(blank, imu=replace(blank.imu, t_us=blank.imu.t_us + shift)))
        assert len(said) == 1 and "clock" in said[0]


@pytest.mark.parametrize("wrong", ["the other way", "another axis", "degrees", "always"])
def test_a_gyroscope_that_lies_is_left_out(wrong: str) -> None:
    """Tracking is what it is without one, and it is told why."""
    recording = Recording(
        path=Path("swing"), name="swing", format="memory", camera=CAMERA, events=MemoryEvents(seen(swing, 0.9))
    )
    imu = measured(0.9)
    rates = {
        "the other way": -imu.gyro,
        "another axis": imu.gyro[:, [1, 2, 0]],
        "degrees": np.clip(np.degrees(imu.gyro), -60, 60),
        "always": np.full_like(imu.gyro, 5.0),
    }[wrong]
    ends = []
    for used in (None, replace(imu, gyro=rates)):
        tracker = Tracker(CAMERA, TrackerConfig(motion="rotation", imu="off" if used is None else "auto"), used)
        told: list[str] = []
        results = []
        for window in windows(recording, lambda tracker=tracker: tracker.window_size):
            results.append(tracker.step(window))
            told += [line.text for line in tracker.take_updates().log if "gyroscope" in line.text]
        assert all(r.status in (Status.TRACKING, Status.WEAK, Status.INITIALIZING) for r in results)
        assert len(told) == (used is not None), told
        ends.append(results[-1].T_world_camera)
    truth = swing(np.array([0.0, results[-1].start_us * 1e-6]))
    assert se3.rotation_angle(ends[0][:3, :3].T @ ends[1][:3, :3]) < 1e-3
    assert se3.rotation_angle(ends[1][:3, :3].T @ truth[0].T @ truth[1]) < 0.02


def test_trust_is_won_lost_and_won_again() -> None:
    """By agreement over a tenth of a second; after it was forsaken it has to agree for half a second."""
    imu = measured(6.0)
    rates = imu.gyro.copy()
    rates[2000:3000] += 2.0
    gyro = Gyro(replace(imu, gyro=rates))
    assert not gyro.knows(100_000, 130_000)
    told, trusted = [], []
    for t_us in range(0, 5_900_000, 25_000):
        told.append(gyro.check(t_us, swing(np.array([t_us * 1e-6]))[0]))
        trusted.append((t_us, gyro.knows(t_us, t_us + 20_000)))
    assert [text for text in told if text] == [
        "the gyroscope turns 3.5 rad/s off what is seen: it is left out until it agrees again"
    ]
    assert all(good for t, good in trusted if 200_000 < t < 2_000_000)
    assert not any(good for t, good in trusted if 2_400_000 < t < 3_300_000)
    assert all(good for t, good in trusted if t > 3_700_000)
    again = Gyro(imu)
    again.unpack(gyro.pack())
    assert again.trust == gyro.trust == c.GYRO_TRUST_MOST
    older = {name: values for name, values in gyro.pack().items() if name not in ("gyro_trust", "gyro_checked")}
    again.unpack(older)
    assert again.trust > 0
