"""How far a session, or any trajectory, is from the truth.

What each figure means is written in `docs/evaluation.md`; `Evaluation`'s attributes say it in a line.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import EvaluationError
from dvsviz.evaluate import metrics
from dvsviz.evaluate.align import STILL_M, AlignmentKind, align_positions, align_rotations, spread
from dvsviz.evaluate.associate import Association, PosePairs, associate, coverage, known_at
from dvsviz.geometry.trajectory import Trajectory

PosesKind = Literal["refined", "online"]

RPE_DELTA_US = 1_000_000
"""Relative errors are over one second."""
RPE_TOLERANCE_US = 50_000
"""Half the longest window: where no window is missing the nearest pose is never further off."""


class SessionHeaderLike(Protocol):
    """What a session's header tells an evaluation."""

    @property
    def config_json(self) -> str:
        """The tracker's configuration, one JSON object."""
        ...

    @property
    def mean_plane_distance(self) -> float | None:
        """Metres from camera to plane on average, where the recording says it."""
        ...


class SessionLike(Protocol):
    """What an evaluation reads of a session: `session.store.Session` is one."""

    @property
    def path(self) -> Path:
        """The session's file."""
        ...

    @property
    def header(self) -> Any:
        """A `SessionHeaderLike`."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses, or None."""
        ...

    def trajectory(self, poses: PosesKind = "refined", drop_lost: bool = True) -> Trajectory:
        """Return the session's poses, those of windows while lost left out."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Errors of a trajectory; None where a figure has no meaning (no translation, shorter than a second).

    Attributes:
        alignment: `sim3`, `se3` or `none`, with what was assumed where the positions leave a part of it free.
        poses: number of estimated poses that were compared.
        coverage: share (0 to 1) of the truth's duration within 50 ms of a pose.
        position_rmse_m: root mean square distance of the aligned positions, metres (ATE).
        position_rmse_percent_of_path: the same by the length of the truth's path, percent.
        position_rmse_percent_of_distance: the same by the mean distance to the plane, percent.
        rotation_rmse_deg: root mean square angle after the best constant world rotation, from rotations alone.
        rpe_position_m: root mean square error of relative positions over one second, all pairs, metres.
        rpe_rotation_deg: root mean square error of relative rotations over one second, all pairs, degrees.
        path_m: length of the truth's path between the first and the last compared pose, metres.
    """

    alignment: str
    poses: int
    coverage: float
    position_rmse_m: float | None
    position_rmse_percent_of_path: float | None
    position_rmse_percent_of_distance: float | None
    rotation_rmse_deg: float | None
    rpe_position_m: float | None
    rpe_rotation_deg: float | None
    path_m: float | None

    def to_dict(self) -> dict[str, str | float | None]:
        """Return the figures by name, ready for JSON."""
        return asdict(self)


def evaluate(
    estimate: Trajectory | SessionLike,
    truth: Trajectory | None = None,
    *,
    alignment: AlignmentKind = "sim3",
    poses: PosesKind = "refined",
    association: Association = "interpolate",
    max_difference_s: float = 0.01,
    mean_plane_distance: float | None = None,
    plane_distance: float | None = None,
) -> Evaluation:
    """Return the errors of a session or a trajectory.

    Args:
        estimate: a session, whose stored ground truth is used where no other is given, or a trajectory.
        truth: true poses on the same clock.
        alignment: similarity (`sim3`), rigid (`se3`) or `none`.
        poses: of a session: as `refined` by later windows, or as known at the time (`online`).
        association: `interpolate` the truth at each pose, or take the `nearest` pose.
        max_difference_s: largest difference in time of a nearest pair.
        mean_plane_distance: metres from the camera to the plane; a session's recording may say it.
        plane_distance: distance of the plane from the world's origin in the estimate's units (a session: 1 or what
            its configuration says); with the alignment's scale it stands in for an unknown `mean_plane_distance`.

    Raises:
        EvaluationError: no ground truth, or fewer than two poses to compare.
    """
    translates = True
    if not isinstance(estimate, Trajectory):
        session = estimate
        estimate, truth = session.trajectory(poses=poses), truth if truth is not None else session.ground_truth
        if truth is None:
            raise EvaluationError(
                "the session has no ground truth to compare with",
                path=session.path,
                hint="name a file of true poses in TUM layout with --truth",
            )
        unit_m, translates = _session_unit(session.header)
        estimate = _scaled(estimate, unit_m)
        plane_distance = unit_m if plane_distance is None else plane_distance
        mean_plane_distance = mean_plane_distance or session.header.mean_plane_distance
    elif truth is None:
        raise EvaluationError("truth: expected true poses beside the estimated trajectory, got none")
    pairs = associate(estimate, truth, association=association, max_difference_s=max_difference_s)
    return evaluate_pairs(
        pairs,
        alignment=alignment,
        covered=coverage(estimate, truth),
        mean_plane_distance=mean_plane_distance,
        plane_distance=plane_distance,
        translates=translates,
    )


def evaluate_pairs(
    pairs: PosePairs,
    *,
    alignment: AlignmentKind = "sim3",
    covered: float = 1.0,
    mean_plane_distance: float | None = None,
    plane_distance: float | None = None,
    translates: bool = True,
) -> Evaluation:
    """Return the errors of associated poses.

    Args:
        pairs: true and estimated poses.
        alignment: similarity (`sim3`), rigid (`se3`) or `none`.
        covered: share of the truth's duration that the estimate covers.
        mean_plane_distance: metres from the camera to the plane, where known.
        plane_distance: distance of the plane in the estimate's units, where known.
        translates: False where the estimate says nothing about position (a rotation-only run).
    """
    p_truth, p_world = pairs.Ts_truth[:, :3, 3], pairs.Ts_estimate[:, :3, 3]
    Rs_truth, Rs_world = pairs.Ts_truth[:, :3, :3], pairs.Ts_estimate[:, :3, :3]
    aligned = align_positions(p_world, p_truth, alignment)
    truth_moves = spread(p_truth) >= STILL_M
    # A scale of 0 makes any estimate fit a truth that stands still: such a position error means nothing.
    has_position = translates and (truth_moves or alignment != "sim3")
    first, second = metrics.pairs_after(pairs.t_us, RPE_DELTA_US, RPE_TOLERANCE_US)
    Ts_metric = pairs.Ts_estimate.copy()
    Ts_metric[:, :3, 3] *= aligned.scale
    rpe_position, rpe_rotation = metrics.relative_pose_errors(pairs.Ts_truth, Ts_metric, first, second)
    position = metrics.rmse(metrics.position_errors(p_truth, aligned.positions(p_world))) if has_position else None
    path_m = pairs.path_m if truth_moves else None
    distance_m = mean_plane_distance or (aligned.scale * plane_distance if plane_distance and truth_moves else None)
    rotations = metrics.rotation_errors_deg(Rs_truth, align_rotations(Rs_world, Rs_truth) @ Rs_world)
    return Evaluation(
        alignment=aligned.name,
        poses=len(pairs),
        coverage=covered,
        position_rmse_m=position,
        position_rmse_percent_of_path=_percent(position, path_m),
        position_rmse_percent_of_distance=_percent(position, distance_m) if truth_moves else None,
        rotation_rmse_deg=metrics.rmse(rotations),
        rpe_position_m=metrics.rmse(rpe_position) if has_position else None,
        rpe_rotation_deg=metrics.rmse(rpe_rotation),
        path_m=path_m,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowErrors:
    """Errors of given times after Sim(3) alignment, and the truth laid into the session's world.

    Attributes:
        position_percent: error of the position in percent of the plane distance (N,); NaN where it is not known.
        rotation_deg: error of the rotation in degrees (N,); NaN where there is no truth.
        truth_world: the true poses in the session's world and units, for drawing; None where there is no scale.
    """

    position_percent: NDArray[np.float64]
    rotation_deg: NDArray[np.float64]
    truth_world: Trajectory | None


def errors_at(
    t_us: NDArray[np.int64],
    Ts_world_camera: NDArray[np.float64],
    *,
    session: SessionLike,
    poses: PosesKind = "refined",
) -> WindowErrors:
    """Return the errors of poses of a session, lost ones too, after the alignment of those that are not lost.

    Args:
        t_us: times (N,) of the poses, int64.
        Ts_world_camera: poses (N, 4, 4) in the session's world.
        session: gives the truth and the poses to align with it.
        poses: which of the session's poses are aligned.
    """
    percent, degrees = np.full(len(t_us), np.nan), np.full(len(t_us), np.nan)
    truth = session.ground_truth
    none = WindowErrors(position_percent=percent, rotation_deg=degrees, truth_world=None)
    if truth is None or len(truth) == 0:
        return none
    try:
        pairs = associate(session.trajectory(poses=poses), truth)
    except EvaluationError:  # a run that has just begun, or whose clock is another one's
        return none
    aligned = align_positions(pairs.Ts_estimate[:, :3, 3], pairs.Ts_truth[:, :3, 3], "sim3")
    R_truth_world = align_rotations(pairs.Ts_estimate[:, :3, :3], pairs.Ts_truth[:, :3, :3])
    inside = known_at(truth, t_us)
    Ts_truth = truth.at(t_us[inside]).Ts_world_camera
    Ts = Ts_world_camera[inside]
    degrees[inside] = metrics.rotation_errors_deg(Ts_truth[:, :3, :3], R_truth_world @ Ts[:, :3, :3])
    _, translates = _session_unit(session.header)
    if not translates or aligned.scale <= 0 or aligned.degeneracy == "no translation":
        return WindowErrors(position_percent=percent, rotation_deg=degrees, truth_world=None)
    # Session poses are in plane distances, so the alignment's scale is the plane's distance in metres.
    distance_m = session.header.mean_plane_distance or aligned.scale
    errors_m = metrics.position_errors(Ts_truth[:, :3, 3], aligned.positions(Ts[:, :3, 3]))
    percent[inside] = 100 * errors_m / distance_m
    Ts_drawn = truth.Ts_world_camera.copy()
    Ts_drawn[:, :3, 3] = aligned.positions_back(truth.positions)
    Ts_drawn[:, :3, :3] = R_truth_world.T @ truth.rotations
    drawn = Trajectory(t_us=truth.t_us, Ts_world_camera=Ts_drawn)
    return WindowErrors(position_percent=percent, rotation_deg=degrees, truth_world=drawn)


class SessionColumns(SessionLike, Protocol):
    """A session whose windows are read as columns."""

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return per-window columns, `start_us` (N,) among them."""
        ...

    def Ts_world_camera(self, refined: bool = True) -> NDArray[np.float64]:
        """Return the poses (N, 4, 4) of all windows."""
        ...


def window_errors(session: SessionColumns, *, poses: PosesKind = "refined") -> WindowErrors:
    """Return the errors of every window of a session: percent of the plane distance, and degrees."""
    t_us = np.asarray(session.columns()["start_us"], dtype=np.int64)
    return errors_at(t_us, session.Ts_world_camera(refined=poses == "refined"), session=session, poses=poses)


def _session_unit(header: SessionHeaderLike) -> tuple[float, bool]:
    """Return the metres a unit of the session's poses is believed to have, and whether it estimates positions."""
    config: dict[str, Any] = json.loads(header.config_json)
    return float(config.get("plane_distance") or 1.0), config.get("motion") != "rotation"


def _scaled(trajectory: Trajectory, scale: float) -> Trajectory:
    if scale == 1.0:
        return trajectory
    Ts = trajectory.Ts_world_camera.copy()
    Ts[:, :3, 3] *= scale
    return Trajectory(t_us=trajectory.t_us, Ts_world_camera=Ts)


def _percent(value: float | None, of: float | None) -> float | None:
    return 100 * value / of if value is not None and of else None
