"""Scenes with depth: what is seen is what geometry says, light and depth, and events come from both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvsviz.formats.hdf5 import read_recording
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import write_tum
from dvsviz.simulate.flights import flight
from dvsviz.simulate.motion import slider
from dvsviz.simulate.relief import Patch, Relief, ReliefView, image_of
from dvsviz.simulate.render import PixelGrid, PlaneView
from dvsviz.simulate.rooms import RELIEFS, box, facing, make_relief, planes
from dvsviz.simulate.scenes import PAINTERS, blank
from dvsviz.simulate.simulate import simulate
from dvsviz.simulate.texture import make_texture

SMALL = Camera(width=90, height=60, fx=80.0, fy=80.0, cx=44.5, cy=29.5)
WIDE = Camera(width=90, height=60, fx=60.0, fy=62.0, cx=44.0, cy=31.0, distortion=(-0.3, 0.08, 1e-3, -1e-3, 0.0))
BOXES = 15 * 23


def relief_of(*patches: Patch) -> Relief:
    return Relief(patches=patches, T_world_hand=np.eye(4), gravity_world=np.array([0, 9.81, 0]), has_floor=False)


def grey(
    value: float, size: tuple[float, float], corner: tuple[float, float, float], turn=(0.0, 0.0, 0.0)
) -> Patch:
    """A patch of one intensity, turned about its corner."""
    texture = make_texture(blank((0, 0, *size), 0.01, value), texel=0.01, left=0.0, top=0.0)
    return Patch(T_world_patch=se3.pose(se3.exp_so3(turn), corner), width=size[0], height=size[1], texture=texture)


def slow_depth(scene: Relief, T_world_camera: np.ndarray, bearing: np.ndarray) -> float:
    """Depth along a bearing: all intersections with all planes, the nearest inside its rectangle."""
    origin, ray = T_world_camera[:3, 3], T_world_camera[:3, :3] @ np.array([*bearing, 1.0])
    found = []
    for patch in scene.patches:
        x, y, z = patch.T_world_patch[:3, :3].T
        corner = patch.T_world_patch[:3, 3]
        if ray @ z <= 0:
            continue
        s = (corner - origin) @ z / (ray @ z)
        p = origin + s * ray - corner
        if s > 0 and 0 <= p @ x < patch.width and 0 <= p @ y < patch.height:
            found.append(s)
    return min(found, default=np.nan)


@pytest.mark.parametrize("camera", [SMALL, WIDE])
def test_depth_is_that_of_all_intersections(camera: Camera) -> None:
    rng = np.random.default_rng(3)
    faces = box(rng, (0.2, -0.1), (0.5, 0.3, 0.4), 0.7, PAINTERS["checkerboard"], 0.02)
    floor = grey(0.5, (1.5, 1.2), (-0.7, 0.6, 0.0), (np.pi, 0.0, 0.0))
    scene = relief_of(*faces, floor)
    T = flight("circle")(np.array([9.0]))[0]
    depth = ReliefView(PixelGrid.of(camera), scene).depth(T)
    table = camera.bearing_table().astype(np.float64)
    slow = np.array([[slow_depth(scene, T, b) for b in row] for row in table])
    assert np.array_equal(np.isnan(depth), np.isnan(slow))
    assert 0.05 < np.isnan(depth).mean() < 0.9
    assert np.nanmax(np.abs(depth - slow)) < 1e-9
    # Some pixels see the top of the box: 0.4 m above the floor.
    height = (T[:3, :3] @ (np.dstack([table, np.ones((60, 90))]) * depth[..., None])[..., None])[..., 2, 0] + T[
        2, 3
    ]
    assert np.nanmax(height) == pytest.approx(0.4, abs=1e-9)
    assert np.nanmin(height) == pytest.approx(0.0, abs=1e-9)


def test_box_is_seen_from_outside_all_around() -> None:
    faces = box(np.random.default_rng(0), (0.0, 0.0), (0.4, 0.2, 0.3), 0.0, PAINTERS["stripes"], 0.02)
    view = ReliefView(PixelGrid.of(SMALL), relief_of(*faces))
    for ahead, wanted in (([-1.0, 0, 0], 0.8), ([1.0, 0, 0], 0.8), ([0, -1.0, 0], 0.9), ([0, 1.0, 0], 0.9)):
        R = facing(np.array(ahead), np.array([0, 0, 1.0]))
        T = se3.pose(R, [*ahead[:2], 0.15])
        assert view.depth(T, np.zeros((1, 2)))[0] == pytest.approx(wanted)
    down = se3.pose(facing(np.array([0, 0, 1.0]), np.array([1.0, 0, 0])), [0, 0, 1.0])
    assert view.depth(down, np.zeros((1, 2)))[0] == pytest.approx(0.7)


def test_single_patch_is_the_plane_view() -> None:
    texture = PAINTERS["checkerboard"](np.random.default_rng(0), (0.0, 0.0, 4.0, 3.0), 0.008)
    patch = Patch(T_world_patch=se3.pose(None, [-2.0, -1.5, 1.3]), width=4.0, height=3.0, texture=texture)
    image = image_of(ReliefView(PixelGrid.of(WIDE), relief_of(patch)), np.eye(4), WIDE)
    wanted = np.zeros_like(image)
    H = np.array([[1.3, 0, 2.0], [0, 1.3, 1.5], [0, 0, 1.0]])
    PlaneView(PixelGrid.of(WIDE), texture).render(H, wanted, np.ones(BOXES, bool))
    assert np.abs(image - wanted).max() < 1e-3
    assert wanted.std() > 0.1


def test_hiding_edge_is_where_it_projects() -> None:
    """A slanted edge before a wall: each row's dark area ends where the edge projects, to a tenth of a pixel."""
    far = grey(0.8, (8.0, 8.0), (-4.0, -4.0, 2.0))
    for shift in np.linspace(0, 0.02, 7):
        near = grey(0.2, (2.0, 4.0), (-2.0 + shift, -2.0, 1.0), (0.0, 0.0, 0.08))
        image = image_of(ReliefView(PixelGrid.of(SMALL), relief_of(far, near)), np.eye(4), SMALL)
        c, s = np.cos(0.08), np.sin(0.08)
        top = np.array([-2.0 + shift + 2 * c, -2.0 + 2 * s])
        errors = []
        for row in range(60):
            y = (row - SMALL.cy) / SMALL.fy
            x = top[0] - (y - top[1]) * s / c
            dark = (0.8 - image[row].astype(float)).sum() / 0.6
            errors.append(dark - 0.5 - (x * SMALL.fx + SMALL.cx))
        assert abs(np.mean(errors)) < 0.03
        assert np.abs(errors).max() < 0.2


def test_waiting_blocks_are_nearly_what_they_would_be() -> None:
    scene = planes(np.random.default_rng(1), 0.01)
    view, fresh = ReliefView(PixelGrid.of(SMALL), scene), ReliefView(PixelGrid.of(SMALL), scene)
    image, active = np.zeros((60, 90), np.float32), np.ones(BOXES, bool)
    share, off = [], []
    for k in range(30):
        T = se3.pose(None, [0.002 * k, 0.0, 0.0])
        view.render(T, image, active, still_px=0.3)
        share.append(active.mean())
        whole = image_of(fresh, T, SMALL)
        # A block that waits has moved by less than 0.3 px.
        off.append(np.abs(image - whole).mean() / (0.3 * np.abs(np.diff(whole, axis=1)).mean()))
    assert 0.1 < np.mean(share[1:]) < 0.9
    assert np.max(off) < 1.0


def test_near_surfaces_pass_faster(tmp_path: Path) -> None:
    """Parallax: under the same slide a bar at half the distance passes twice as fast."""
    bars = [grey(0.1, (0.05 * z, 0.6 * z), (-0.3, y * z, z)) for z, y in ((0.8, -0.3), (1.6, 0.05))]
    scene = relief_of(grey(0.8, (9.0, 9.0), (-4.5, -4.5, 3.0)), *bars)
    simulate(tmp_path / "a.h5", scene=scene, motion=slider(speed=0.2, start=-0.1), seconds=1.0, camera=SMALL)
    recording = read_recording(tmp_path / "a.h5")
    events = recording.events.read(0, recording.events.count)
    speeds = []
    for rows in ((10, 28), (38, 56)):
        # The leading (left) side of the bar darkens pixels from right to left.
        mine = ~events.is_positive & (events.y_px >= rows[0]) & (events.y_px < rows[1])
        t, x = events.t_us[mine] * 1e-6, events.x_px[mine].astype(float)
        slope = np.polyfit(t, x, 1)[0]
        keep = np.abs(x - np.polyval(np.polyfit(t, x, 1), t)) < 4
        speeds.append(np.polyfit(t[keep], x[keep], 1)[0] if keep.sum() > 20 else slope)
    assert speeds[0] == pytest.approx(-80 * 0.2 / 0.8, rel=0.1)
    assert speeds[1] == pytest.approx(-80 * 0.2 / 1.6, rel=0.1)


def test_flight_over_boxes_makes_a_recording(tmp_path: Path) -> None:
    simulate(tmp_path / "a.h5", scene="boxes", motion="circle", seconds=0.3, camera=SMALL, frames_hz=10.0)
    recording = read_recording(tmp_path / "a.h5")
    assert recording.events.count > 500
    assert recording.frames is not None and recording.imu is not None and recording.ground_truth is not None
    assert recording.mean_plane_distance is None
    # Gravity pulls along -z: 45 degrees between the optical axis and the floor's normal.
    mean = recording.imu.accel.mean(axis=0)
    assert mean == pytest.approx([0, -9.81 * np.sqrt(0.5), -9.81 * np.sqrt(0.5)], abs=0.6)


def test_tum_file_drives_the_camera(tmp_path: Path) -> None:
    t = np.arange(60) * 0.02
    p = np.stack([0.1 * np.sin(t), 0.05 * t, 0 * t], axis=1) + np.array([5.0, 6.0, 7.0])
    turn = se3.exp_so3(np.stack([0 * t, 0.1 * t, 0 * t], axis=1) + np.array([0.5, 2.0, 1.0]))
    known = Trajectory(t_us=(t * 1e6).astype(np.int64) + 10**9, Ts_world_camera=se3.pose(turn, p))
    write_tum(tmp_path / "real.tum", known)
    simulate(tmp_path / "a.h5", motion=tmp_path / "real.tum", seconds=0.2, camera=SMALL)
    truth = read_recording(tmp_path / "a.h5").ground_truth
    assert truth is not None
    at = known.at(truth.t_us + 10**9).Ts_world_camera
    assert np.allclose(truth.Ts_world_camera, se3.inverse(known.Ts_world_camera[0]) @ at, atol=1e-3)
    with pytest.raises(ValueError, match=r"1\.180 s"):
        simulate(tmp_path / "b.h5", motion=tmp_path / "real.tum", seconds=2.0, camera=SMALL)


def test_scenes_and_motions_that_do_not_go_together(tmp_path: Path) -> None:
    for scene in ("shapes", "planes"):
        with pytest.raises(ValueError, match="floor"):
            simulate(tmp_path / "a.h5", scene=scene, motion="circle", seconds=0.1, camera=SMALL)
    through = relief_of(grey(0.8, (2.0, 2.0), (-1.0, -1.0, 0.05)))
    with pytest.raises(ValueError, match="surface"):
        simulate(tmp_path / "a.h5", scene=through, motion="handheld", seconds=0.1, camera=SMALL)
    with pytest.raises(ValueError, match=", ".join(RELIEFS)):
        make_relief("cave", np.random.default_rng(0))
    assert list(tmp_path.iterdir()) == []
