"""Known answers of association, alignment and errors."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dvsviz.evaluate
from dvsviz.errors import EvaluationError
from dvsviz.evaluate.align import align_positions, align_rotations, least_rotation
from dvsviz.evaluate.associate import associate, coverage, known_at, nearest_indices
from dvsviz.evaluate.evaluate import evaluate, window_errors
from dvsviz.evaluate.tables import evaluation_table, table
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory

KEYS = [
    "alignment",
    "poses",
    "coverage",
    "position_rmse_m",
    "position_rmse_percent_of_path",
    "position_rmse_percent_of_distance",
    "rotation_rmse_deg",
    "rpe_position_m",
    "rpe_rotation_deg",
    "path_m",
]


def curve(t_us: np.ndarray) -> Trajectory:
    """A smooth 6-DoF trajectory at given times."""
    s = t_us * 1e-6
    p = np.stack([np.sin(s), 0.7 * np.cos(1.3 * s), 0.3 * np.sin(2.1 * s)], axis=-1)
    phi = np.stack([0.2 * np.sin(1.1 * s), 0.3 * np.cos(0.7 * s), 0.5 * np.sin(0.4 * s)], axis=-1)
    Ts = se3.pose(se3.exp_so3(phi), p)
    Ts.setflags(write=False)
    return Trajectory(t_us=t_us, Ts_world_camera=Ts)


def moved(trajectory: Trajectory, *, scale: float = 1.0, R: np.ndarray | None = None, t: np.ndarray | None = None):
    """The trajectory in another world: p' = R^T (p - t) / scale."""
    R = np.eye(3) if R is None else R
    t = np.zeros(3) if t is None else t
    Ts = se3.pose(R.T @ trajectory.rotations, (trajectory.positions - t) @ R / scale)
    Ts.setflags(write=False)
    return Trajectory(t_us=trajectory.t_us, Ts_world_camera=Ts)


TIMES = np.arange(0, 10_000_000, 20_000, dtype=np.int64)
DENSE = np.arange(0, 10_000_000, 1_000, dtype=np.int64)
R_ANY = se3.exp_so3(np.array([0.4, -1.1, 0.8]))


@settings(max_examples=25, deadline=None)
@given(
    scale=st.floats(0.05, 20),
    phi=st.tuples(*[st.floats(-3, 3)] * 3),
    t=st.tuples(*[st.floats(-50, 50)] * 3),
)
def test_alignment_recovers_any_similarity(scale: float, phi: tuple[float, ...], t: tuple[float, ...]) -> None:
    truth = curve(TIMES)
    R = se3.exp_so3(np.array(phi))
    estimate = moved(truth, scale=scale, R=R, t=np.array(t))
    found = align_positions(estimate.positions, truth.positions, "sim3")
    assert found.name == "sim3"
    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert np.allclose(found.R_truth_world, R, atol=1e-9)
    assert np.allclose(found.positions(estimate.positions), truth.positions, atol=1e-8)
    assert np.allclose(found.positions_back(truth.positions), estimate.positions, atol=1e-7 / min(1, scale))
    figures = evaluate(estimate, truth)
    assert figures.position_rmse_m is not None and figures.position_rmse_m < 1e-8
    assert figures.rotation_rmse_deg is not None and figures.rotation_rmse_deg < 1e-5
    assert figures.rpe_position_m is not None and figures.rpe_position_m < 1e-8


def test_alignment_never_mirrors() -> None:
    truth = curve(TIMES).positions
    found = align_positions(truth * (1, 1, -1), truth, "sim3")
    assert np.linalg.det(found.R_truth_world) == pytest.approx(1)


def test_alignment_is_the_least_squares_optimum() -> None:
    rng = np.random.default_rng(3)
    truth = curve(TIMES)
    estimate = moved(truth, scale=2, R=R_ANY).positions + rng.normal(0, 0.05, (len(TIMES), 3))
    for kind in ("sim3", "se3"):
        found = align_positions(estimate, truth.positions, kind)
        best = np.sum((found.positions(estimate) - truth.positions) ** 2)
        for _ in range(20):
            R = se3.exp_so3(rng.normal(0, 0.01, 3)) @ found.R_truth_world
            scale = found.scale * (1 + rng.normal(0, 0.01)) if kind == "sim3" else 1.0
            p = scale * estimate @ R.T + found.t_truth_world + rng.normal(0, 0.01, 3)
            assert np.sum((p - truth.positions) ** 2) > best


def test_straight_line_is_aligned_by_the_least_rotation() -> None:
    s = np.linspace(-1, 2, 200)
    rng = np.random.default_rng(5)
    truth = np.outer(s, [1.0, 0, 0]) + np.array([3, 4, 5])
    direction = np.array([0.8, 0.6, 0.0])
    estimate = np.outer(s, direction) / 2 + rng.normal(0, 1e-3, (200, 3))
    found = align_positions(estimate, truth, "sim3")
    assert found.name == "sim3 (straight line: least rotation)"
    assert found.scale == pytest.approx(2, rel=1e-2)
    # The least rotation that lays one line on the other turns about their common normal, by the angle between them.
    assert np.allclose(se3.log_so3(found.R_truth_world), [0, 0, -np.arccos(0.8)], atol=2e-3)
    assert np.sqrt(np.mean((found.positions(estimate) - truth) ** 2)) < 3e-3
    # It is the optimum: no other rotation leaves a smaller error.
    best = np.sum((found.positions(estimate) - truth) ** 2)
    turned = (estimate - estimate.mean(0)) @ (se3.exp_so3(np.array([0, 0.05, 0])) @ found.R_truth_world).T
    assert np.sum((found.scale * turned + truth.mean(0) - truth) ** 2) > best


@pytest.mark.parametrize("axis", range(3))
def test_least_rotation_of_equal_and_of_opposite_directions(axis: int) -> None:
    a = np.eye(3)[axis]
    assert np.allclose(least_rotation(a, a), np.eye(3))
    half_turn = least_rotation(a, -a)
    assert np.allclose(half_turn @ a, -a)
    assert np.linalg.det(half_turn) == pytest.approx(1)


def test_opposite_line_is_laid_on_the_line() -> None:
    truth = np.outer(np.linspace(0, 1, 50), [0, 1.0, 0])
    found = align_positions(-truth * 4, truth, "sim3")
    assert found.scale == pytest.approx(0.25)
    assert np.allclose(found.positions(-truth * 4), truth, atol=1e-12)


def test_constant_error_has_its_known_size() -> None:
    truth = curve(TIMES)
    Ts = truth.Ts_world_camera.copy()
    Ts[::2, :3, 3] += (0.03, 0, 0.04)
    Ts[1::2, :3, 3] -= (0.03, 0, 0.04)
    figures = evaluate(Trajectory(t_us=TIMES, Ts_world_camera=Ts), truth, alignment="none", mean_plane_distance=2.5)
    assert figures.alignment == "none"
    assert figures.position_rmse_m == pytest.approx(0.05)
    assert figures.position_rmse_percent_of_distance == pytest.approx(2.0)
    assert figures.path_m == pytest.approx(truth.path_length)
    assert figures.position_rmse_percent_of_path == pytest.approx(5 / truth.path_length)


def test_drift_has_its_known_relative_error() -> None:
    """A yaw of 2 degrees a second and a stretch of 10 %: the relative errors over a second are just these."""
    n = len(TIMES)
    s = TIMES * 1e-6
    truth = Trajectory(t_us=TIMES, Ts_world_camera=se3.pose(position=np.outer(s, [0.5, 0, 0])))
    yaw = se3.exp_so3(np.outer(np.deg2rad(2) * s, [0, 0, 1]))
    rotated = Trajectory(t_us=TIMES, Ts_world_camera=se3.pose(yaw, np.zeros((n, 3))))
    assert evaluate(rotated, truth, alignment="none").rpe_rotation_deg == pytest.approx(2, abs=1e-6)
    stretched = Trajectory(t_us=TIMES, Ts_world_camera=se3.pose(position=np.outer(s, [0.55, 0, 0])))
    assert evaluate(stretched, truth, alignment="se3").rpe_position_m == pytest.approx(0.05)
    scaled = evaluate(stretched, truth)
    assert scaled.rpe_position_m == pytest.approx(0, abs=1e-12)
    assert scaled.alignment == "sim3 (straight line: least rotation)"


def test_rotation_error_is_taken_from_rotations_alone() -> None:
    truth = curve(TIMES)
    sign = np.where(np.arange(len(TIMES)) % 2, 1.0, -1.0)
    wobble = se3.exp_so3(np.outer(np.deg2rad(3) * sign, [0, 1, 0]))
    Ts = se3.pose(R_ANY.T @ truth.rotations @ wobble, np.random.default_rng(1).normal(size=(len(TIMES), 3)))
    figures = evaluate(Trajectory(t_us=TIMES, Ts_world_camera=Ts), truth)
    assert figures.rotation_rmse_deg == pytest.approx(3, rel=0.02)
    assert np.allclose(align_rotations(Ts[:, :3, :3], truth.rotations), R_ANY, atol=2e-2)


def test_truth_is_interpolated_at_each_pose() -> None:
    slow = curve(np.arange(0, 10_000_001, 100_000, dtype=np.int64))
    at = np.arange(37_000, 9_900_000, 61_000, dtype=np.int64)
    estimate = slow.at(at)
    assert evaluate(estimate, slow).position_rmse_m == pytest.approx(0, abs=1e-9)
    assert (evaluate(estimate, slow, association="nearest", max_difference_s=0.06).position_rmse_m or 0) > 1e-3


def test_poses_outside_the_truth_are_left_out() -> None:
    truth = curve(TIMES[100:200])
    pairs = associate(curve(TIMES), truth)
    assert pairs.t_us[0] == TIMES[100] and pairs.t_us[-1] == TIMES[199]
    assert pairs.path_m == pytest.approx(truth.path_length)


def test_unix_time_keeps_its_microseconds() -> None:
    start = 1_700_000_000_000_000
    truth, estimate = curve(DENSE), curve(TIMES[:-1] + 501)
    late = Trajectory(t_us=truth.t_us + start, Ts_world_camera=truth.Ts_world_camera)
    shifted = Trajectory(t_us=estimate.t_us + start, Ts_world_camera=estimate.Ts_world_camera)
    a, b = evaluate(estimate, truth), evaluate(shifted, late)
    assert a.position_rmse_m == pytest.approx(b.position_rmse_m, rel=1e-6, abs=1e-12)
    assert (b.position_rmse_m or 1) < 1e-5


def test_nearest_takes_the_earlier_of_two_equally_near() -> None:
    i, j = nearest_indices(np.array([10, 15, 40]), np.array([10, 20, 30]), 5)
    assert i.tolist() == [0, 1] and j.tolist() == [0, 0]
    assert nearest_indices(np.array([1]), np.zeros(0, np.int64), 5)[0].size == 0


def test_coverage_counts_what_is_within_50_ms_of_a_pose_once() -> None:
    truth = curve(np.array([0, 1_000_000], dtype=np.int64))
    assert coverage(curve(np.array([100_000, 120_000, 500_000], dtype=np.int64)), truth) == pytest.approx(0.22)
    assert coverage(curve(np.array([0, 1_020_000], dtype=np.int64)), truth) == pytest.approx(0.08)
    assert coverage(curve(np.array([5_000_000], dtype=np.int64)), truth) == 0
    assert coverage(curve(np.arange(0, 1_000_001, 90_000, dtype=np.int64)), truth) == pytest.approx(1)


def test_truth_is_not_interpolated_across_its_gaps() -> None:
    t_us = DENSE[(DENSE < 2_000_000) | (DENSE > 5_000_000)]
    truth = curve(t_us)
    figures = evaluate(curve(TIMES), truth)
    assert figures.poses == len(TIMES) - 151
    assert figures.position_rmse_m == pytest.approx(0, abs=1e-5)
    assert known_at(truth, np.array([1_999_000, 1_999_500, 5_000_999, 5_001_000])).tolist() == [
        True,
        False,
        False,
        True,
    ]


def test_too_few_poses_say_so() -> None:
    with pytest.raises(EvaluationError, match=r"0 of 500 .*truth 20\.000 to"):
        evaluate(curve(TIMES), curve(TIMES + 20_000_000))
    with pytest.raises(EvaluationError, match="got none"):
        evaluate(curve(TIMES))


def test_truth_without_translation_has_no_position_error() -> None:
    truth = Trajectory(t_us=TIMES, Ts_world_camera=se3.pose(curve(TIMES).rotations, np.array([1.0, 2, 3])))
    figures = evaluate(curve(TIMES), truth).to_dict()
    assert figures["alignment"] == "sim3 (no translation)"
    nothing = {key for key, value in figures.items() if value is None}
    assert nothing == {
        "position_rmse_m",
        "position_rmse_percent_of_path",
        "position_rmse_percent_of_distance",
        "rpe_position_m",
        "path_m",
    }
    assert figures["rotation_rmse_deg"] == pytest.approx(0, abs=1e-5)


def test_estimate_that_stands_still_has_the_error_of_its_truth() -> None:
    truth = curve(TIMES)
    still = Trajectory(t_us=TIMES, Ts_world_camera=se3.pose(truth.rotations, np.zeros(3)))
    figures = evaluate(still, truth, plane_distance=1.0)
    deviation = truth.positions - truth.positions.mean(axis=0)
    assert figures.position_rmse_m == pytest.approx(np.sqrt(np.mean(np.sum(deviation**2, axis=-1))))
    assert figures.position_rmse_percent_of_distance is None


def test_short_recording_has_no_relative_error() -> None:
    figures = evaluate(curve(TIMES[:40]), curve(DENSE))
    assert figures.rpe_position_m is None and figures.rpe_rotation_deg is None
    assert figures.position_rmse_m is not None


def test_keys_are_those_of_the_command_line() -> None:
    figures = evaluate(curve(TIMES), curve(DENSE)).to_dict()
    assert list(figures) == KEYS
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert figures["poses"] == 500


def test_room_is_callable_by_its_name() -> None:
    assert dvsviz.evaluate(curve(TIMES), curve(DENSE)).poses == 500


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    config_json: str = '{"motion": "planar"}'
    mean_plane_distance: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MemorySession:
    """A session in memory: what an evaluation reads of one."""

    path: Path
    header: Header
    ground_truth: Trajectory | None
    refined: Trajectory
    lost: np.ndarray

    def trajectory(self, poses: str = "refined", drop_lost: bool = True) -> Trajectory:
        keep = ~self.lost if drop_lost else np.ones(len(self.lost), bool)
        Ts = self.Ts_world_camera(refined=poses == "refined")
        return Trajectory(t_us=self.refined.t_us[keep], Ts_world_camera=Ts[keep])

    def columns(self) -> dict[str, np.ndarray]:
        return {"start_us": self.refined.t_us}

    def Ts_world_camera(self, refined: bool = True) -> np.ndarray:
        Ts = self.refined.Ts_world_camera
        return Ts if refined else Ts @ se3.pose(se3.exp_so3(np.array([0, 0, 0.1])), np.zeros(3))


def memory_session(**header: object) -> MemorySession:
    """A perfect session of a wall at 2.5 m, but for windows 100 to 119, which are lost and 1 plane distance off."""
    truth = curve(DENSE)
    estimate = moved(curve(TIMES), scale=2.5, R=R_ANY, t=np.array([1.0, 2, 3]))
    lost = np.zeros(len(TIMES), bool)
    lost[100:120] = True
    Ts = estimate.Ts_world_camera.copy()
    Ts[lost, 0, 3] += 1.0
    return MemorySession(
        path=Path("wall.h5"),
        header=Header(**header),  # type: ignore[arg-type]
        ground_truth=truth,
        refined=Trajectory(t_us=TIMES, Ts_world_camera=Ts),
        lost=lost,
    )


def test_session_is_compared_with_its_own_truth_without_lost_windows() -> None:
    session = memory_session()
    figures = evaluate(session)
    assert figures.poses == len(TIMES) - 20
    assert figures.position_rmse_m == pytest.approx(0, abs=1e-6)
    assert figures.coverage == pytest.approx(1 - 0.32 / 9.999 + 0.029 / 9.999, abs=0.003)
    with pytest.raises(EvaluationError, match=r"wall\.h5: the session has no ground truth"):
        evaluate(
            MemorySession(
                path=session.path,
                header=session.header,
                ground_truth=None,
                refined=session.refined,
                lost=session.lost,
            )
        )


def test_plane_distance_is_the_recordings_else_the_scale() -> None:
    session = memory_session()
    wrong = curve(DENSE)
    Ts = wrong.Ts_world_camera.copy()
    Ts[:, 0, 3] += 0.05 * np.sign(np.sin(np.arange(len(DENSE)) / 3))
    noisy = Trajectory(t_us=DENSE, Ts_world_camera=Ts)
    figures = evaluate(session, noisy)
    assert figures.position_rmse_percent_of_distance == pytest.approx(
        100 * (figures.position_rmse_m or 0) / 2.5, rel=1e-2
    )
    told = evaluate(memory_session(mean_plane_distance=2.0), noisy)
    assert told.position_rmse_percent_of_distance == pytest.approx(100 * (told.position_rmse_m or 0) / 2.0)


def test_known_plane_distance_makes_a_session_metric() -> None:
    told = memory_session(config_json='{"motion": "planar", "plane_distance": 2.5}')
    assert evaluate(told, alignment="se3").position_rmse_m == pytest.approx(0, abs=1e-6)
    assert (evaluate(memory_session(), alignment="se3").position_rmse_m or 0) > 0.1


def test_rotation_only_session_has_no_position_error() -> None:
    figures = evaluate(memory_session(config_json='{"motion": "rotation"}'))
    assert figures.position_rmse_m is None and figures.position_rmse_percent_of_distance is None
    assert figures.path_m is not None
    assert figures.rotation_rmse_deg == pytest.approx(0, abs=1e-5)


def test_online_poses_are_those_known_at_the_time() -> None:
    online, refined = evaluate(memory_session(), poses="online"), evaluate(memory_session())
    assert online.position_rmse_m == pytest.approx(refined.position_rmse_m, abs=1e-9)
    assert (online.rotation_rmse_deg or 0) > (refined.rotation_rmse_deg or 0) + 0.01


def test_window_errors_of_every_window() -> None:
    session = memory_session()
    errors = window_errors(session)
    assert errors.position_percent.shape == errors.rotation_deg.shape == (len(TIMES),)
    assert np.nanmax(errors.position_percent[~session.lost]) < 1e-3
    assert np.allclose(errors.position_percent[session.lost], 100, rtol=1e-3)
    assert np.nanmax(errors.rotation_deg) < 1e-3
    assert errors.truth_world is not None
    drawn = errors.truth_world.at(TIMES[~session.lost])
    assert np.allclose(drawn.Ts_world_camera, session.trajectory().Ts_world_camera, atol=1e-5)


def test_window_errors_are_not_numbers_where_nothing_is_known() -> None:
    session = memory_session()
    late = Trajectory(t_us=DENSE[5000:], Ts_world_camera=curve(DENSE).Ts_world_camera[5000:])
    half = MemorySession(
        path=session.path, header=session.header, ground_truth=late, refined=session.refined, lost=session.lost
    )
    errors = window_errors(half)
    assert np.isnan(errors.position_percent[:249]).all() and np.isfinite(errors.position_percent[251:]).all()
    blind = MemorySession(
        path=session.path, header=session.header, ground_truth=None, refined=session.refined, lost=session.lost
    )
    assert np.isnan(window_errors(blind).rotation_deg).all()
    assert window_errors(blind).truth_world is None


def test_tables_print_a_dash_for_what_has_no_meaning() -> None:
    text = evaluation_table(evaluate(memory_session(config_json='{"motion": "rotation"}')))
    assert "position (ATE, RMSE)     –" in text
    assert "alignment" in text.splitlines()[0] and "sim3" in text.splitlines()[0]
    assert table(["name", "n"], [{"name": "a", "n": "1"}, {"name": "bcdef", "n": "20"}]) == (
        "name    n\na       1\nbcdef  20"
    )
