"""Pose graphs: poses that agree best with relative poses measured between them, by sparse least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

from dvsviz.geometry import se3

Array = NDArray[np.float64]

_MAX_ROUNDS = 30
# A loop closure that is wrong by more than this many sigmas loses its weight (Cauchy).
_CAUCHY_SIGMAS = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edge:
    """A measured pose of frame j in frame i.

    Attributes:
        i: number of the pose that measures.
        j: number of the pose that is measured.
        T_i_j: the measured pose (4, 4).
        rotation_sigma: standard deviation of its rotation, rad.
        translation_sigma: standard deviation of its translation, metres.
    """

    i: int
    j: int
    T_i_j: Array
    rotation_sigma: float
    translation_sigma: float


def optimise(Ts_world: Array, edges: list[Edge]) -> Array:
    """Return the poses (N, 4, 4) that minimise the edges' weighted errors; the first pose stays.

    Gauss-Newton over (turn in the pose's own frame, position in the world), Cauchy weights, damped where a step does
    not help.

    Args:
        Ts_world: poses (N, 4, 4) to start from.
        edges: measurements; every pose must be reached by some from the first one.

    Raises:
        ValueError: an edge names a pose that is not there, or a pose is not connected.
    """
    n = len(Ts_world)
    i, j = np.array([e.i for e in edges], dtype=np.int64), np.array([e.j for e in edges], dtype=np.int64)
    if len(edges) and not (min(i.min(), j.min()) >= 0 and max(i.max(), j.max()) < n):
        raise ValueError(f"edges: expected poses 0 to {n - 1}")
    links = sparse.coo_matrix((np.ones(len(edges)), (i, j)), shape=(n, n))
    parts, _ = sparse.csgraph.connected_components(links, directed=False)
    if parts > 1:
        raise ValueError(f"edges: expected all {n} poses to be connected, got {parts} parts")
    measured = np.array([e.T_i_j for e in edges])
    scale = np.array([[1 / e.rotation_sigma] * 3 + [1 / e.translation_sigma] * 3 for e in edges])
    Ts = np.array(Ts_world, dtype=np.float64)
    cost = _cost(_residuals(Ts, i, j, measured) * scale)
    damping = 1e-9
    for _ in range(_MAX_ROUNDS):
        r = _residuals(Ts, i, j, measured) * scale
        Ji, Jj = _jacobians(Ts, i, j, measured)
        weight = np.sqrt(1 / (1 + (r * r).sum(1) / _CAUCHY_SIGMAS**2))
        weighted: Array = (r * weight[:, None]).ravel()
        blocks = np.stack([Ji, Jj], axis=1) * (scale * weight[:, None])[:, None, :, None]
        rows = np.arange(6 * len(edges)).reshape(-1, 1, 6, 1)
        columns = (np.stack([i, j], axis=1) * 6)[:, :, None, None] + np.arange(6)
        # The first pose stays: its columns are left out.
        is_free = np.broadcast_to(columns >= 6, blocks.shape)
        J = sparse.csr_array(
            (
                blocks[is_free],
                (
                    np.broadcast_to(rows, blocks.shape)[is_free],
                    np.broadcast_to(columns - 6, blocks.shape)[is_free],
                ),
            ),
            shape=(6 * len(edges), 6 * (n - 1)),
        )
        normal, gradient = (J.T @ J).tocsc(), J.T @ weighted
        damped = normal + damping * sparse.diags_array(normal.diagonal() + 1e-12)
        step = np.asarray(spsolve(damped.tocsc(), -gradient)).reshape(-1, 6)
        moved = Ts.copy()
        moved[1:, :3, :3] = Ts[1:, :3, :3] @ se3.exp_so3(step[:, :3])
        moved[1:, :3, 3] += step[:, 3:]
        new = _cost(_residuals(moved, i, j, measured) * scale)
        if new > cost:
            damping = max(damping * 100, 1e-6)
            if damping > 1e6:
                break
            continue
        is_settled = cost - new <= 1e-12 * (cost + 1e-12)
        Ts, cost, damping = moved, new, damping / 10
        if is_settled:
            break
    return Ts


def _cost(r: Array) -> float:
    return float(np.log1p((r * r).sum(axis=1) / _CAUCHY_SIGMAS**2).sum())


def _residuals(Ts: Array, i: NDArray[np.int64], j: NDArray[np.int64], measured: Array) -> Array:
    """Return (E, 6): log(R_ij^T R_i^T R_j) in rad and R_i^T (t_j - t_i) - t_ij in metres."""
    back = np.swapaxes(Ts[i, :3, :3], 1, 2)
    turn = se3.log_so3(np.swapaxes(measured[:, :3, :3], 1, 2) @ back @ Ts[j, :3, :3])
    shift = (back @ (Ts[j, :3, 3] - Ts[i, :3, 3])[..., None])[..., 0] - measured[:, :3, 3]
    return np.concatenate([turn, shift], axis=1)


def _jacobians(Ts: Array, i: NDArray[np.int64], j: NDArray[np.int64], measured: Array) -> tuple[Array, Array]:
    """Return the derivatives (E, 6, 6) of the residuals by (turn, position) of pose i and of pose j."""
    back = np.swapaxes(Ts[i, :3, :3], 1, 2)
    turn = se3.log_so3(np.swapaxes(measured[:, :3, :3], 1, 2) @ back @ Ts[j, :3, :3])
    # log(E exp(d)) ~ log(E) + J_r^-1 d with J_r(x) = J_l(-x); a turn of i acts as -R_j^T R_i d on the right of E.
    right = np.linalg.inv(se3.left_jacobian_so3(-turn))
    Ji, Jj = np.zeros((len(i), 6, 6)), np.zeros((len(i), 6, 6))
    Jj[:, :3, :3] = right
    Ji[:, :3, :3] = -right @ np.swapaxes(Ts[j, :3, :3], 1, 2) @ Ts[i, :3, :3]
    Ji[:, 3:, :3] = se3.hat((back @ (Ts[j, :3, 3] - Ts[i, :3, 3])[..., None])[..., 0])
    Ji[:, 3:, 3:], Jj[:, 3:, 3:] = -back, back
    return Ji, Jj
