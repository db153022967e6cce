"""Our figures beside those of the `evo` package, on public trajectories and on its nearest pairs."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.metrics import PoseRelation, Unit
from evo.core.trajectory import PoseTrajectory3D

from dvsviz.evaluate import metrics
from dvsviz.evaluate.align import AlignmentKind, align_positions, align_rotations
from dvsviz.evaluate.associate import associate
from dvsviz.evaluate.evaluate import evaluate
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import read_tum

CASES = {
    "fr1_xyz": ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt"),
    "fr1_xyz_drift": ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam_drift.txt"),
    "fr2_desk": ("fr2_desk_groundtruth.txt", "fr2_desk_ORB.txt"),
    "V102": ("V102_groundtruth.csv", "V102.txt"),
}


def _read(path: Path) -> Trajectory:
    if path.suffix != ".csv":
        return read_tum(path, repair=True)
    rows = np.loadtxt(path, delimiter=",", usecols=range(8))
    t_us = np.loadtxt(path, delimiter=",", usecols=0, dtype=np.int64) // 1000
    return Trajectory.from_quaternions(t_us, rows[:, 1:4], rows[:, 4:8])


def _evo(trajectory: Trajectory) -> PoseTrajectory3D:
    # Microseconds, which a double holds exactly: in seconds, rounding decides between two equally near poses.
    return PoseTrajectory3D(
        trajectory.positions.copy(), trajectory.quaternions_wxyz.copy(), trajectory.t_us.astype(np.float64)
    )


@pytest.fixture(scope="module", params=sorted(CASES))
def trajectories(request: pytest.FixtureRequest, data_dir: Path) -> tuple[Trajectory, Trajectory]:
    truth, estimate = CASES[request.param]
    return _read(data_dir / "trajectories" / truth), _read(data_dir / "trajectories" / estimate)


def _rmse(metric: object, truth: PoseTrajectory3D, estimate: PoseTrajectory3D) -> float:
    metric.process_data((truth, estimate))  # type: ignore[attr-defined]
    return float(metric.get_statistic(evo_metrics.StatisticsType.rmse))  # type: ignore[attr-defined]


@pytest.mark.data
@pytest.mark.parametrize("alignment", ["sim3", "se3", "none"])
def test_absolute_and_relative_errors_equal_evo(
    trajectories: tuple[Trajectory, Trajectory], alignment: AlignmentKind
) -> None:
    truth, estimate = trajectories
    ours = evaluate(estimate, truth, alignment=alignment, association="nearest")

    evo_truth, evo_estimate = sync.associate_trajectories(_evo(truth), _evo(estimate), max_diff=10_000.0)
    assert ours.poses == evo_truth.num_poses
    if alignment != "none":
        evo_estimate.align(evo_truth, correct_scale=alignment == "sim3")
    ate = _rmse(evo_metrics.APE(PoseRelation.translation_part), evo_truth, evo_estimate)
    assert ours.position_rmse_m == pytest.approx(ate, abs=1e-6)

    # Rotations: evo's errors after our rotation, which no rotation nearby improves.
    pairs = associate(estimate, truth, association="nearest")
    R = align_rotations(pairs.Ts_estimate[:, :3, :3], pairs.Ts_truth[:, :3, :3])
    rotated = _evo(Trajectory(t_us=pairs.t_us, Ts_world_camera=se3.pose(R) @ pairs.Ts_estimate))
    apart = _rmse(evo_metrics.APE(PoseRelation.rotation_angle_deg), evo_truth, rotated)
    assert ours.rotation_rmse_deg == pytest.approx(apart, abs=1e-6)

    # Over one second: evo counts in frames, so its own error of a pair is taken for each of our pairs.
    first, second = metrics.pairs_after(pairs.t_us, 1_000_000, 50_000)
    assert len(first) > 100
    assert np.max(np.abs(pairs.t_us[second] - pairs.t_us[first] - 1_000_000)) <= 50_000
    E = [
        evo_metrics.RPE.rpe_base(
            evo_truth.poses_se3[i], evo_truth.poses_se3[j], evo_estimate.poses_se3[i], evo_estimate.poses_se3[j]
        )
        for i, j in zip(first, second, strict=True)
    ]
    position = np.sqrt(np.mean([np.sum(e[:3, 3] ** 2) for e in E]))
    rotation = np.sqrt(np.mean([np.rad2deg(se3.rotation_angle(e[:3, :3])) ** 2 for e in E]))
    assert ours.rpe_position_m == pytest.approx(position, abs=1e-6)
    assert ours.rpe_rotation_deg == pytest.approx(rotation, abs=1e-6)


@pytest.mark.data
def test_relative_errors_by_frames_equal_evo(trajectories: tuple[Trajectory, Trajectory]) -> None:
    truth, estimate = trajectories
    pairs = associate(estimate, truth, association="nearest")
    aligned = align_positions(pairs.Ts_estimate[:, :3, 3], pairs.Ts_truth[:, :3, 3], "sim3")
    Ts = pairs.Ts_estimate.copy()
    Ts[:, :3, 3] *= aligned.scale
    delta = 30
    first = np.arange(len(pairs) - delta)
    position, rotation = metrics.relative_pose_errors(pairs.Ts_truth, Ts, first, first + delta)

    evo_truth, evo_estimate = sync.associate_trajectories(_evo(truth), _evo(estimate), max_diff=10_000.0)
    evo_estimate.align(evo_truth, correct_scale=True)
    for relation, ours in (
        (PoseRelation.translation_part, position),
        (PoseRelation.rotation_angle_deg, rotation),
    ):
        metric = evo_metrics.RPE(relation, float(delta), Unit.frames, all_pairs=True)
        theirs = _rmse(metric, copy.deepcopy(evo_truth), copy.deepcopy(evo_estimate))
        assert metrics.rmse(ours) == pytest.approx(theirs, abs=1e-6)


@pytest.mark.data
def test_interpolated_truth_differs_little_from_nearest(trajectories: tuple[Trajectory, Trajectory]) -> None:
    truth, estimate = trajectories
    interpolated = evaluate(estimate, truth)
    nearest = evaluate(estimate, truth, association="nearest")
    assert interpolated.position_rmse_m == pytest.approx(nearest.position_rmse_m, rel=0.1)
