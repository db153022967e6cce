"""The similarity that lays estimated positions on true ones, and the rotation that lays rotations on rotations.

Least squares after S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
IEEE PAMI 13(4), 1991; its equation numbers stand at the lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import EvaluationError
from dvsviz.geometry import se3

Array = NDArray[np.float64]
AlignmentKind = Literal["sim3", "se3", "none"]
Degeneracy = Literal["", "straight line", "no translation"]

STRAIGHT = 1e-3
"""Positions whose second extent is below this share of the first lie on a straight line."""
STILL_M = 1e-9
"""Positions that spread less than this do not move: far below any sensor, far above rounding."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """A similarity: `p_truth = scale * R_truth_world @ p_world + t_truth_world`.

    Attributes:
        kind: what was asked for.
        scale: metres of the truth by unit of the estimate; 1 where it was not asked for.
        R_truth_world: rotation (3, 3) taken from the positions.
        t_truth_world: translation (3,).
        degeneracy: why the positions do not fix all of it, or "".
    """

    kind: AlignmentKind
    scale: float
    R_truth_world: Array
    t_truth_world: Array
    degeneracy: Degeneracy = ""

    @property
    def name(self) -> str:
        """The kind, and what was assumed where positions leave a part of it free."""
        if self.degeneracy == "straight line":
            return f"{self.kind} (straight line: least rotation)"
        if self.degeneracy == "no translation":
            return f"{self.kind} (no translation)"
        return self.kind

    def positions(self, p_world: Array) -> Array:
        """Return positions (N, 3) of the estimate's world in the truth's."""
        return self.scale * (p_world @ self.R_truth_world.T) + self.t_truth_world

    def positions_back(self, p_truth: Array) -> Array:
        """Return positions (N, 3) of the truth's world in the estimate's.

        Raises:
            ValueError: the scale is zero: an estimate that does not move has no way back.
        """
        if self.scale <= 0:
            raise ValueError("scale: expected an alignment with a scale above 0")
        return (p_truth - self.t_truth_world) @ self.R_truth_world / self.scale


def spread(positions: Array) -> float:
    """Return the root mean square distance of positions (N, 3) from their mean."""
    return float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=-1))))


def is_straight(positions: Array) -> bool:
    """Return True where positions (N, 3), N >= 1, lie on a straight line."""
    s = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    return len(s) < 2 or bool(s[1] <= STRAIGHT * s[0])


def align_positions(p_world: Array, p_truth: Array, kind: AlignmentKind = "sim3") -> Alignment:
    """Return the alignment with the least squares error of positions.

    Where either set of positions lies on a straight line the rotation about that line is free: the least rotation
    that lays line on line is taken. Where either does not move, the rotation is the identity, a sim3 scale 0.

    Args:
        p_world: estimated positions (N, 3).
        p_truth: true positions (N, 3).
        kind: with scale (`sim3`), without (`se3`), or no alignment at all (`none`).

    Raises:
        EvaluationError: the sets differ in length or are empty.
    """
    if p_world.shape != p_truth.shape or len(p_world) == 0:
        raise EvaluationError(
            f"positions: expected as many estimated as true, got {len(p_world)} and {len(p_truth)}"
        )
    still = min(spread(p_world), spread(p_truth)) < STILL_M
    if kind == "none":
        degeneracy = "no translation" if still else ""
        return Alignment(
            kind=kind, scale=1.0, R_truth_world=np.eye(3), t_truth_world=np.zeros(3), degeneracy=degeneracy
        )
    mean_world, mean_truth = p_world.mean(axis=0), p_truth.mean(axis=0)  # eq. 34, 35
    if still:
        scale = 0.0 if kind == "sim3" else 1.0
        return Alignment(
            kind=kind,
            scale=scale,
            R_truth_world=np.eye(3),
            t_truth_world=mean_truth - scale * mean_world,
            degeneracy="no translation",
        )
    a, b = p_world - mean_world, p_truth - mean_truth
    U, D, Vt = np.linalg.svd(b.T @ a / len(a))  # covariance, eq. 38
    degeneracy: Degeneracy = ""
    if is_straight(p_world) or is_straight(p_truth):
        R, strength, degeneracy = least_rotation(Vt[0], U[:, 0]), D[0], "straight line"
    else:
        S = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])  # eq. 43
        R, strength = (U * S) @ Vt, float(D @ S)  # eq. 40
    scale = float(strength / np.mean(np.sum(a**2, axis=-1))) if kind == "sim3" else 1.0  # eq. 36, 42
    return Alignment(
        kind=kind,
        scale=scale,
        R_truth_world=R,
        t_truth_world=mean_truth - scale * R @ mean_world,  # eq. 41
        degeneracy=degeneracy,
    )


def least_rotation(a: Array, b: Array) -> Array:
    """Return the rotation (3, 3) of least angle that takes unit vector `a` (3,) to unit vector `b` (3,)."""
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        # Opposite: half a turn about any axis across them; the one nearest to a coordinate axis is as good as any.
        e = np.eye(3)[int(np.argmin(np.abs(a)))]
        axis, sine = np.cross(a, e), 0.0
    return se3.exp_so3(axis / np.linalg.norm(axis) * np.arctan2(sine, cosine))


def align_rotations(Rs_world: Array, Rs_truth: Array) -> Array:
    """Return `R_truth_world` (3, 3) that minimises the sum of `|R_truth - R_truth_world @ R_world|²` (Frobenius).

    Args:
        Rs_world: estimated rotations (N, 3, 3).
        Rs_truth: true rotations (N, 3, 3).
    """
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", Rs_truth, Rs_world))
    return (U * np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])) @ Vt
