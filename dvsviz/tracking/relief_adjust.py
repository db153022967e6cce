"""Bundle adjustment of the relief map's last views: their poses and the landmarks they see, together.

Every observation is a place across a line: what a view saw of a landmark. The two unknowns of a landmark are eliminated
(Schur complement), what older views said of it is a prior on them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.tracking.relief_kernels import derivatives

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """What views saw of landmarks.

    Attributes:
        landmark: (M,).
        view: number (M,) of the view in the lag window.
        normal: of the line (M, 2) in the view.
        place_px: of the line along its normal (M,), px.
        weight: observations that it counts for (M,), 1 / px².
    """

    landmark: NDArray[np.int64]
    view: NDArray[np.int64]
    normal: Array
    place_px: Array
    weight: Array


def adjust(
    rays: Array,
    states: Array,
    prior_states: Array,
    prior_information: Array,
    Ts_world_camera: Array,
    held: NDArray[np.bool_],
    free: NDArray[np.bool_],
    sightings: Sightings,
    focal_px: float,
    *,
    rounds: int,
    scale_px: float,
) -> tuple[Array, Array, Array]:
    """Return poses (V, 4, 4), states (L, 2) and the landmarks' information (L, 2, 2) that fit the sightings best.

    Args:
        rays: (L, 12).
        states: start (L, 2).
        prior_states: what is known of the states (L, 2).
        prior_information: how well (L, 2, 2).
        Ts_world_camera: start (V, 4, 4).
        held: views (V,) whose pose is not moved.
        free: mask (6,) of rotation and position to solve for.
        sightings: in any order.
        focal_px: focal length.
        rounds: of Gauss-Newton.
        scale_px: of the robust (Cauchy) weight.
    """
    order = np.argsort(sightings.landmark, kind="stable")
    landmark, view = sightings.landmark[order], sightings.view[order]
    normal, place, weight = sightings.normal[order], sightings.place_px[order], sightings.weight[order]
    seen = np.unique(landmark)
    first = np.append(np.searchsorted(landmark, seen), len(landmark)).astype(np.int64)
    Ts, states, count = Ts_world_camera.copy(), states.copy(), len(Ts_world_camera)
    axes = np.flatnonzero(free)
    size = len(axes)
    unknown = np.flatnonzero(np.repeat(~held, size))
    information = prior_information.copy()
    for _ in range(rounds):
        S, g = np.zeros((size * count, size * count)), np.zeros(size * count)
        J, Js = np.empty((len(landmark), size)), np.empty((len(landmark), 2))
        w, own = np.empty(len(landmark)), np.empty((len(seen), 2))
        _equations(
            rays, states, prior_states, prior_information, np.ascontiguousarray(Ts[:, :3, :3]),
            np.ascontiguousarray(Ts[:, :3, 3]), focal_px, scale_px, axes, seen, first, view, normal, place, weight,
            J, Js, w, own, information, S, g,
        )  # fmt: skip
        step = np.zeros(size * count)
        if len(unknown):
            A = S[np.ix_(unknown, unknown)]
            # A view that sees nothing stays where it is.
            A[np.diag_indices_from(A)] += 1e-6 * (1.0 + A[np.diag_indices_from(A)])
            step[unknown] = np.linalg.solve(A, g[unknown])
        _states_follow(seen, first, view, J, Js, w, own, information, step.reshape(count, size), states)
        by_view = np.zeros((count, 6))
        by_view[:, axes] = step.reshape(count, size)
        Ts[:, :3, :3] = Ts[:, :3, :3] @ se3.exp_so3(by_view[:, :3])
        Ts[:, :3, 3] += by_view[:, 3:]
    return Ts, states, information


@numba.njit(cache=True, nogil=True)
def _equations(
    rays, states, prior, known, Rs, ps, focal, scale, axes, seen, first, view, normal, place, weight,
    J, Js, w, own, information, S, g,
):  # fmt: skip
    """Write derivatives, weights and the landmarks' own right sides; add the poses' reduced equations."""
    size = axes.shape[0]
    reduced, all_six = np.empty((2, size)), np.empty(6)
    for s in range(seen.shape[0]):
        i = seen[s]
        a, b, d = known[i, 0, 0], known[i, 0, 1], known[i, 1, 1]
        e0, e1 = prior[i, 0] - states[i, 0], prior[i, 1] - states[i, 1]
        r0, r1 = a * e0 + b * e1, b * e0 + d * e1
        for m in range(first[s], first[s + 1]):
            v = view[m]
            e = place[m] - derivatives(
                rays[i], states[i, 0], states[i, 1], Rs[v], ps[v], normal[m], focal, all_six, Js[m]
            )
            for k in range(size):
                J[m, k] = all_six[axes[k]]
            w[m] = weight[m] / (1.0 + e * e / (scale * scale))
            a += w[m] * Js[m, 0] * Js[m, 0]
            b += w[m] * Js[m, 0] * Js[m, 1]
            d += w[m] * Js[m, 1] * Js[m, 1]
            r0 += w[m] * e * Js[m, 0]
            r1 += w[m] * e * Js[m, 1]
            for k in range(size):
                g[size * v + k] += w[m] * e * J[m, k]
                for j in range(size):
                    S[size * v + k, size * v + j] += w[m] * J[m, k] * J[m, j]
        information[i, 0, 0], information[i, 0, 1], information[i, 1, 0], information[i, 1, 1] = a, b, b, d
        own[s, 0], own[s, 1] = r0, r1
        det = a * d - b * b
        if det <= 0.0:
            continue
        for m in range(first[s], first[s + 1]):
            # (landmark's information)^-1 times its coupling with this sighting's pose.
            c0 = (d * Js[m, 0] - b * Js[m, 1]) / det
            c1 = (a * Js[m, 1] - b * Js[m, 0]) / det
            for k in range(size):
                reduced[0, k], reduced[1, k] = w[m] * J[m, k] * c0, w[m] * J[m, k] * c1
                g[size * view[m] + k] -= reduced[0, k] * r0 + reduced[1, k] * r1
            for n in range(first[s], first[s + 1]):
                q0, q1 = w[n] * Js[n, 0], w[n] * Js[n, 1]
                for k in range(size):
                    x = reduced[0, k] * q0 + reduced[1, k] * q1
                    for j in range(size):
                        S[size * view[m] + k, size * view[n] + j] -= x * J[n, j]


@numba.njit(cache=True, nogil=True)
def _states_follow(seen, first, view, J, Js, w, own, information, by_view, states):
    """Move the landmarks by their own right sides and by the poses' steps (V, size)."""
    size = by_view.shape[1]
    for s in range(seen.shape[0]):
        i = seen[s]
        r0, r1 = own[s, 0], own[s, 1]
        for m in range(first[s], first[s + 1]):
            along = 0.0
            for k in range(size):
                along += J[m, k] * by_view[view[m], k]
            r0 -= w[m] * along * Js[m, 0]
            r1 -= w[m] * along * Js[m, 1]
        a, b, d = information[i, 0, 0], information[i, 0, 1], information[i, 1, 1]
        det = a * d - b * b
        if det > 0.0:
            states[i, 0] += (d * r0 - b * r1) / det
            # A landmark's inverse depth stays positive, and is not halved or doubled at once.
            states[i, 1] = min(max(states[i, 1] + (a * r1 - b * r0) / det, 0.5 * states[i, 1]), 2.0 * states[i, 1])
