"""Two sessions of one recording, or of one ground truth: laid on each other, and how far they are apart."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import DvsvizError, EvaluationError
from dvsviz.evaluate.align import align_positions, align_rotations
from dvsviz.evaluate.associate import associate, known_at
from dvsviz.evaluate.evaluate import evaluate
from dvsviz.evaluate.metrics import rmse, rotation_errors_deg
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.view.curves import axis_angles
from dvsviz.view.shown import ShownSession

Array = NDArray[np.float64]

_AXES = ("x", "y", "z", "pitch", "yaw", "roll")
_EVALUATED = ("position_rmse_percent_of_distance", "rotation_rmse_deg")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Laid:
    """A session laid into another one's world.

    Attributes:
        t_us: starts of its windows (N,).
        Ts_world_camera: its poses (N, 4, 4) in the other's world and plane distances.
        apart_percent: distance (N,) to the other's pose of that time in percent of the plane distance; NaN outside.
        apart_deg: angle (N,) to it.
        common: poses that the alignment rests on: those that neither lost.
        rmse_percent: root mean square distance of these, percent of the plane distance.
        rmse_deg: root mean square angle of these.
    """

    t_us: NDArray[np.int64]
    Ts_world_camera: Array
    apart_percent: Array
    apart_deg: Array
    common: int
    rmse_percent: float
    rmse_deg: float


def lay(other: ShownSession, base: ShownSession) -> Laid:
    """Return a session in another one's world, aligned by the poses of those times at which both know theirs.

    Positions are aligned with scale, rotations by themselves, as in an evaluation against truth.

    Raises:
        DvsvizError: they have no two poses of the same times.
    """
    known: Trajectory = base.session.trajectory()
    try:
        pairs = associate(other.session.trajectory(), known)
    except EvaluationError as error:
        raise DvsvizError(
            f"{other.name} and {base.name} cannot be laid on each other: they know no pose at the same time",
            hint="compare sessions of one recording",
        ) from error
    aligned = align_positions(pairs.Ts_estimate[:, :3, 3], pairs.Ts_truth[:, :3, 3], "sim3")
    R = align_rotations(pairs.Ts_estimate[:, :3, :3], pairs.Ts_truth[:, :3, :3])
    poses = other.poses()
    Ts = poses.copy()
    Ts[:, :3, :3], Ts[:, :3, 3] = R @ poses[:, :3, :3], aligned.positions(poses[:, :3, 3])
    t_us = np.asarray(other.session.columns()["start_us"][: len(Ts)], dtype=np.int64)
    percent, degrees = np.full(len(Ts), np.nan), np.full(len(Ts), np.nan)
    inside = known_at(known, t_us)
    there = known.at(t_us[inside]).Ts_world_camera
    percent[inside] = 100 * np.linalg.norm(Ts[inside, :3, 3] - there[:, :3, 3], axis=1)
    degrees[inside] = rotation_errors_deg(there[:, :3, :3], Ts[inside, :3, :3])
    apart = np.linalg.norm(aligned.positions(pairs.Ts_estimate[:, :3, 3]) - pairs.Ts_truth[:, :3, 3], axis=1)
    turned = rotation_errors_deg(pairs.Ts_truth[:, :3, :3], R @ pairs.Ts_estimate[:, :3, :3])
    return Laid(
        t_us=t_us,
        Ts_world_camera=Ts,
        apart_percent=percent,
        apart_deg=degrees,
        common=len(pairs),
        rmse_percent=100 * (rmse(apart) or 0.0),
        rmse_deg=rmse(turned) or 0.0,
    )


def beside_curves(other: ShownSession, base: ShownSession, start: int) -> dict[str, NDArray[Any]]:
    """Return the curves of a session laid into another's world, of windows from `start` on."""
    laid = lay(other, base)
    angles = axis_angles(laid.Ts_world_camera[:, :3, :3])
    whole = np.isfinite(angles).all(axis=1)
    angles[whole] = np.unwrap(angles[whole], period=360, axis=0)
    values = np.concatenate([laid.Ts_world_camera[:, :3, 3], angles], axis=1)
    curves = {name: values[start:, k].astype(np.float32) for k, name in enumerate(_AXES)}
    return curves | {
        "apart_percent": laid.apart_percent[start:].astype(np.float32),
        "apart_deg": laid.apart_deg[start:].astype(np.float32),
    }


def figures(shown: ShownSession, base: ShownSession) -> dict[str, Any]:
    """Return what a table of differences says of one session; `apart_…` are to the base, None for itself."""
    session = shown.session
    summary = session.summary or {}
    told: dict[str, Any] = {
        "name": shown.name,
        "windows": session.window_count,
        "real_time_factor": summary.get("real_time_factor"),
        "t0_us": session.header.first_us,
        "recording": session.header.recording_name,
        "settings": settings_apart(session.header.config_json, base.session.header.config_json),
        **dict.fromkeys(("position_percent", "rotation_deg", "apart_percent", "apart_deg", "common")),
    }
    if shown.has_truth:
        known = summary.get("evaluation")
        if not known:
            try:
                known = evaluate(session).to_dict()
            except EvaluationError:
                known = {}
        told["position_percent"], told["rotation_deg"] = (known.get(name) for name in _EVALUATED)
    if shown is not base:
        laid = lay(shown, base)
        told |= {"apart_percent": laid.rmse_percent, "apart_deg": laid.rmse_deg, "common": laid.common}
    return told


def settings_apart(config_json: str, other_json: str) -> dict[str, list[Any]]:
    """Return the settings that differ, each with both values, by their names."""
    mine, theirs = _flat(json.loads(config_json)), _flat(json.loads(other_json))
    names = [*mine, *(name for name in theirs if name not in mine)]
    return {name: [mine.get(name), theirs.get(name)] for name in names if mine.get(name) != theirs.get(name)}


def _flat(values: dict[str, Any], before: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            out |= _flat(value, f"{before}{name}.")
        else:
            out[before + name] = value
    return out
