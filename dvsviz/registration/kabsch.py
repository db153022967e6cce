"""The rigid motion between two sets of matched 3-D points, in closed form and with outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.registration.records import RegistrationConfig, RegistrationError

Array = NDArray[np.float64]

# Below this ratio of spreads the second axis of a point set is rounding, and the turn about the first one is free.
_FLAT = 1e-9
_BATCH = 128


def kabsch(points_a: Array, points_b: Array, weights: Array | None = None) -> Array:
    """Return `T_a_b` (4, 4) that minimises sum w |p_a - T_a_b p_b|² (seed 002, section 4.7).

    The rotation is `R = W diag(1, 1, det(W V^T)) V^T` of the singular value decomposition of the correlation of the
    centred sets: never a reflection, also where a reflection would fit better.

    Args:
        points_a: points (M, 3) in a, M >= 3.
        points_b: the same points (M, 3) in b.
        weights: (M,) of at least 0; all 1 where not given.

    Raises:
        RegistrationError: the points do not determine the motion: fewer than three, on one line, or such that two
            rotations fit equally well.
        ValueError: the shapes differ, or a value is not finite.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3:
        raise ValueError(f"points_a, points_b: expected the same (M, 3), got {a.shape} and {b.shape}")
    w = np.ones(len(a)) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (len(a),) or not (np.all(np.isfinite(a)) and np.all(np.isfinite(b)) and np.all(np.isfinite(w))):
        raise ValueError(f"points, weights: expected finite values and ({len(a)},) weights, got {w.shape}")
    if np.any(w < 0):
        raise ValueError("weights: expected values of at least 0")
    if np.count_nonzero(w) < 3:
        raise RegistrationError(f"expected at least 3 points, got {np.count_nonzero(w)}")
    w = w / w.sum()
    centre_a, centre_b = w @ a, w @ b
    U, s, Vt = np.linalg.svd(((a - centre_a) * w[:, None]).T @ (b - centre_b))
    # The correlation is a product of two spreads: its second singular value is the square of a flatness.
    for points, centre in ((a, centre_a), (b, centre_b)):
        spread = np.linalg.svd((points - centre) * np.sqrt(w)[:, None], compute_uv=False)
        if spread[1] <= _FLAT * max(spread[0], np.abs(points).max() * 1e-3):
            raise RegistrationError("the points lie on one line: the rotation about it is free")
    sign = np.sign(np.linalg.det(U @ Vt))
    if (sign < 0 and s[1] - s[2] <= _FLAT * s[0]) or s[1] <= _FLAT**2 * s[0]:
        raise RegistrationError("two rotations fit the points equally well")
    R = U @ np.diag([1.0, 1.0, sign]) @ Vt
    return se3.pose(R, centre_a - R @ centre_b)


def rounds_needed(inlier_share: float, sample: int, confidence: float) -> int:
    """Return N = log(1 - p) / log(1 - w^m), the rounds after which one clean sample was seen with confidence p.

    Args:
        inlier_share: share w of inliers, 0 to 1.
        sample: points m a sample.
        confidence: p.
    """
    clean = inlier_share**sample
    if clean >= 1:
        return 1
    if clean <= 1e-12:
        return np.iinfo(np.int64).max
    return max(1, int(np.ceil(np.log(1 - confidence) / np.log1p(-clean))))


def kabsch_inliers(
    points_a: Array, points_b: Array, gate: Array, config: RegistrationConfig, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return a mask (M,) of the points that agree with the best motion of a sample of three.

    The best is the one with the smallest truncated squared distance (the score of MSAC): a count alone cannot tell
    a sample that fits well from one that just fits.

    Args:
        points_a: points (M, 3) in a.
        points_b: the same points in b.
        gate: largest distance (M,) of an inlier, metres.
        config: confidence and limit of rounds.
        rng: draws the samples.

    Raises:
        RegistrationError: fewer than three points, or no sample that determines a motion.
    """
    count = len(points_a)
    if count < 3:
        raise RegistrationError(f"expected at least 3 points with depth in both frames, got {count}")
    best, best_cost, done, needed = np.zeros(count, dtype=bool), np.inf, 0, config.max_rounds
    while done < min(needed, config.max_rounds):
        batch = min(_BATCH, config.max_rounds - done)
        samples = (
            np.argsort(rng.random((batch, count)), axis=1)[:, :3] if count < 12 else _triples(count, batch, rng)
        )
        Ts = _kabsch_triples(points_a[samples], points_b[samples])
        moved = points_b @ np.swapaxes(Ts[:, :3, :3], -1, -2) + Ts[:, None, :3, 3]
        normalised = np.sum((moved - points_a) ** 2, axis=-1) / gate**2
        cost = np.minimum(normalised, 1.0).sum(axis=1)
        k = int(np.argmin(cost))
        if cost[k] < best_cost:
            best, best_cost = normalised[k] < 1, float(cost[k])
        done += batch
        needed = rounds_needed(float(best.mean()), 3, config.confidence)
    if best.sum() < 3:
        raise RegistrationError("no three points agree on a motion")
    return best


def _triples(count: int, batch: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return triples (batch, 3) of different numbers below `count`."""
    first = rng.integers(0, count, batch)
    second = (first + rng.integers(1, count, batch)) % count
    third = rng.integers(0, count - 2, batch)
    low, high = np.minimum(first, second), np.maximum(first, second)
    third = third + (third >= low)
    third = third + (third >= high)
    return np.column_stack([first, second, third])


def _kabsch_triples(a: Array, b: Array) -> Array:
    """Return motions (B, 4, 4) of triples (B, 3, 3); those on a line get some motion, which finds no friends."""
    centre_a, centre_b = a.mean(axis=1), b.mean(axis=1)
    U, _, Vt = np.linalg.svd(np.swapaxes(a - centre_a[:, None], 1, 2) @ (b - centre_b[:, None]))
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    R = U @ Vt
    return se3.pose(R, centre_a - (R @ centre_b[..., None])[..., 0])
