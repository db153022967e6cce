"""What a session says about itself: the recording, the camera, the configuration, the program."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.camera import Camera

# `recording_format` of a stream that was tracked as it arrived.
STREAM_FORMAT = "live stream"
_TEXTS = ("recording_path", "recording_name", "recording_format", "config_json", "program_version", "created")
_INTEGERS = ("events", "first_us", "last_us", "seed")
_LENGTHS = ("mean_plane_distance", "plane_distance_world")
_CAMERA_NUMBERS = ("fx", "fy", "cx", "cy")
_PART = ("start_us", "end_us")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Origin:
    """Where a branch comes from: the session that was tried again, and what was changed.

    Attributes:
        session: name of that session then.
        created: its header's `created`, which stays when it is renamed.
        window: first window that was tracked anew; those before it were copied.
        config_json: that session's `TrackerConfig.to_json()`.
        changes: settings that were changed, each as `[before, after]`.
        T_world_camera: pose (4, 4) that the window was started from, or None where the tracker's own was kept.
        origin: where that session itself comes from, or None.
    """

    session: str
    created: str
    window: int
    config_json: str
    changes: dict[str, tuple[Any, Any]]
    T_world_camera: NDArray[np.float64] | None = None
    origin: Origin | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return it as an object for JSON."""
        return {
            "session": self.session,
            "created": self.created,
            "window": self.window,
            "config": self.config_json,
            "changes": {name: list(change) for name, change in self.changes.items()},
            "T_world_camera": None if self.T_world_camera is None else self.T_world_camera.tolist(),
            "origin": None if self.origin is None else self.origin.to_dict(),
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Origin:
        """Return what `to_dict` made.

        Raises:
            KeyError, TypeError, ValueError: it is something else.
        """
        pose, origin = values["T_world_camera"], values["origin"]
        T = None if pose is None else np.array(pose, dtype=np.float64)
        if T is not None and (T.shape != (4, 4) or not np.all(np.isfinite(T))):
            raise ValueError(f"origin: expected a pose (4, 4), got {T.shape}")
        return cls(
            session=_text(values["session"]),
            created=_text(values["created"]),
            window=int(values["window"]),
            config_json=_text(values["config"]),
            changes={str(name): (before, after) for name, (before, after) in values["changes"].items()},
            T_world_camera=T,
            origin=None if origin is None else cls.from_dict(origin),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SessionHeader:
    """What was run; written once, when a session is created.

    Attributes:
        recording_path: where the recording was; of a stream that was not recorded its address, no absolute path.
        recording_name: its stem.
        recording_format: its layout, as `dvsviz info` prints it.
        events: events in the recording; 0 where it was a stream, of which nobody knew yet.
        first_us: time of its first event.
        last_us: time of its last event.
        camera: calibration that was used.
        config_json: `TrackerConfig.to_json()`.
        program_version: version of dvsviz that wrote it.
        seed: of every random choice.
        created: ISO 8601 date and time with offset.
        mean_plane_distance: metres, or None.
        plane_normal_world: unit normal (3,) of the true plane in the ground truth's world, or None.
        plane_distance_world: its distance from that world's origin, m, or None.
        filters_json: what the recording's events were filtered by (`FilterConfig.to_json()`), or None; `events` and
            the indices of windows count the events that were kept.
        start_us: where tracking began, or None at the recording's first event.
        end_us: where tracking was to end, or None at the recording's last event.
        origin: the session that this one is a branch of, or None.
    """

    recording_path: str
    recording_name: str
    recording_format: str
    events: int
    first_us: int
    last_us: int
    camera: Camera
    config_json: str = "{}"
    program_version: str = ""
    seed: int = 0
    created: str = ""
    mean_plane_distance: float | None = None
    plane_normal_world: NDArray[np.float64] | None = None
    plane_distance_world: float | None = None
    filters_json: str | None = None
    start_us: int | None = None
    end_us: int | None = None
    origin: Origin | None = None

    @property
    def duration_s(self) -> float:
        """Seconds from the recording's first to its last event."""
        return (self.last_us - self.first_us) * 1e-6

    @property
    def is_stream(self) -> bool:
        """Whether events were tracked as they arrived."""
        return self.recording_format == STREAM_FORMAT

    @property
    def part_s(self) -> tuple[float, float]:
        """Start and end of what is tracked, seconds from the recording's first event."""
        start = self.first_us if self.start_us is None else self.start_us
        end = self.last_us if self.end_us is None else min(self.end_us, self.last_us)
        return (start - self.first_us) * 1e-6, (end - self.first_us) * 1e-6


def write_header(file: h5py.File, header: SessionHeader) -> None:
    """Write a header as attributes of the root and of `camera`; what is None is left out."""
    for field in dataclasses.fields(header):
        value = getattr(header, field.name)
        if value is not None and field.name not in ("camera", "origin"):
            file.attrs[field.name] = value
    if header.origin is not None:
        file.attrs["origin_json"] = json.dumps(header.origin.to_dict())
    camera = file.create_group("camera")
    camera.attrs["width"], camera.attrs["height"] = header.camera.width, header.camera.height
    for name in _CAMERA_NUMBERS:
        camera.attrs[name] = getattr(header.camera, name)
    camera.attrs["distortion"] = np.array(header.camera.distortion, dtype=np.float64)
    camera.attrs["is_guess"] = header.camera.is_guess


def read_header(file: h5py.File) -> SessionHeader:
    """Return the header of an open session file.

    Raises:
        KeyError, TypeError, ValueError: an attribute is missing or of the wrong kind.
    """
    a = dict[str, Any](file.attrs.items())
    normal = np.asarray(a["plane_normal_world"], dtype=np.float64) if "plane_normal_world" in a else None
    if normal is not None and normal.shape != (3,):
        raise ValueError(f"plane_normal_world: expected (3,), got {normal.shape}")
    values: dict[str, Any] = {name: _text(a[name]) for name in _TEXTS}
    values |= {name: int(a[name]) for name in _INTEGERS}
    values |= {name: float(a[name]) for name in _LENGTHS if name in a}
    values |= {name: int(a[name]) for name in _PART if name in a}
    filters = _text(a["filters_json"]) if "filters_json" in a else None
    origin = Origin.from_dict(json.loads(_text(a["origin_json"]))) if "origin_json" in a else None
    return SessionHeader(
        filters_json=filters, plane_normal_world=normal, camera=_read_camera(file), origin=origin, **values
    )


def _read_camera(file: h5py.File) -> Camera:
    a = dict[str, Any](file["camera"].attrs.items())
    distortion = np.asarray(a["distortion"], dtype=np.float64)
    if distortion.shape != (5,):
        raise ValueError(f"camera distortion: expected (5,), got {distortion.shape}")
    k1, k2, p1, p2, k3 = (float(value) for value in distortion)
    return Camera(
        width=int(a["width"]),
        height=int(a["height"]),
        distortion=(k1, k2, p1, p2, k3),
        is_guess=bool(a["is_guess"]),
        **{name: float(a[name]) for name in _CAMERA_NUMBERS},
    )


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected text, got {type(value).__name__}")
    return value
