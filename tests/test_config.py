"""The frozen configuration: round trip, unknown keys and impossible values refused in one line."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvsviz.config import TrackerConfig
from dvsviz.errors import ConfigError, DvsvizError, FormatError


@given(
    st.sampled_from(["planar", "translation", "rotation"]),
    st.none() | st.integers(100, 5_000_000),
    st.floats(1, 10_000),
    st.none() | st.floats(1e-6, 1e5),
    st.integers(0, 2**63 - 1),
)
def test_json_round_trip(motion: str, window: int | None, ms: float, distance: float | None, seed: int) -> None:
    config = TrackerConfig(
        motion=motion,  # pyright: ignore[reportArgumentType]
        window=window,
        max_window_ms=ms,
        plane_distance=distance,
        seed=seed,
    )
    assert TrackerConfig.from_json(config.to_json()) == config


def test_settings_left_out_take_their_defaults() -> None:
    assert TrackerConfig.from_json("{}") == TrackerConfig()
    assert TrackerConfig.from_json('{"window": 2000}').window == 2000


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"windw": 100}', "unknown setting windw; known are imu, max_window_ms, mode, motion"),
        ('{"motion": "spiral"}', "motion: expected one of planar"),
        ('{"mode": "guess"}', "mode: expected one of map, contrast, got 'guess'"),
        ('{"objective": "entropy"}', "objective: expected one of variance, gradient, highpass, michelson"),
        ('{"window": 99}', "window: expected 100 to 5000000"),
        ('{"window": 5000001}', "window"),
        ('{"window": 1000.5}', "window: expected a whole number"),
        ('{"window": "many"}', "window: expected a whole number"),
        ('{"window": true}', "window: expected a whole number"),
        ('{"max_window_ms": 0.5}', "max_window_ms: expected 1 to 10000"),
        ('{"max_window_ms": NaN}', "max_window_ms"),
        ('{"max_window_ms": null}', "max_window_ms: expected a number"),
        ('{"plane_distance": 0}', "plane_distance: expected metres above 0"),
        ('{"plane_distance": Infinity}', "plane_distance"),
        ('{"plane_distance": "1 m"}', "plane_distance: expected a number"),
        ('{"seed": -1}', "seed: expected a whole number"),
        ('{"seed": null}', "seed: expected a whole number"),
        ("[1, 2]", "configuration: expected a JSON object"),
        ("{window: 3}", "configuration: expected a JSON object"),
    ],
)
def test_impossible_settings_are_refused_in_one_line(text: str, words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        TrackerConfig.from_json(text)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_every_setting_is_written() -> None:
    written = json.loads(TrackerConfig().to_json())
    assert set(written) == {
        "motion",
        "mode",
        "objective",
        "window",
        "max_window_ms",
        "plane_distance",
        "imu",
        "seed",
    }


def test_an_error_names_file_place_and_next_step() -> None:
    error = FormatError("expected 4 columns, got 3", path="a/events.txt", place="line 7", hint="give --repair")
    assert isinstance(error, DvsvizError)
    assert str(error) == "a/events.txt, line 7: expected 4 columns, got 3; give --repair"
    assert str(DvsvizError("nothing to do")) == "nothing to do"
