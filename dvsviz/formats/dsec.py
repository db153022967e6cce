"""What lies beside DSEC's events: `cam_to_cam.yaml` with the calibration, and the rectify map that was made of it.

The map says where every pixel lies in the rectified image. Alone it tells no focal length: the camera's model is taken
from the calibration, and where there is a map as well the two are compared.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.formats.calibration import read_calibration
from dvsviz.formats.checks import check_stored
from dvsviz.geometry.camera import Camera

CALIBRATION_NAME, MAP_NAME = "cam_to_cam.yaml", "rectify_map.h5"
# The published maps and calibrations of one sequence agree to some hundredths of a pixel.
_APART_PX = 1.0
_LOST = (
    "no calibration: the rectify map alone tells no focal length; give DSEC's cam_to_cam.yaml with --calibration"
)


def camera_name(path: Path) -> str:
    """Return how DSEC's calibration calls the camera of an events file: cam0, or cam3 for the right event camera."""
    return "cam3" if path.absolute().parent.name == "right" else "cam0"


def beside(path: Path) -> list[Path]:
    """Return the files of DSEC's layout that belong to an events file: the rectify map and calibrations, if there."""
    # <sequence>/events/left/events.h5 and <sequence>/calibration/cam_to_cam.yaml; or all in one folder.
    parents = path.absolute().parents[:3]
    places = [
        folder / inner for folder in parents for inner in (CALIBRATION_NAME, f"calibration/{CALIBRATION_NAME}")
    ]
    return [found for found in (path.parent / MAP_NAME, *places) if found.is_file()]


def dsec_camera(file: h5py.File, path: Path, size: tuple[int, int]) -> tuple[Camera, list[str]]:
    """Return the camera of a DSEC events file, a guess where no calibration lies beside it, and warnings.

    Args:
        file: the events, open.
        path: of the events.
        size: sensor (width, height), px.

    Raises:
        FormatError: what lies beside cannot be read.
    """
    calibration = next((found for found in beside(path) if found.name == CALIBRATION_NAME), None)
    mapped = _rectify_map(file, path)
    if calibration is None:
        return Camera.guess(*size), [] if mapped is None else [_LOST]
    camera = read_calibration(calibration, camera=camera_name(path)).camera(*size)
    warnings = [f"calibration taken from {calibration.name} beside the events"]
    rectified = None if mapped is None else _rectified(camera, calibration, camera_name(path)[3:])
    if mapped is None or rectified is None:
        return camera, warnings
    if mapped.shape != rectified.shape:
        return camera, [
            *warnings,
            f"the rectify map has {mapped.shape[1]}x{mapped.shape[0]} pixels: it is left aside",
        ]
    apart = float(np.nanmax(np.linalg.norm(mapped - rectified, axis=-1)))
    if not apart < _APART_PX:
        warnings.append(f"the rectify map is another calibration's, up to {apart:.1f} px apart: it is left aside")
    return camera, warnings


def _rectify_map(file: h5py.File, path: Path) -> NDArray[np.float64] | None:
    """Return the rectified place (height, width, 2), px, of every pixel, in the events' file or beside it; or None."""
    own, other = file.get("rectify_map"), path.parent / MAP_NAME
    if isinstance(own, h5py.Dataset):
        return _read(own, path)
    if not other.is_file():
        return None
    try:
        with h5py.File(other, "r") as found:
            dataset = found.get("rectify_map")
            return _read(dataset, other) if isinstance(dataset, h5py.Dataset) else None
    except (OSError, RuntimeError) as error:
        raise FormatError("a damaged HDF5 file", path=other, hint="copy it again, or remove it") from error


def _read(dataset: h5py.Dataset, path: Path) -> NDArray[np.float64]:
    check_stored(dataset, path)
    if dataset.ndim != 3 or dataset.shape[2] != 2:
        raise FormatError(f"expected (height, width, 2), got {dataset.shape}", path=path, place="rectify_map")
    return np.asarray(dataset, np.float64)


def _rectified(camera: Camera, calibration: Path, number: str) -> NDArray[np.float64] | None:
    """Return where the calibration rectifies every pixel to (height, width, 2), px; None where it does not say it."""
    values: Any = yaml.safe_load(calibration.read_text(encoding="utf-8"))
    try:
        fx, fy, cx, cy = map(float, values["intrinsics"][f"camRect{number}"]["camera_matrix"])
        R_rectified_camera = np.array(values["extrinsics"][f"R_rect{number}"], np.float64).reshape(3, 3)
    except (KeyError, TypeError, ValueError):
        return None
    table = camera.bearing_table().astype(np.float64)
    rays = np.concatenate([table, np.ones((*table.shape[:2], 1))], axis=-1) @ R_rectified_camera.T
    return rays[..., :2] / rays[..., 2:] * (fx, fy) + (cx, cy)
