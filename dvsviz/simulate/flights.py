"""Flights of a quadrotor that carries the camera: circle, rectangle and lawnmower, flown by its controller.

World: z up, the floor at z = 0. What is planned is a path; what is flown is what the controller makes of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.simulate.models.cameras import R_BODY_OPTICAL
from dvsviz.simulate.models.quadrotor import Quadrotor, fly, poses_of
from dvsviz.simulate.spline import SplineMotion

Array = NDArray[np.float64]
FlightName = Literal["circle", "rectangle", "lawnmower"]
FLIGHTS: tuple[str, ...] = get_args(FlightName)

HEIGHT = 1.5
_STEP_S = 0.005
# Poses kept of a flight: the attitude loop has about 2 Hz.
_KEPT_HZ = 50.0
# A quarter turn in place takes this long: with 0.1 m/s the flights last as long as those of the study they follow.
_TURN_S = 4.0
_SPEED = 0.1
# Wind: acceleration (standard deviation, m/s²) and the time over which it changes, s.
_GUST, _GUST_S = 0.1, 1.0


def camera_mount(pitch_deg: float = 45.0, position: ArrayLike = (0.1, 0.0, 0.0)) -> Array:
    """Return `T_body_camera` (4, 4) of a camera that looks forward and `pitch_deg` down."""
    down = se3.exp_so3([0.0, np.radians(pitch_deg), 0.0])
    return se3.pose(down @ R_BODY_OPTICAL, position)


def circle_plan(
    *, radius: float = 1.0, height: float = HEIGHT, turn_s: float = 40.0, turns: float = 2.0
) -> tuple[Array, Array]:
    """Return wanted positions (N, 3) and yaws (N,), 5 ms apart, of circles that look inwards."""
    angle = 2 * np.pi * np.arange(round(turns * turn_s / _STEP_S) + 1) * _STEP_S / turn_s
    p = [radius * np.cos(angle + np.pi), radius * np.sin(angle + np.pi), np.full(len(angle), height)]
    return np.stack(p, axis=1), angle.astype(np.float64)


def legs_plan(
    corners: Sequence[tuple[float, float]],
    yaws: Sequence[float],
    *,
    height: float = HEIGHT,
    speed: float = _SPEED,
    turn_s: float = _TURN_S,
) -> tuple[Array, Array]:
    """Return wanted positions (N, 3) and yaws (N,), 5 ms apart: straight legs, turns in place between them.

    Args:
        corners: (x, y) of K + 1 corners, m.
        yaws: of the K legs, rad; turns go the way the numbers go.
        height: m.
        speed: along the legs, m/s.
        turn_s: for a quarter turn, s.
    """
    points, headings = [], []
    for k, yaw in enumerate(yaws):
        a, b = np.array([*corners[k], height]), np.array([*corners[k + 1], height])
        steps = max(round(float(np.linalg.norm(b - a)) / speed / _STEP_S), 1)
        points.append(a + np.arange(steps)[:, None] / steps * (b - a))
        headings.append(np.full(steps, yaw))
        if k + 1 < len(yaws) and yaws[k + 1] != yaw:
            turn = yaws[k + 1] - yaw
            steps = round(abs(turn) / (np.pi / 2) * turn_s / _STEP_S)
            share = (1 - np.cos(np.pi * np.arange(steps) / steps)) / 2
            points.append(np.tile(b, (steps, 1)))
            headings.append(yaw + share * turn)
    return np.concatenate(points), np.concatenate(headings)


def rectangle_plan(laps: int = 2) -> tuple[Array, Array]:
    """Return the plan of 2 m by 1 m, looking inwards, across the direction of motion."""
    lap = [(-1.0, 0.0), (-1.0, -0.5), (1.0, -0.5), (1.0, 0.5), (-1.0, 0.5)]
    corners = [*lap * laps, (-1.0, 0.0)]
    yaws = [side * np.pi / 2 for turn in range(laps) for side in range(4 * turn, 4 * turn + 5)]
    # The last leg of a lap and the first of the next are one side: its middle is a corner without a turn.
    return legs_plan(corners, yaws)


def lawnmower_plan() -> tuple[Array, Array]:
    """Return the plan of lanes 1 m long and 0.5 m apart over 2 m and back, looking ahead."""
    lanes = [(-1.0, 0.0), (-1.0, -0.5), (-0.5, -0.5), (-0.5, 0.5), (0.0, 0.5), (0.0, -0.5), (0.5, -0.5), (0.5, 0.5)]
    end = [(1.0, 0.5), (1.0, -0.5)]
    back = [(0.5, -0.5), (0.5, 0.5), (0.0, 0.5), (0.0, -0.5), (-0.5, -0.5), (-0.5, 0.5), (-1.0, 0.5), (-1.0, 0.0)]
    corners = [*lanes, *end, *back]
    ahead = [np.arctan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(corners)]
    return legs_plan(corners, np.unwrap(ahead).tolist())


_PLANS: dict[str, Callable[[], tuple[Array, Array]]] = {
    "circle": circle_plan,
    "rectangle": rectangle_plan,
    "lawnmower": lawnmower_plan,
}


def flight(
    name: str,
    rng: np.random.Generator | None = None,
    *,
    model: Quadrotor | None = None,
    T_body_camera: Array | None = None,
) -> SplineMotion:
    """Return the camera's motion in a flight.

    Args:
        name: `circle` (radius 1 m, height 1.5 m, looking inwards, 40 s a turn, two turns), `rectangle` (2 m by 1 m,
            looking inwards, two laps) or `lawnmower` (lanes of 1 m, looking ahead), the last two at 0.1 m/s.
        rng: gives the wind; None for still air.
        model: the quadrotor.
        T_body_camera: the camera's place (4, 4) on it; 45 degrees down where None.

    Raises:
        ValueError: the name is not known.
    """
    if name not in _PLANS:
        raise ValueError(f"motion: expected {', '.join(FLIGHTS)}, got {name!r}")
    position, yaw = _PLANS[name]()
    return fly_plan(position, yaw, rng, model=model, T_body_camera=T_body_camera)


def fly_plan(
    position: Array,
    yaw: Array,
    rng: np.random.Generator | None = None,
    *,
    model: Quadrotor | None = None,
    T_body_camera: Array | None = None,
) -> SplineMotion:
    """Return the camera's motion when a plan, positions (N, 3) and yaws (N,) 5 ms apart, is flown; see `flight`."""
    model = Quadrotor() if model is None else model
    mount = camera_mount() if T_body_camera is None else T_body_camera
    forces = None if rng is None else model.mass * gusts(len(yaw), rng)
    states = fly(model, position, yaw, _STEP_S, forces=forces)
    kept = np.unique(np.append(np.arange(0, len(yaw), round(1 / (_KEPT_HZ * _STEP_S))), len(yaw) - 1))
    t_us = np.round(kept * _STEP_S * 1e6).astype(np.int64)
    return SplineMotion(Trajectory(t_us=t_us, Ts_world_camera=poses_of(states[kept]) @ mount))


def gusts(count: int, rng: np.random.Generator) -> Array:
    """Return accelerations by wind (count, 3), m/s², 5 ms apart: Gauss-Markov, `a' = -a / T + sqrt(2 / T) s n`."""
    keep = np.exp(-_STEP_S / _GUST_S)
    out = np.empty((count, 3))
    kicks = _GUST * np.sqrt(1 - keep**2) * rng.standard_normal((count, 3))
    a = _GUST * rng.standard_normal(3)
    for k in range(count):
        out[k] = a
        a = keep * a + kicks[k]
    return out
