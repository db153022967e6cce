"""Lines of the map: what the distance to them tells of a pose, and where a pose that went astray is looked for."""

import numpy as np
import pytest

from dvsviz.config import TrackerConfig
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.session.records import Status
from dvsviz.tracking.align import Alignment, align, free_parameters
from dvsviz.tracking.failures import FailureWatch
from dvsviz.tracking.finder import PoseFinder
from dvsviz.tracking.mapping import Mapper
from dvsviz.tracking.planar_map import PlanarMap
from dvsviz.tracking.pose_equations import to_ridge
from dvsviz.tracking.relocalize import relocalize
from dvsviz.tracking.state import Motion

CAMERA = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5)
ALL = free_parameters("planar")


def blurred_line(angle: float, offset_px: float) -> np.ndarray:
    """An image (41, 41) float32 of a line, blurred by 1.2 px, through its middle plus an offset along its normal."""
    y, x = np.mgrid[:41, :41] - 20.0
    return np.exp(-0.5 * (x * np.cos(angle) + y * np.sin(angle) - offset_px) ** 2 / 1.2**2).astype(np.float32)


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4, 1.2, np.pi / 2, 2.5])
def test_the_distance_to_a_line(angle: float) -> None:
    image = blurred_line(angle, 0.3)
    normal = np.array([np.cos(angle), np.sin(angle)])
    told = []
    for along in (-0.05, 0.15, 0.3, 0.45, 0.65):
        # A way along the line changes nothing.
        u, v = 20.0 + along * normal + 3.7 * np.array([-normal[1], normal[0]])
        nx, ny, off = to_ridge(image, u, v)
        cosine = nx * normal[0] + ny * normal[1]
        assert abs(cosine) > 0.99
        told.append(np.sign(cosine) * off)
    # Exact on the line; further off a single step goes a little too far.
    assert told[2] == pytest.approx(0.0, abs=0.1)
    assert np.all(np.diff(told) > 0.05)
    assert np.abs(np.array(told) - [-0.35, -0.15, 0.0, 0.15, 0.35]).max() < 0.2


def test_a_blob_or_nothing_is_no_line() -> None:
    y, x = np.mgrid[:41, :41] - 20.0
    blob = np.exp(-0.5 * (x**2 + y**2) / 1.5**2).astype(np.float32)
    assert to_ridge(blob, 20.2, 19.8) == (0.0, 0.0, 0.0)
    assert to_ridge(np.zeros((41, 41), dtype=np.float32), 20.0, 20.0) == (0.0, 0.0, 0.0)
    for u, v in ((0.0, 20.0), (40.0, 20.0), (20.0, 0.2), (20.0, 39.9)):
        assert to_ridge(blurred_line(0.3, 0.0), u, v) == (0.0, 0.0, 0.0)


def star(at: tuple[float, float], rng: np.random.Generator, count: int) -> np.ndarray:
    """Points (N, 2) along the outline of a small star on the plane, with the noise of pixels."""
    angle = np.linspace(0, 2 * np.pi, 11)
    radius = np.where(np.arange(11) % 2, 0.05, 0.12)
    corners = np.asarray(at) + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    k, s = rng.integers(0, 10, count), rng.random((count, 1))
    return corners[k] * (1 - s) + corners[k + 1] * s + rng.normal(0, 0.3 / 200, (count, 2))


def finder_before(points: np.ndarray) -> PoseFinder:
    """A finder whose map shows points (N, 2) of a plane one distance ahead of the world's origin."""
    free = np.ones(6, dtype=bool)
    mapper = Mapper(CAMERA, free, (CAMERA.width, CAMERA.height), solve_normal=True)
    mapper.begin(Plane(normal=np.array([0.0, 0.0, -1.0])))
    mapper.live_map.cover(np.array([-1.0, -0.8]), np.array([1.0, 0.8]))
    view = homography_map_camera(np.eye(4), mapper.plane)
    for part in np.array_split(points.astype(np.float32), 8):
        mapper.live_map.add(part, view, view, (CAMERA.height, CAMERA.width), CAMERA.matrix)
    motion = Motion.start(free)
    motion.status, motion.good_score = Status.TRACKING, 0.9
    return PoseFinder(
        camera=CAMERA, config=TrackerConfig(), free=free, mapper=mapper, motion=motion, failures=FailureWatch(),
        gyro=None,
    )  # fmt: skip


def test_lines_tell_what_brightness_hides() -> None:
    """Before two small stars turning and moving sideways look alike: lines leave less of the error."""
    rng = np.random.default_rng(4)
    places = ((0.1, 0.0), (-0.3, 0.2))
    planar_map = finder_before(np.concatenate([star(at, rng, 12_000) for at in places])).mapper.live_map
    errors = np.zeros((2, 60))
    for k in range(60):
        noise = rng.uniform((-0.6, -0.45), (0.6, 0.45), (150, 2))
        b = np.concatenate([*(star(at, rng, 750) for at in places), noise]).astype(np.float32)
        start = se3.pose(se3.exp_so3(rng.normal(0, 0.01, 3)), rng.normal(0, 0.01, 3))
        for to_lines in (False, True):
            found = align(
                planar_map,
                b[rng.permutation(len(b))],
                np.linspace(0, 1e-3, len(b)),
                start,
                np.zeros(3),
                np.zeros(3),
                focal_px=200.0,
                free=ALL,
                prior=np.diag([0.05**-2] * 6),
                first_level=1,
                to_lines=to_lines,
            )
            errors[int(to_lines), k] = np.linalg.norm(found.T_world_camera[:3, 3])
    assert np.sqrt((errors[1] ** 2).mean()) < 0.9 * np.sqrt((errors[0] ** 2).mean())


def test_a_pose_astray_along_what_was_not_seen_is_found_again() -> None:
    """Turned while one star alone was in view: the second star, beside its place, brings the pose back."""
    rng = np.random.default_rng(5)
    near, far = (0.2, 0.0), (-0.45, 0.2)
    finder = finder_before(np.concatenate([star(near, rng, 12_000), star(far, rng, 12_000)]))
    turn = se3.exp_so3([0.0, 0.3, 0.0])
    # The first star stays where it was in the image.
    ahead = np.array([*near, 1.0])
    astray = se3.pose(turn, ahead - turn @ ahead)
    b = np.concatenate([star(near, rng, 1000), star(far, rng, 1000)]).astype(np.float32)
    t_s = np.linspace(-5e-4, 5e-4, len(b))
    sampled, still = (b[rng.permutation(len(b))], t_s), np.zeros(3)
    stuck = finder._align(sampled, 0.0, astray, still, still, None)
    assert np.degrees(se3.rotation_angle(stuck.T_world_camera[:3, :3])) > 4.0
    found = finder._probe(sampled, 0.0, stuck, still, still)
    assert found is not None
    assert np.degrees(se3.rotation_angle(found.T_world_camera[:3, :3])) < 2.0
    # Where the fit is good there is nothing to look for.
    right = finder._align(sampled, 0.0, np.eye(4), still, still, None)
    finder.motion.good_score = finder._agreed(right)
    assert finder._probe(sampled, 0.0, right, still, still) is None


def test_the_way_back_is_not_looked_for_right_before_the_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few cells seen from close by fit whatever is laid on them."""
    plane = Plane(normal=np.array([0.0, 0.0, -1.0]))
    planar_map = PlanarMap(plane, 200.0, np.array([-0.6, -0.45]), (180, 240), freeze_px=np.inf)
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.5, -0.4), (0.5, 0.4), (3000, 2)).astype(np.float32)
    view = homography_map_camera(np.eye(4), plane)
    planar_map.add(points, view, view, (180, 240), CAMERA.matrix)

    def found_at(z: float) -> bool:
        T = se3.pose(np.eye(3), np.array([0.0, 0.0, z]))
        aligned = Alignment(
            T_world_camera=T, value=1.0, inside=1.0, information=np.eye(6), iterations=1, step_px=0.0
        )
        monkeypatch.setattr("dvsviz.tracking.relocalize.align", lambda *_, **__: aligned)
        keyframes = [np.eye(4), se3.pose(np.eye(3), np.array([0.1, 0.0, 0.2]))]
        return relocalize(planar_map, CAMERA, points, keyframes, free=ALL) is not None

    assert [found_at(z) for z in (-1.2, -0.8, 0.0, 0.5, 0.7, 0.975)] == [False, True, True, True, False, False]
