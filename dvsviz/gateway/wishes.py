"""What the page asks for, read from JSON with every value checked: settings, cameras, filters, poses, names."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, fields
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from dvsviz.config import TrackerConfig
from dvsviz.events.filters import FilterConfig
from dvsviz.export.writers import Part
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera

_NUMBERS = ("fx", "fy", "cx", "cy")
_LONGEST_TAG, _MOST_TAGS = 40, 20
# The largest whole number of a page, 2^53; and no setting is as large as this: whole numbers beyond are no floats.
_MOST_COUNTED = 1 << 53
_LARGEST = 1e300


def config_fields() -> list[dict[str, Any]]:
    """Return the tracker's settings as a form needs them: name, kind, choices, default, whether it may be left out."""
    hints, default = get_type_hints(TrackerConfig), asdict(TrackerConfig())
    found = []
    for name in (field.name for field in fields(TrackerConfig)):
        kinds = [kind for kind in get_args(hints[name]) or (hints[name],) if kind is not NoneType]
        is_choice = get_origin(hints[name]) is Literal
        kind = {bool: "flag", int: "whole", float: "number"}.get(kinds[0], "text") if not is_choice else "choice"
        found.append(
            {
                "name": name,
                "kind": kind,
                "choices": list(kinds) if is_choice else [],
                "default": default[name],
                "optional": NoneType in get_args(hints[name]),
            }
        )
    return found


def config_from(values: object, base: TrackerConfig | None = None) -> TrackerConfig:
    """Return settings: those of `base` with what the page said instead.

    Raises:
        ConfigError: a setting is not known or out of range.
        ValueError: they are no object.
    """
    said = _object(values, "config")
    return TrackerConfig.from_json(json.dumps(asdict(base or TrackerConfig()) | said))


def camera_from(values: object, recorded: Camera) -> Camera | None:
    """Return the calibration that the page said, None where it is the recorded one.

    Raises:
        ValueError: a value is missing or makes no sense.
    """
    if values is None:
        return None
    said = _object(values, "camera")
    distortion = said.get("distortion")
    if not isinstance(distortion, list) or len(distortion) != 5:
        raise ValueError("distortion: expected five numbers: k1, k2, p1, p2, k3")
    k1, k2, p1, p2, k3 = (_number(value, "distortion") for value in distortion)
    f = {name: _number(said.get(name), name) for name in _NUMBERS}
    size = max(recorded.width, recorded.height)
    for name in ("fx", "fy"):
        if not 0.05 * size <= f[name] <= 200 * size:
            raise ValueError(f"{name}: expected {0.05 * size:g} to {200 * size:g} px, got {f[name]:g}")
    for name, side in (("cx", recorded.width), ("cy", recorded.height)):
        if not -side <= f[name] <= 2 * side:
            raise ValueError(f"{name}: expected {-side} to {2 * side} px, got {f[name]:g}")
    camera = Camera(
        width=recorded.width,
        height=recorded.height,
        fx=f["fx"],
        fy=f["fy"],
        cx=f["cx"],
        cy=f["cy"],
        distortion=(k1, k2, p1, p2, k3),
    )
    same = all(math.isclose(f[name], getattr(recorded, name), rel_tol=1e-9) for name in _NUMBERS)
    return None if same and np.allclose(camera.distortion, recorded.distortion, rtol=1e-9, atol=0) else camera


def filters_from(values: object) -> FilterConfig | None:
    """Return the filters that the page said, None where there are none.

    Raises:
        ValueError: one is not known or out of range.
    """
    if values is None:
        return None
    said = _object(values, "filters")
    for name in ("background_us", "refractory_us"):
        if said.get(name) is not None and (not isinstance(said[name], int) or isinstance(said[name], bool)):
            raise ValueError(f"{name}: expected a whole number of microseconds, got {said[name]!r}")
    if not isinstance(said.get("hot_pixels", False), bool):
        raise ValueError("hot_pixels: expected yes or no")
    filters = FilterConfig.from_json(json.dumps(said))
    return filters if filters.is_active else None


def pose_from(values: object) -> NDArray[np.float64] | None:
    """Return a pose `T_world_camera` (4, 4) of `{position, quaternion_wxyz}`, or None where none is said.

    Raises:
        ValueError: it is no pose.
    """
    if values is None:
        return None
    said = _object(values, "pose")
    parts = {}
    for name, count in (("position", 3), ("quaternion_wxyz", 4)):
        numbers = said.get(name)
        if not isinstance(numbers, list) or len(numbers) != count:
            raise ValueError(f"{name}: expected {count} numbers")
        parts[name] = np.array([_number(value, name) for value in numbers])
    size = float(np.linalg.norm(parts["quaternion_wxyz"]))
    if not 0.5 < size < 2 or np.abs(parts["position"]).max() > 1e3:
        raise ValueError("pose: expected a unit quaternion and a position within 1000 plane distances")
    return se3.pose(se3.rotation_from_quaternion(parts["quaternion_wxyz"] / size), parts["position"])


def seconds_from(value: object, name: str) -> float | None:
    """Return a time in seconds, or None where none is said.

    Raises:
        ValueError: it is no number, or below 0.
    """
    if value is None:
        return None
    seconds = _number(value, name)
    if seconds < 0:
        raise ValueError(f"{name}: expected at least 0 s, got {seconds:g}")
    return seconds


def tags_from(value: object) -> tuple[str, ...]:
    """Return tags, trimmed, each once.

    Raises:
        ValueError: they are no list of texts, or too many or too long.
    """
    if not isinstance(value, list) or not all(isinstance(tag, str) for tag in value):
        raise ValueError("tags: expected a list of texts")
    tags = tuple(dict.fromkeys(" ".join(tag.split()) for tag in value if tag.strip()))
    if len(tags) > _MOST_TAGS or any(len(tag) > _LONGEST_TAG for tag in tags):
        raise ValueError(f"tags: expected at most {_MOST_TAGS} of up to {_LONGEST_TAG} characters")
    return tags


def text_from(value: object, name: str) -> str:
    """Return a text.

    Raises:
        ValueError: it is none.
    """
    if not isinstance(value, str):
        raise ValueError(f"{name}: expected a text")
    return value


def whole_from(value: object, name: str) -> int:
    """Return a whole number.

    Raises:
        ValueError: it is none.
    """
    if not isinstance(value, int) or isinstance(value, bool):
        raise ValueError(f"{name}: expected a whole number, got {value!r}")
    return value


def whole_or_none(value: object) -> int | None:
    """Return a number that answers are marked by, None where it is none that a page counts to."""
    if not isinstance(value, int) or isinstance(value, bool):
        return None
    return value if abs(value) <= _MOST_COUNTED else None


def _object(values: object, name: str) -> dict[str, Any]:
    if not isinstance(values, dict):
        raise ValueError(f"{name}: expected an object")
    return values


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST:
        raise ValueError(f"{name}: expected a number, got {str(value)[:40]}")
    return float(value)


def part_from(body: dict[str, Any]) -> Part:
    """Return the part of a session's time that an export is asked of: `start_s`, `end_s`, `speed`, each may be absent.

    Raises:
        ValueError: one is no number.
    """
    found: dict[str, float] = {}
    for name in ("start_s", "end_s", "speed"):
        if body.get(name) is not None:
            found[name] = _number(body[name], name)
    return Part(**found)
