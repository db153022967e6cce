"""How many metres a unit of a trajectory is, by an accelerometer.

A monocular tracker knows lengths up to a factor. The specific force along the way has the metre in it: its integral is
the way itself, less gravity, the sensor's bias and its place on the camera. A smooth bump `w` of half width `h` that
vanishes with its first and second derivative at both ends moves the derivatives from the noisy way to itself. For the
position `p` of the camera in units and its rotation `R`,

    D = k (A - B b + C g - E l),
    D = int w'' p dt,  A = int w R f dt,  B = int w R dt,  C = int w dt,  E = int w'' R dt,

where `f` is the specific force, `b` its bias, `g` gravity in the world, `l` the sensor's place in the camera's axes and
`k` units a metre. The noise is that of the poses, on the left: what is fitted on the right is as good as exact, so that
`k` is not drawn towards nothing by it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, RotationSpline

from dvsviz.errors import EvaluationError
from dvsviz.events.inertial import usable_imu
from dvsviz.events.recording import Imu
from dvsviz.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

GRAVITY_M_S2 = 9.81
# Half width of the bump, s; every half of it another one begins. Its integral is taken in steps of so long, s.
HALF_WIDTH_S = 0.4
STEP_S = 0.002
# No small sensor reaches 50 g.
MOST_M_S2 = 500.0
# Longest time without a pose or a sample, us.
LONGEST_GAP_US = 100_000
# Standard deviations of what is known before: bias, m/s²; place of the sensor, m; gravity, m/s².
BIAS_M_S2, LEVER_M, GRAVITY_SIGMA = 0.5, 0.03, 0.03
# Least number of bumps, and share of the way's bends that the accelerometer must explain.
LEAST_PLACES, LEAST_EXPLAINED = 20, 0.8
# More are not needed: they are taken evenly.
MOST_PLACES = 400
# A scale that is known less well is not told.
MOST_DEVIATION = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MetricScale:
    """Metres a unit.

    Attributes:
        metres_per_unit: by which positions are multiplied.
        deviation: its standard deviation as a share of it.
        explained: share of the way's bends that the accelerometer explains, up to 1.
        gravity_world: acceleration of a falling body (3,), m/s², in the trajectory's world.
        bias: of the accelerometer (3,), m/s².
        seconds: of the recording that took part.
    """

    metres_per_unit: float
    deviation: float
    explained: float
    gravity_world: Array
    bias: Array
    seconds: float


def metric_scale(trajectory: Trajectory, imu: Imu) -> MetricScale:
    """Return how many metres a unit of a trajectory is.

    Args:
        trajectory: of the camera, where it is known: gaps may be in it.
        imu: along the camera's axes, on the same clock.

    Raises:
        EvaluationError: it cannot be told; the reason says why.
    """
    usable = usable_imu(imu)[0]
    usable = None if usable is None else _accelerations(usable)
    if usable is None or len(trajectory) < 3:
        raise EvaluationError("no accelerations beside the poses", hint="they are expected in m/s², below 500")
    middles = _middles(trajectory, usable)
    if len(middles) < LEAST_PLACES:
        raise EvaluationError(
            f"accelerations and poses lie side by side in {len(middles)} places, {LEAST_PLACES} are needed",
            hint="track some seconds more",
        )
    seconds = len(middles) * 0.5 * HALF_WIDTH_S
    middles = middles[:: -(-len(middles) // MOST_PLACES)]
    return _solve(*_bends(trajectory, usable, middles), seconds=seconds)


def _accelerations(imu: Imu) -> Imu | None:
    # What is no number is not below the limit.
    good = (np.abs(imu.accel) < MOST_M_S2).all(axis=1)
    return Imu(t_us=imu.t_us[good], gyro=imu.gyro[good], accel=imu.accel[good]) if good.sum() > 2 else None


def _middles(trajectory: Trajectory, imu: Imu) -> NDArray[np.int64]:
    """Return the middle times (N,) of bumps with poses and samples all along."""
    h = round(HALF_WIDTH_S * 1e6)
    # Of a grid, the places where poses are: a clock may jump by years.
    places = np.unique((trajectory.t_us - trajectory.t_us[0]) // (h // 2))
    times = trajectory.t_us[0] + places * (h // 2)
    return times[_covered(trajectory.t_us, times - h, times + h) & _covered(imu.t_us, times - h, times + h)]


def _covered(t_us: NDArray[np.int64], start: NDArray[np.int64], end: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which stretches (N,) have no long gap between times."""
    gaps = np.concatenate([[0], np.cumsum(np.diff(t_us) > LONGEST_GAP_US)])
    i, j = np.searchsorted(t_us, start, side="right") - 1, np.searchsorted(t_us, end, side="left")
    inside = (i >= 0) & (j < len(t_us))
    i, j = np.clip(i, 0, len(t_us) - 1), np.clip(j, 0, len(t_us) - 1)
    return inside & (gaps[i] == gaps[j])


def _bump() -> tuple[Array, Array, Array]:
    """Return times (M,), s, and the weights (M,) of the integrals with w and with its second derivative.

    The sums have the moments of the integrals: none of w'' with 1 and t, and with t² / 2 the same as of w with 1.
    """
    n = round(HALF_WIDTH_S / STEP_S)
    u = np.arange(-n, n + 1) / n
    w = STEP_S * (1.0 - u**2) ** 3
    second = (-6.0 * (1.0 - u**2) ** 2 + 24.0 * u**2 * (1.0 - u**2)) * STEP_S / HALF_WIDTH_S**2
    second -= second.mean()
    t = u * HALF_WIDTH_S
    return t, w, second * (w.sum() / (second @ (0.5 * t**2)))


def _bends(
    trajectory: Trajectory, imu: Imu, middles: NDArray[np.int64]
) -> tuple[Array, Array, Array, Array, float]:
    """Return D (N, 3), A (N, 3), B (N, 3, 3), E (N, 3, 3) and C of the equation above."""
    zero = trajectory.t_us[0]
    t_s = (trajectory.t_us - zero) * 1e-6
    position = CubicSpline(t_s, trajectory.positions)
    rotation = RotationSpline(t_s, Rotation.from_matrix(trajectory.rotations))
    sample_s = (imu.t_us - zero) * 1e-6
    t, w, second = _bump()
    n = len(middles)
    D, A, B, E = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 3))
    for k, middle_s in enumerate((middles - zero) * 1e-6):
        at = middle_s + t
        R = rotation(at).as_matrix()
        force = np.stack([np.interp(at, sample_s, imu.accel[:, axis]) for axis in range(3)], axis=-1)
        D[k], E[k] = second @ position(at), np.tensordot(second, R, 1)
        A[k], B[k] = np.einsum("n,nij,nj->i", w, R, force), np.tensordot(w, R, 1)
    return D, A, B, E, float(w.sum())


def _solve(D: Array, A: Array, B: Array, E: Array, C: float, *, seconds: float) -> MetricScale:
    """Fit k, bias, gravity and place."""
    # No way is so long; what is squared below must stay a number.
    if not np.abs(D).max() < 1e100:
        raise EvaluationError("the poses are beyond measure", hint="track the recording again")
    # Start: without bias and place it is linear in k and k g.
    columns = np.zeros((D.size, 4))
    columns[:, 0] = A.ravel()
    columns[:, 1:] = np.tile(C * np.eye(3), (len(D), 1))
    k, *kg = np.linalg.lstsq(columns, D.ravel(), rcond=None)[0]
    if not abs(k) > 1e-9:
        raise EvaluationError("the camera hardly accelerated", hint="move it to and fro")
    gravity = np.array(kg) / k
    gravity *= GRAVITY_M_S2 / max(float(np.linalg.norm(gravity)), 1e-9)
    start = np.concatenate([[k], gravity, np.zeros(6)])
    sigma = max(float(np.sqrt(np.mean(D**2))), 1e-12)

    def misfit(x: Array) -> Array:
        bend = A + C * x[1:4] - B @ x[4:7] - E @ x[7:10]
        return D - x[0] * bend

    def residuals(x: Array) -> Array:
        length = (float(np.linalg.norm(x[1:4])) - GRAVITY_M_S2) / GRAVITY_SIGMA
        return np.concatenate([misfit(x).ravel() / sigma, [length], x[4:7] / BIAS_M_S2, x[7:10] / LEVER_M])

    # The first fit tells the poses' noise, the second one weighs what was known before against it.
    for _ in range(2):
        fit = least_squares(residuals, start, loss="soft_l1", x_scale=np.maximum(np.abs(start), 1e-2))
        start = fit.x
        sigma = max(1.4826 * float(np.median(np.abs(misfit(fit.x)))), 1e-12)
    k = float(fit.x[0])
    explained = 1.0 - float(np.mean(misfit(fit.x) ** 2)) / float(np.mean(D**2))
    # Each stretch takes part in four bumps.
    variance = 4.0 * float(np.linalg.pinv(fit.jac.T @ fit.jac)[0, 0])
    deviation = float(np.sqrt(variance)) / max(abs(k), 1e-12)
    if k <= 0 or explained < LEAST_EXPLAINED:
        raise EvaluationError(
            f"the accelerations explain {100 * max(explained, 0.0):.0f} % of the way's bends",
            hint="the motion is too slow, or they are not along the camera's axes, in m/s², on the events' clock",
        )
    if deviation > MOST_DEVIATION:
        raise EvaluationError(
            f"the scale is known to {100 * deviation:.0f} % only", hint="move the camera to and fro, or for longer"
        )
    return MetricScale(
        metres_per_unit=1.0 / k,
        deviation=deviation,
        explained=explained,
        gravity_world=fit.x[1:4],
        bias=fit.x[4:7],
        seconds=seconds,
    )
