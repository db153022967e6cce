"""All registration methods by name: the source's six, and those a user would pick today."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import ConfigError
from dvsviz.registration.dense import pnp_dense
from dvsviz.registration.essential import essential, homography
from dvsviz.registration.kabsch import kabsch, kabsch_inliers
from dvsviz.registration.pnp import pnp, pnp_magsac, pnp_refined
from dvsviz.registration.records import (
    MatchedPoints,
    Registration,
    RegistrationConfig,
    RegistrationError,
    depth_sigma,
    failed,
)

Method = Callable[[MatchedPoints, RegistrationConfig, float | None], Registration]
KabschWeights = Literal["equal", "depth"]

# Squared distances of three dimensions pass 3.4 sigma with 99 %.
_GATE_SIGMAS = 3.4
_REFITS = 3


def kabsch_ransac(
    matched: MatchedPoints, config: RegistrationConfig, *, weights: KabschWeights = "equal"
) -> Registration:
    """Return the motion of 3-D points of both frames, RANSAC over samples of three, refitted to the inliers.

    Args:
        matched: points with depth in both frames, at least three.
        config: thresholds.
        weights: "depth" weighs each point by the inverse of its depth's variance.
    """
    usable = matched.has_both_depths
    both = matched[usable]
    gate = _GATE_SIGMAS * _sigma(both)
    try:
        inside = kabsch_inliers(both.points_a, both.points_b, gate, config, np.random.default_rng(config.seed))
        T_a_b = _fit(both, inside, weights)
        for _ in range(_REFITS):
            moved = both.points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]
            inside = np.linalg.norm(moved - both.points_a, axis=1) < gate
            T_a_b = _fit(both, inside, weights)
    except RegistrationError as error:
        return failed(len(matched), str(error))
    return _kept(matched, usable, inside, T_a_b, config)


def kabsch_on(other: Registration, matched: MatchedPoints, config: RegistrationConfig) -> Registration:
    """Return the motion of 3-D points of both frames on the inliers of another method."""
    if not other.is_found:
        return other
    usable = other.inliers & matched.has_both_depths
    both = matched[usable]
    inside = np.ones(len(both), dtype=bool)
    try:
        T_a_b = _fit(both, inside, "equal")
    except RegistrationError as error:
        return failed(len(matched), str(error))
    return _kept(matched, usable, inside, T_a_b, config)


def no_motion(matched: MatchedPoints) -> Registration:
    """Return "nothing moved": what every method has to beat."""
    return replace(failed(len(matched), ""), scale="unit")


def _sigma(both: MatchedPoints) -> NDArray[np.float64]:
    return np.hypot(depth_sigma(both.depth_a, both.focal_px), depth_sigma(both.depth_b, both.focal_px))


def _fit(both: MatchedPoints, inside: NDArray[np.bool_], weights: KabschWeights) -> NDArray[np.float64]:
    w = 1 / _sigma(both)[inside] ** 2 if weights == "depth" else None
    return kabsch(both.points_a[inside], both.points_b[inside], w)


def _kept(
    matched: MatchedPoints,
    usable: NDArray[np.bool_],
    inside: NDArray[np.bool_],
    T_a_b: NDArray[np.float64],
    config: RegistrationConfig,
) -> Registration:
    if inside.sum() < config.min_inliers:
        return failed(len(matched), f"only {inside.sum()} points agree with one motion")
    inliers = np.zeros(len(matched), dtype=bool)
    inliers[np.flatnonzero(usable)[inside]] = True
    return Registration(T_a_b=T_a_b, inliers=inliers, scale="depth")


METHODS: dict[str, Method] = {
    "none": lambda m, c, s: no_motion(m),
    "essential": lambda m, c, s: essential(m, c, step_length=s),
    "kabsch": lambda m, c, s: kabsch_ransac(m, c),
    "kabsch-essential": lambda m, c, s: kabsch_on(essential(m, c), m, c),
    "kabsch-pnp": lambda m, c, s: kabsch_on(pnp(m, c), m, c),
    "pnp-iterative": lambda m, c, s: pnp(m, c),
    "epnp": lambda m, c, s: pnp(m, c, solver=cv2.SOLVEPNP_EPNP),
    "essential-refined": lambda m, c, s: essential(m, c, step_length=s, refined=True),
    "homography": lambda m, c, s: homography(m, c, step_length=s),
    "pnp-refined": lambda m, c, s: pnp_refined(m, c),
    "pnp-icp": lambda m, c, s: pnp_dense(m, c),
    "kabsch-weighted": lambda m, c, s: kabsch_ransac(m, c, weights="depth"),
    "essential-magsac": lambda m, c, s: essential(m, c, sampler=cv2.USAC_MAGSAC, step_length=s),
    "homography-magsac": lambda m, c, s: homography(m, c, sampler=cv2.USAC_MAGSAC, step_length=s),
    "pnp-magsac": lambda m, c, s: pnp_magsac(m, c),
}

# The six of seed 002.
SOURCE_METHODS = ("essential", "kabsch", "kabsch-essential", "kabsch-pnp", "pnp-iterative", "epnp")
WITHOUT_DEPTH = frozenset(
    {"none", "essential", "essential-refined", "essential-magsac", "homography", "homography-magsac"}
)

# These look at whole depth images.
DENSE = frozenset({"pnp-icp"})


def method_names(text: str) -> tuple[str, ...]:
    """Return the methods of a comma-separated list; `all` is every one, `source` the six of seed 002.

    Raises:
        ConfigError: a name is not known.
    """
    names: list[str] = []
    for word in (part.strip() for part in text.split(",")):
        group = tuple(METHODS) if word == "all" else SOURCE_METHODS if word == "source" else (word,)
        names += [name for name in group if name not in names]
    if unknown := [name for name in names if name not in METHODS]:
        raise ConfigError(
            f"unknown method {', '.join(unknown)}", hint=f"known are all, source, {', '.join(METHODS)}"
        )
    return tuple(names)


def register(
    matched: MatchedPoints, method: str, config: RegistrationConfig, *, step_length: float | None = None
) -> Registration:
    """Return the pose of camera b in camera a by one method.

    Args:
        matched: the matches.
        method: a key of `METHODS`.
        config: thresholds.
        step_length: metres travelled where a motion model knows them: the scale of methods without depth.

    Raises:
        ConfigError: the method is not known.
    """
    if method not in METHODS:
        raise ConfigError(f"unknown method {method}", hint=f"known are {', '.join(METHODS)}")
    return METHODS[method](matched, config, step_length)
