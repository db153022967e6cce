"""The event camera: contrast over threshold, a slow reference, refractory time, leak and low-pass in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from dvsviz.events.events import Events
from dvsviz.simulate.event_camera import EventCamera, EventCameraModel

QUIET = {"leak_hz": 0.0, "shot_hz": 0.0, "hot_share": 0.0, "refractory_s": 0.0}


def uniform(log_intensity: float, shape: tuple[int, int] = (21, 34)) -> np.ndarray:
    return np.full(shape, np.exp(log_intensity), np.float32)


def brightening(model: EventCameraModel, *, seconds: float = 1.0, contrast: float = 2.0, steps: int = 40) -> Events:
    """Every pixel of a 34 x 21 sensor sees log intensity rise along a straight line."""
    camera = EventCamera(model, uniform(-2.0), 0.0, np.random.default_rng(0))
    image = uniform(-2.0)
    for k in range(1, steps + 1):
        image = uniform(-2.0 + contrast * k / steps)
        camera.step(image, seconds * k / steps)
    return camera.flush(image, seconds)


@pytest.mark.parametrize("threshold", [0.15, 0.25, 0.4])
def test_events_of_a_ramp_are_contrast_over_threshold(threshold: float) -> None:
    # A pixel begins anywhere between its thresholds, which costs half an event of the 15 to 40.
    model = EventCameraModel(threshold_on=threshold, threshold_off=threshold, **QUIET)
    events = brightening(model, contrast=6.0, steps=40)
    assert len(events) / (34 * 21) == pytest.approx(6.0 / threshold, rel=0.05)
    assert events.is_positive.all()
    assert np.all(np.diff(events.t_us) >= 0)
    # Non-square: every column and row of the 34 x 21 sensor fires.
    assert set(events.x_px) == set(range(34))
    assert set(events.y_px) == set(range(21))


def test_times_are_interpolated_within_a_step() -> None:
    model = EventCameraModel(threshold_on=0.25, threshold_sigma=0.0, **QUIET)
    coarse, fine = brightening(model, steps=1), brightening(model, steps=200)
    assert len(coarse) == len(fine)
    assert np.abs(np.sort(coarse.t_us) - np.sort(fine.t_us)).max() <= 2
    # One pixel's events come every threshold / slope = 0.125 s.
    one = coarse.t_us[(coarse.x_px == 5) & (coarse.y_px == 7)]
    assert np.allclose(np.diff(one), 125_000, atol=2)


def test_refractory_time_loses_the_contrast_it_is_blind_to() -> None:
    model = EventCameraModel(threshold_on=0.25, threshold_sigma=0.0, **{**QUIET, "refractory_s": 0.05})
    events = brightening(model)
    one = events.t_us[(events.x_px == 5) & (events.y_px == 7)]
    assert np.allclose(np.diff(one), 175_000, atol=2)


def test_leak_makes_positive_events_at_its_rate_in_the_dark() -> None:
    model = EventCameraModel(**{**QUIET, "leak_hz": 2.0})
    camera = EventCamera(model, uniform(-1.0), 0.0, np.random.default_rng(0))
    events = camera.flush(uniform(-1.0), 10.0)
    assert events.is_positive.all()
    assert len(events) / (34 * 21 * 10.0) == pytest.approx(2.0, rel=0.05)


def test_shot_noise_has_its_rate_and_both_signs() -> None:
    camera = EventCamera(
        EventCameraModel(**{**QUIET, "shot_hz": 3.0}), uniform(-1.0), 0.0, np.random.default_rng(0)
    )
    events = camera.flush(uniform(-1.0), 5.0)
    assert len(events) / (34 * 21 * 5.0) == pytest.approx(3.0, rel=0.05)
    assert 0.45 < events.is_positive.mean() < 0.55


def test_low_pass_follows_a_step_of_light_exponentially() -> None:
    # A jump of 1 at t = 0: the k-th threshold is passed at -tau ln(1 - level), tau = 1 / (2 pi 10 Hz).
    model = EventCameraModel(threshold_on=0.2, threshold_sigma=0.0, bandwidth_hz=10.0, **QUIET)
    camera = EventCamera(model, uniform(-1.0, (1, 1)), 0.0, np.random.default_rng(3))
    camera.step(uniform(0.0, (1, 1)), 1e-6)
    for k in range(1, 2001):
        camera.step(uniform(0.0, (1, 1)), 1e-6 + 1e-4 * k)
    events = camera.flush(uniform(0.0, (1, 1)), 0.21)
    tau = 1 / (20 * np.pi)
    level = 1 - np.exp(-events.t_us * 1e-6 / tau)
    assert len(events) in (4, 5)
    assert np.allclose(np.diff(level), 0.2, atol=2e-3)


def slow_reference(
    model: EventCameraModel, logs: np.ndarray, times: np.ndarray, camera: EventCamera
) -> list[tuple[int, int, int, bool]]:
    """The definition, pixel by pixel and in time steps of a third of a microsecond, without any shortcut."""
    out = []
    tau = 1 / (2 * np.pi * model.bandwidth_hz) if model.bandwidth_hz else 0.0
    fine = np.linspace(times[0], times[-1], 100_001 if tau else 400_001)
    for y in range(logs.shape[1]):
        for x in range(logs.shape[2]):
            light = np.interp(fine, times, logs[:, y, x])
            if tau:
                seen = np.empty_like(light)
                seen[0], h = light[0], (fine[1] - fine[0]) / tau
                for i in range(1, len(fine)):
                    seen[i] = seen[i - 1] + h * ((light[i] + light[i - 1]) / 2 - seen[i - 1])
                light = seen
            light = light + camera._leak[y, x] * fine
            memory, i = camera._memory[y, x], 0
            while i < len(fine):
                rises = light[i:] - memory >= camera._on[y, x]
                falls = memory - light[i:] >= camera._off[y, x]
                hit = np.flatnonzero(rises | falls)
                if len(hit) == 0:
                    break
                i += int(hit[0])
                out.append((int(fine[i] * 1e6), x, y, bool(rises[hit[0]])))
                if model.refractory_s:
                    i = int(np.searchsorted(fine, fine[i] + model.refractory_s))
                    memory = light[min(i, len(fine) - 1)]
                else:
                    memory += camera._on[y, x] if rises[hit[0]] else -camera._off[y, x]
    return sorted(out)


@pytest.mark.parametrize(
    "options", [{}, {"refractory_s": 3e-4}, {"refractory_s": 1e-3, "leak_hz": 20.0}, {"bandwidth_hz": 300.0}]
)
def test_fast_kernel_agrees_with_the_slow_definition(options: dict[str, float]) -> None:
    model = EventCameraModel(**{**QUIET, **options})
    rng = np.random.default_rng(5)
    shape, times = (3, 6), np.concatenate([[0.0], np.cumsum(rng.uniform(1e-4, 3e-3, 20))])
    logs = np.log(np.exp(rng.uniform(-2.0, 0.0, (21, *shape))).astype(np.float32)).astype(float)
    camera = EventCamera(model, np.exp(logs[0]).astype(np.float32), 0.0, rng)
    wanted = slow_reference(model, logs, times, camera)
    # The low-pass asks for images within its time constant (0.5 ms); without it a step is exact at any length.
    often = np.linspace(times[0], times[-1], 601) if model.bandwidth_hz else times
    for t in np.union1d(often, times)[1:]:
        now = np.apply_along_axis(lambda column, at=t: np.interp(at, times, column), 0, logs)
        camera.step(np.exp(now).astype(np.float32), t)
    events = camera.flush(np.exp(logs[20]).astype(np.float32), times[20])
    # An event on the edge of a threshold may fall on either side in one of them.
    assert abs(len(events) - len(wanted)) <= 0.01 * len(wanted)
    assert len(wanted) > 150
    compared, late = 0, []
    for y in range(3):
        for x in range(6):
            here = (events.x_px == x) & (events.y_px == y)
            mine = list(zip(events.t_us[here], events.is_positive[here], strict=True))
            theirs = [(t, p) for t, column, row, p in wanted if (column, row) == (x, y)]
            if len(mine) == len(theirs):
                compared += 1
                assert [p for _, p in mine] == [p for _, p in theirs]
                late += [abs(int(a[0]) - b[0]) for a, b in zip(mine, theirs, strict=True)]
    assert compared >= 16
    # Where the light hardly changes, the reference's own time step moves an event by more.
    assert np.quantile(late, 0.95) <= 6
    assert max(late) <= 60


def test_step_by_blocks_equals_step_everywhere() -> None:
    model = EventCameraModel(**QUIET)
    rng = np.random.default_rng(1)
    image = rng.uniform(0.1, 1.0, (21, 34)).astype(np.float32)
    cameras = [EventCamera(model, image, 0.0, np.random.default_rng(2)) for _ in range(2)]
    blocks = np.zeros(6 * 9, bool)
    for k in range(1, 30):
        block = int(rng.integers(0, len(blocks)))
        y, x = divmod(block, 9)
        patch = image[4 * y : 4 * y + 4, 4 * x : 4 * x + 4]
        patch[:] = rng.uniform(0.1, 1.0, patch.shape)
        blocks[:] = False
        blocks[block] = True
        # A block that rested is told of its rest just before it changes, or the change would begin too early.
        cameras[0].step(image, k * 0.01)
        cameras[1].step(image, k * 0.01, blocks)
    a, b = (camera.flush(image, 0.3) for camera in cameras)
    assert len(a) == len(b) > 0
    assert np.array_equal(np.bincount(a.x_px, minlength=34), np.bincount(b.x_px, minlength=34))


@pytest.mark.parametrize("bad", [{"threshold_on": 0.0}, {"threshold_sigma": 0.5}, {"leak_hz": -1.0}])
def test_impossible_sensors_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        EventCameraModel(**bad)
