"""Calibration files: Event-Camera-Dataset text, Kalibr YAML, ROS CameraInfo YAML, DSEC YAML, and our TOML."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import yaml

from dvsviz.errors import FormatError
from dvsviz.geometry.camera import Camera

_MAX_BYTES = 1 << 20
_TEXT_HINT = "expected one line `fx fy cx cy k1 k2 p1 p2 k3`"
_RADTAN = ("radtan", "plumb_bob", "radial-tangential", "none", "")


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """What a calibration file says.

    Attributes:
        fx: focal length in x, px.
        fy: focal length in y, px.
        cx: principal point column, px.
        cy: principal point row, px.
        distortion: k1, k2, p1, p2, k3.
        size: sensor (width, height), px; None where the file does not say it.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]
    size: tuple[int, int] | None = None

    def camera(self, width: int, height: int) -> Camera:
        """Return the calibrated camera of a sensor."""
        return Camera(
            width=width, height=height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, distortion=self.distortion
        )


def read_calibration(path: Path, *, camera: str = "cam0") -> Calibration:
    """Return the calibration in a file, its layout told by its content.

    Args:
        path: the file.
        camera: which one is taken of DSEC's `cam_to_cam.yaml`, which holds four.

    Raises:
        FormatError: no such file, no known layout, or numbers that are missing, too many or impossible.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise FormatError("too large for a calibration", path=path, hint=_TEXT_HINT)
        data = path.read_bytes()
    except OSError as error:
        hint = "check the path given with --calibration"
        raise FormatError(f"cannot be read: {error.strerror}", path=path, hint=hint) from error
    return parse_calibration(data, path, camera=camera)


def parse_calibration(data: bytes, path: Path, *, camera: str = "cam0") -> Calibration:
    """Return the calibration in the bytes of a file; `path` is named in errors."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError("not a text file", path=path, hint=_TEXT_HINT) from error
    lines = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    words = [word for line in lines for word in line]
    if not words:
        raise FormatError("holds no calibration", path=path, hint=_TEXT_HINT)
    if "=" in text and ":" not in text:
        return _from_toml(text, path)
    if ":" in text:
        return _from_yaml(text, path, camera)
    line = 1 + next(number for number, found in enumerate(lines) if found)
    # Some copies of the dataset add the sensor's `width height` on a second line.
    size = None
    if len(words) == 11 and all(word.isdigit() for word in words[9:]):
        size = _size(int(words[9]), int(words[10]), path)
    elif len(words) != 9:
        raise FormatError(f"expected 9 numbers, got {len(words)}", path=path, place=f"line {line}", hint=_TEXT_HINT)
    return _checked(words[:4], words[4:9], size, path, f"line {line}")


def _from_toml(text: str, path: Path) -> Calibration:
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FormatError(
            f"not valid TOML: {error}", path=path, hint="see docs/formats.md for the layout"
        ) from error
    size = _size(values.get("width"), values.get("height"), path) if "width" in values else None
    return _checked(
        [_key(values, name, path) for name in ("fx", "fy", "cx", "cy")], values.get("distortion", []), size, path
    )


def _from_yaml(text: str, path: Path, camera: str) -> Calibration:
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        place = (
            f"line {error.problem_mark.line + 1}"
            if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark
            else None
        )
        raise FormatError("not valid YAML", path=path, place=place, hint="write it again") from error
    if not isinstance(values, dict):
        _unknown(path)
    if isinstance(values.get("intrinsics"), dict):
        values = values["intrinsics"]
        if isinstance(values.get(camera), dict):
            return _from_kalibr(values[camera], path, camera)
    if isinstance(values.get("cam0"), dict):
        return _from_kalibr(values["cam0"], path, "cam0")
    if isinstance(values.get("camera_matrix"), dict):
        return _from_camera_info(values, path)
    if "fx" in values:
        size = _size(values.get("width"), values.get("height"), path) if "width" in values else None
        focal = [_key(values, name, path) for name in ("fx", "fy", "cx", "cy")]
        return _checked(focal, values.get("distortion", []), size, path)
    _unknown(path)


def _from_kalibr(camera: dict[str, Any], path: Path, name: str) -> Calibration:
    model = camera.get("camera_model", "pinhole")
    if model != "pinhole":
        _unsupported(f"camera model {model!r}", path)
    _check_model(camera.get("distortion_model", "radtan"), path)
    pinhole = camera.get("intrinsics", camera.get("camera_matrix"))
    if not isinstance(pinhole, list) or len(pinhole) != 4:
        raise FormatError("expected four intrinsics fx fy cx cy", path=path, place=name, hint="calibrate it again")
    resolution = camera.get("resolution")
    size = None
    if isinstance(resolution, list) and len(resolution) == 2:
        size = _size(resolution[0], resolution[1], path)
    return _checked(pinhole, camera.get("distortion_coeffs", []), size, path, name)


def _from_camera_info(values: dict[str, Any], path: Path) -> Calibration:
    _check_model(values.get("distortion_model", "plumb_bob"), path)
    matrix = values["camera_matrix"].get("data")
    if not isinstance(matrix, list) or len(matrix) != 9:
        raise FormatError("expected nine numbers", path=path, place="camera_matrix", hint="calibrate it again")
    coefficients = values.get("distortion_coefficients") or {}
    distortion = coefficients.get("data", []) if isinstance(coefficients, dict) else coefficients
    size = None
    if "image_width" in values:
        size = _size(values.get("image_width"), values.get("image_height"), path)
    return _checked([matrix[0], matrix[4], matrix[2], matrix[5]], distortion, size, path)


def _checked(
    pinhole: list[Any], distortion: Any, size: tuple[int, int] | None, path: Path, place: str | None = None
) -> Calibration:
    try:
        fx, fy, cx, cy = (float(value) for value in pinhole)
        k = [float(value) for value in distortion]
    except (TypeError, ValueError) as error:
        raise FormatError("not a number among its values", path=path, place=place, hint=_TEXT_HINT) from error
    if len(k) not in (0, 4, 5):
        hint = "only k1 k2 p1 p2 k3 are known"
        raise FormatError(f"expected 0, 4 or 5 distortion values, got {len(k)}", path=path, place=place, hint=hint)
    if not all(math.isfinite(value) for value in (fx, fy, cx, cy, *k)) or min(fx, fy) <= 0:
        hint = "calibrate it again"
        raise FormatError("expected finite values and focal lengths above 0", path=path, place=place, hint=hint)
    k1, k2, p1, p2, k3 = [*k, *[0.0] * (5 - len(k))]
    return Calibration(fx=fx, fy=fy, cx=cx, cy=cy, distortion=(k1, k2, p1, p2, k3), size=size)


def _key(values: dict[str, Any], name: str, path: Path) -> Any:
    if name not in values:
        raise FormatError(f"{name} is missing", path=path, hint="expected fx, fy, cx, cy and distortion")
    return values[name]


def _size(width: Any, height: Any, path: Path) -> tuple[int, int]:
    if not (isinstance(width, int) and isinstance(height, int) and 1 <= width <= 65_535 and 1 <= height <= 65_535):
        raise FormatError(f"expected a size in pixels, got {width!r} x {height!r}", path=path, hint="correct it")
    return width, height


def _check_model(model: Any, path: Path) -> None:
    if str(model).lower() not in _RADTAN:
        _unsupported(f"distortion model {model!r}", path)


def _unsupported(what: str, path: Path) -> NoReturn:
    hint = "calibrate with a pinhole model and radial-tangential distortion"
    raise FormatError(f"{what} is not supported", path=path, hint=hint)


def _unknown(path: Path) -> NoReturn:
    hint = "known are the Event Camera Dataset's calib.txt, Kalibr, ROS CameraInfo, DSEC and our TOML"
    raise FormatError("no calibration of a known layout", path=path, hint=hint)
