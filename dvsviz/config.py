"""Frozen configuration: validated, unknown keys refused, written into every session."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, Self, get_args, get_type_hints

from dvsviz.errors import ConfigError

Motion = Literal["planar", "translation", "rotation", "auto"]
Mode = Literal["map", "contrast"]
Objective = Literal["variance", "gradient", "highpass", "michelson"]
ImuUse = Literal["auto", "off"]


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: object) -> bool:
    return _is_whole(value) or isinstance(value, float)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerConfig:
    """What a user may set about a tracker; everything else chooses itself.

    Attributes:
        motion: `planar` (6-DoF in front of a plane), `translation` (no rotation), `rotation` (no translation),
            `auto` (planar; where the first windows show that the scene is no plane, translation before a relief).
        mode: `map` (Gauss-Newton on the edge map), `contrast` (contrast maximization all through: slow, the reference).
        objective: what sharp means wherever contrast is maximised: `variance`, `gradient` (mean squared), and for study
            `highpass` and `michelson`.
        window: events a window; None lets the image motion choose.
        max_window_ms: a window also ends after this time.
        plane_distance: metres from the first camera to the plane, for metric output; None leaves d = 1.
        imu: `auto` predicts rotations with the recording's gyroscope where there is one, and bridges what says nothing.
        seed: of every random choice.
    """

    motion: Motion = "planar"
    mode: Mode = "map"
    objective: Objective = "variance"
    window: int | None = None
    max_window_ms: float = 100.0
    plane_distance: float | None = None
    imu: ImuUse = "off"
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, choices in (
            ("motion", self.motion, get_args(Motion)),
            ("mode", self.mode, get_args(Mode)),
            ("objective", self.objective, get_args(Objective)),
            ("imu", self.imu, get_args(ImuUse)),
        ):
            if value not in choices:
                raise ConfigError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")
        for name, value in (("max_window_ms", self.max_window_ms), ("plane_distance", self.plane_distance)):
            if not _is_number(value) and not (name == "plane_distance" and value is None):
                raise ConfigError(f"{name}: expected a number, got {value!r}")
        if self.window is not None and not _is_whole(self.window):
            raise ConfigError(f"window: expected a whole number of events, got {self.window!r}")
        if not _is_whole(self.seed) or not 0 <= self.seed < 1 << 63:
            raise ConfigError(f"seed: expected a whole number of at least 0, below 2^63, got {self.seed!r}")
        if self.window is not None and not 100 <= self.window <= 5_000_000:
            raise ConfigError(f"window: expected 100 to 5000000 events, got {self.window}")
        if not 1.0 <= self.max_window_ms <= 10_000.0:
            raise ConfigError(f"max_window_ms: expected 1 to 10000, got {self.max_window_ms}")
        if self.plane_distance is not None and not 0 < self.plane_distance < 1e6:
            raise ConfigError(f"plane_distance: expected metres above 0, got {self.plane_distance}")

    def to_json(self) -> str:
        """Return the configuration as one JSON object."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the configuration of a JSON object.

        Raises:
            ConfigError: the text is not a JSON object, a key is unknown, or a value is out of range.
        """
        try:
            values: Any = json.loads(text)
        except json.JSONDecodeError as error:
            raise ConfigError(f"configuration: expected a JSON object, got {text[:40]!r}") from error
        if not isinstance(values, dict):
            raise ConfigError(f"configuration: expected a JSON object, got {text[:40]!r}")
        known = {f.name for f in fields(cls)} & set(get_type_hints(cls))
        if unknown := sorted(set(values) - known):
            raise ConfigError(f"unknown setting {', '.join(unknown)}", hint=f"known are {', '.join(sorted(known))}")
        return cls(**values)
