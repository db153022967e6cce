"""Registration methods on synthetic matches with outliers, noise and known motion."""

from __future__ import annotations

import numpy as np
import pytest

from dvsviz.errors import ConfigError
from dvsviz.geometry import se3
from dvsviz.registration.methods import METHODS, SOURCE_METHODS, method_names, register
from dvsviz.registration.pnp import normal_equations
from dvsviz.registration.records import MatchedPoints, RegistrationConfig, depth_sigma

FOCAL = 500.0
T_A_B = se3.pose(se3.exp_so3([0.02, -0.04, 0.03]), [0.10, -0.04, 0.06])
CONFIG = RegistrationConfig()


def scene(*, planar: bool = False, noise_px: float = 0.0, outliers: int = 0, depth: bool = True) -> MatchedPoints:
    rng = np.random.default_rng(11)
    bearing = rng.uniform(-0.6, 0.6, (200, 2)) * [1.0, 0.7]
    rays = np.column_stack([bearing, np.ones(200)])
    if planar:
        z = 2.0 / (rays @ [0.1, -0.2, 1.0])
    else:
        z = rng.uniform(1.0, 3.0, 200)
    a = rays * z[:, None]
    b = (a - T_A_B[:3, 3]) @ T_A_B[:3, :3]
    pixels_b = b[:, :2] / b[:, 2:] + rng.normal(size=(200, 2)) * noise_px / FOCAL
    pixels_b[:outliers] = rng.uniform(-0.6, 0.6, (outliers, 2))
    depth_a, depth_b = a[:, 2].copy(), b[:, 2].copy()
    if noise_px:
        depth_a += rng.normal(size=200) * depth_sigma(depth_a, FOCAL) * 0.5
        depth_b += rng.normal(size=200) * depth_sigma(depth_b, FOCAL) * 0.5
    if not depth:
        depth_a[:], depth_b[:] = np.nan, np.nan
    matched = MatchedPoints(
        bearings_a=bearing, bearings_b=pixels_b, depth_a=depth_a, depth_b=depth_b, focal_px=FOCAL
    )
    for array in (bearing, pixels_b, depth_a, depth_b):
        array.setflags(write=False)
    return matched


def errors(T: np.ndarray) -> tuple[float, float]:
    return (
        float(se3.rotation_angle(T_A_B[:3, :3].T @ T[:3, :3])),
        float(np.linalg.norm(T[:3, 3] - T_A_B[:3, 3])),
    )


@pytest.mark.parametrize("method", [m for m in METHODS if m != "none"])
def test_exact_matches_give_the_motion(method: str) -> None:
    found = register(scene(planar="homography" in method), method, CONFIG)
    assert found.reason == ""
    assert found.scale == "depth"
    rotation, translation = errors(found.T_a_b)
    assert rotation < 1e-4
    assert translation < 1e-3


@pytest.mark.parametrize("method", [m for m in METHODS if m != "none"])
def test_noise_and_outliers(method: str) -> None:
    matched = scene(planar="homography" in method, noise_px=0.5, outliers=50)
    found = register(matched, method, CONFIG)
    assert found.reason == ""
    rotation, translation = errors(found.T_a_b)
    # Plain RANSAC keeps a minimal sample's motion for E, which is the noisiest of all.
    assert rotation < 0.012
    assert translation < 0.03
    assert found.inliers[50:].mean() > 0.6
    assert found.inliers[:50].mean() < 0.15


def test_refinement_beats_what_it_started_from() -> None:
    matched = scene(noise_px=0.5, outliers=50)
    plain, refined = (register(matched, m, CONFIG) for m in ("epnp", "pnp-refined"))
    assert errors(refined.T_a_b)[1] < errors(plain.T_a_b)[1]
    equal, weighted = (register(matched, m, CONFIG) for m in ("kabsch", "kabsch-weighted"))
    assert errors(weighted.T_a_b)[1] < 1.2 * errors(equal.T_a_b)[1]


@pytest.mark.parametrize("method", ["essential", "essential-magsac", "homography"])
def test_scale_is_stated_and_never_guessed(method: str) -> None:
    matched = scene(planar=method == "homography", depth=False)
    unit = register(matched, method, CONFIG)
    assert unit.scale == "unit"
    assert np.linalg.norm(unit.T_a_b[:3, 3]) == pytest.approx(1)
    moved = register(matched, method, CONFIG, step_length=float(np.linalg.norm(T_A_B[:3, 3])))
    assert moved.scale == "motion"
    assert errors(moved.T_a_b)[1] < 2e-3


@pytest.mark.parametrize("method", [m for m in METHODS if m != "none"])
def test_too_few_matches_are_a_reason_not_an_exception(method: str) -> None:
    for count in (0, 2, 4):
        found = register(scene()[np.arange(count)], method, CONFIG)
        assert not found.is_found
        assert found.reason
        np.testing.assert_array_equal(found.T_a_b, np.eye(4))


@pytest.mark.parametrize("method", ["kabsch", "kabsch-pnp", "pnp-iterative", "epnp", "pnp-refined", "pnp-magsac"])
def test_methods_that_need_depth_say_so(method: str) -> None:
    found = register(scene(depth=False), method, CONFIG)
    assert "depth" in found.reason


def test_wide_pixels_are_not_a_diagonal_focal_length() -> None:
    """With sqrt(fx² + fy²) in the place of the focal length the rotation is wrong by far more than ours."""
    matched = scene()
    wrong = MatchedPoints(
        bearings_a=matched.bearings_a / np.sqrt(2),
        bearings_b=matched.bearings_b / np.sqrt(2),
        depth_a=matched.depth_a,
        depth_b=matched.depth_b,
        focal_px=FOCAL * np.sqrt(2),
    )
    ours = errors(register(matched, "essential", CONFIG).T_a_b)[0]
    theirs = errors(register(wrong, "essential", CONFIG).T_a_b)[0]
    assert theirs > 20 * ours
    assert theirs > 0.005


def test_same_seed_same_answer() -> None:
    matched = scene(noise_px=0.5, outliers=50)
    for method in METHODS:
        first, second = (register(matched, method, CONFIG) for _ in range(2))
        np.testing.assert_array_equal(first.T_a_b, second.T_a_b)


def test_refinement_gradient_against_central_differences() -> None:
    matched = scene(noise_px=1.0)
    T = se3.inverse(T_A_B)
    _, _, gradient = normal_equations(T, matched, 1.0)
    h = 1e-7
    for k, d in enumerate(np.eye(6) * h):
        moved = [se3.pose(se3.exp_so3(s * d[:3]) @ T[:3, :3], T[:3, 3] + s * d[3:]) for s in (1.0, -1.0)]
        slope = (normal_equations(moved[0], matched, 1.0)[0] - normal_equations(moved[1], matched, 1.0)[0]) / (
            2 * h
        )
        assert slope == pytest.approx(gradient[k], rel=1e-4, abs=1e-2)


def test_method_lists() -> None:
    assert method_names("source") == SOURCE_METHODS
    assert method_names("all") == tuple(METHODS)
    assert method_names("epnp, epnp,none") == ("epnp", "none")
    with pytest.raises(ConfigError, match="unknown method sorcery; known are all, source"):
        method_names("epnp,sorcery")
    with pytest.raises(ConfigError, match="unknown method"):
        register(scene(), "sorcery", CONFIG)
