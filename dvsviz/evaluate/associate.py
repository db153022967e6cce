"""Which true pose belongs to which estimated pose.

Two ways: the truth interpolated at each estimated pose (the default: no error from a difference in time), and the
nearest pose within a limit (what most published tables use, and what the tests compare with).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import EvaluationError
from dvsviz.geometry.trajectory import Trajectory

Association = Literal["interpolate", "nearest"]

MIN_PAIRS = 2
"""Fewer poses than this give no error: an alignment would explain them."""

GAP_INTERVALS = 10
"""True poses this many median intervals apart leave the truth between them unknown. Measured: interpolated across
the 12 s in which a motion capture saw nothing, an error of 6 mm became one of 107 mm (TUM fr2_desk, ORB-SLAM)."""
GAP_MIN_US = 50_000
"""No gap is shorter than this."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosePairs:
    """True and estimated poses of the same times.

    Attributes:
        t_us: times (N,) of the estimated poses, int64, increasing.
        Ts_truth: true poses (N, 4, 4), `T_truth_camera`.
        Ts_estimate: estimated poses (N, 4, 4), `T_world_camera`.
        path_m: length of the truth's path from the first to the last pair, through all its poses between them.
    """

    t_us: NDArray[np.int64]
    Ts_truth: NDArray[np.float64]
    Ts_estimate: NDArray[np.float64]
    path_m: float

    def __len__(self) -> int:
        return len(self.t_us)


def associate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    association: Association = "interpolate",
    max_difference_s: float = 0.01,
) -> PosePairs:
    """Return the pairs of true and estimated poses.

    Args:
        estimate: estimated poses.
        truth: true poses, on the same clock.
        association: `interpolate` the truth at each estimated pose (linear in position, slerp in rotation) inside
            its duration and not across a gap, or the `nearest` pose for each pose of the shorter trajectory.
        max_difference_s: largest difference in time of a nearest pair.

    Raises:
        EvaluationError: fewer than two pairs.
    """
    if association == "interpolate":
        pairs = _interpolated(estimate, truth)
    else:
        pairs = _nearest(estimate, truth, round(max_difference_s * 1e6))
    if len(pairs) < MIN_PAIRS:
        raise EvaluationError(
            f"{len(pairs)} of {len(estimate)} estimated poses have a true pose, expected at least {MIN_PAIRS}",
            hint=f"compare their clocks: {_span('estimate', estimate)}, {_span('truth', truth)}",
        )
    return pairs


def coverage(estimate: Trajectory, truth: Trajectory, *, within_us: int = 50_000) -> float:
    """Return the share (0 to 1) of the truth's duration that is within `within_us` of an estimated pose."""
    if len(estimate) == 0 or len(truth) == 0:
        return 0.0
    first, last = int(truth.t_us[0]), int(truth.t_us[-1])
    if first == last:
        return float(np.min(np.abs(estimate.t_us - first)) <= within_us)
    # Each pose covers what no earlier one did: its interval starts where the one before ended.
    start = np.clip(estimate.t_us - within_us, first, last)
    end = np.clip(estimate.t_us + within_us, first, last)
    start[1:] = np.maximum(start[1:], end[:-1])
    return float(np.sum(end - start) / (last - first))


def known_at(truth: Trajectory, t_us: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask (M,) of the times at which the truth can be interpolated: inside it and in none of its gaps."""
    known = truth.covers(t_us)
    if len(truth) < 3:
        return known
    steps = np.diff(truth.t_us)
    after = np.searchsorted(truth.t_us, t_us, side="left")
    # A time that is a true pose's own is known, whatever lies before it.
    step = steps[np.clip(after - 1, 0, len(steps) - 1)]
    exact = truth.t_us[np.clip(after, 0, len(truth) - 1)] == t_us
    return known & (exact | (step <= max(GAP_MIN_US, GAP_INTERVALS * float(np.median(steps)))))


def _interpolated(estimate: Trajectory, truth: Trajectory) -> PosePairs:
    inside = known_at(truth, estimate.t_us)
    t_us = estimate.t_us[inside]
    Ts_truth = truth.at(t_us).Ts_world_camera
    path = 0.0
    if len(t_us):
        between = (truth.t_us > t_us[0]) & (truth.t_us < t_us[-1])
        path = _length(np.concatenate([Ts_truth[:1, :3, 3], truth.positions[between], Ts_truth[-1:, :3, 3]]))
    return PosePairs(t_us=t_us, Ts_truth=Ts_truth, Ts_estimate=estimate.Ts_world_camera[inside], path_m=path)


def _nearest(estimate: Trajectory, truth: Trajectory, max_difference_us: int) -> PosePairs:
    if len(estimate) > len(truth):
        i_truth, i_estimate = nearest_indices(truth.t_us, estimate.t_us, max_difference_us)
    else:
        i_estimate, i_truth = nearest_indices(estimate.t_us, truth.t_us, max_difference_us)
    path = _length(truth.positions[i_truth[0] : i_truth[-1] + 1]) if len(i_truth) else 0.0
    return PosePairs(
        t_us=estimate.t_us[i_estimate],
        Ts_truth=truth.Ts_world_camera[i_truth],
        Ts_estimate=estimate.Ts_world_camera[i_estimate],
        path_m=path,
    )


def nearest_indices(
    t_us: NDArray[np.int64], other_us: NDArray[np.int64], max_difference_us: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return indices (M,) into `t_us` and into `other_us` of the times nearest to each other.

    Args:
        t_us: times (N,), each of which is looked up.
        other_us: increasing times (K,) in which they are looked up; of two that are equally near, the earlier.
        max_difference_us: times without one this near are left out.
    """
    if len(t_us) == 0 or len(other_us) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    after = np.clip(np.searchsorted(other_us, t_us, side="left"), 0, len(other_us) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(other_us[before] - t_us) <= np.abs(other_us[after] - t_us), before, after)
    close = np.abs(other_us[nearest] - t_us) <= max_difference_us
    return np.flatnonzero(close), nearest[close]


def _length(positions: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=-1).sum())


def _span(name: str, trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return f"{name} has no pose"
    return f"{name} {trajectory.t_us[0] * 1e-6:.3f} to {trajectory.t_us[-1] * 1e-6:.3f} s"
