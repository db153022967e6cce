"""Errors, pose graphs, frame readers, tables, and the whole study on real frames."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dvsviz.errors import FormatError
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.registration.errors import absolute_errors, pose_errors, relative_errors
from dvsviz.registration.features import Features, depth_at, match
from dvsviz.registration.frames import Frame, nearest, open_frames
from dvsviz.registration.pose_graph import Edge, _jacobians, _residuals, optimise
from dvsviz.registration.rig import edge_agreement, kinect
from dvsviz.registration.study import study
from dvsviz.registration.tables import format_table


def ring(count: int) -> np.ndarray:
    angle = np.arange(count) * 2 * np.pi / count
    return se3.pose(
        se3.exp_so3(np.outer(angle, [0, 0, 1.0])), np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    )


def test_rotation_error_is_wrapped_not_divided() -> None:
    """A turn of 350 degrees is one of 10: 0.1745 rad, whichever way it is written."""
    true = se3.pose()[None]
    got = pose_errors(se3.pose(se3.exp_so3([0, 0, np.deg2rad(350)]), [3.0, 4.0, 0.0])[None], true)
    assert got.rotation_rad[0] == pytest.approx(np.deg2rad(10))
    assert got.translation_m[0] == pytest.approx(5)


def test_relative_error_forgets_and_absolute_error_adds_up() -> None:
    true = ring(8)
    step = se3.pose(se3.exp_so3([0, 0, 0.1]))
    wrong = true.copy()
    wrong[4:] = true[4] @ step @ se3.inverse(true[4]) @ true[4:]
    relative, absolute = relative_errors(wrong, true), absolute_errors(wrong, true)
    np.testing.assert_allclose(relative.rotation_rad, [0, 0, 0, 0.1, 0, 0, 0], atol=1e-7)
    np.testing.assert_allclose(absolute.rotation_rad, [0, 0, 0, 0.1, 0.1, 0.1, 0.1], atol=1e-7)
    moved = se3.pose(se3.exp_so3([1.0, 0.5, 0]), [5.0, 6.0, 7.0]) @ true
    np.testing.assert_allclose(absolute_errors(moved, true).translation_m, 0, atol=1e-12)
    assert relative.summary()["rotation_rad"] == pytest.approx(0.1 / 7, abs=1e-8)


def test_pose_graph_jacobian_against_central_differences() -> None:
    Ts = ring(5) @ se3.pose(se3.exp_so3([0.2, 0.1, 0.4]), [0.1, 0.2, 0.3])
    i, j = np.array([0, 2]), np.array([3, 1])
    measured = se3.inverse(Ts[i]) @ Ts[j] @ se3.pose(se3.exp_so3([0.3, -0.2, 0.5]), [0.1, 0.0, 0.2])
    Ji, Jj = _jacobians(Ts, i, j, measured)
    h = 1e-6
    for e in range(2):
        for J, node in ((Ji, i[e]), (Jj, j[e])):
            for k, d in enumerate(np.eye(6) * h):
                sides = []
                for s in (1.0, -1.0):
                    moved = Ts.copy()
                    moved[node, :3, :3] = Ts[node, :3, :3] @ se3.exp_so3(s * d[:3])
                    moved[node, :3, 3] += s * d[3:]
                    sides.append(_residuals(moved, i, j, measured)[e])
                np.testing.assert_allclose(J[e, :, k], (sides[0] - sides[1]) / (2 * h), atol=1e-7)


def test_pose_graph_closes_a_drifting_ring_and_ignores_a_wrong_loop() -> None:
    true = ring(20)
    rng = np.random.default_rng(2)
    edges, chain = [], [true[0]]
    for k in range(19):
        noise = se3.pose(se3.exp_so3(rng.normal(size=3) * 0.02 + [0, 0, 0.02]), rng.normal(size=3) * 0.01)
        step = se3.inverse(true[k]) @ true[k + 1] @ noise
        chain.append(chain[-1] @ step)
        edges.append(Edge(i=k, j=k + 1, T_i_j=step, rotation_sigma=0.03, translation_sigma=0.01))
    for a, b in ((0, 19), (1, 18), (3, 15)):
        edges.append(
            Edge(i=a, j=b, T_i_j=se3.inverse(true[a]) @ true[b], rotation_sigma=0.005, translation_sigma=0.005)
        )
    drifted = np.array(chain)
    closed = optimise(drifted, edges)
    before, after = pose_errors(drifted, true), pose_errors(closed, true)
    assert after.translation_m.mean() < 0.35 * before.translation_m.mean()
    np.testing.assert_array_equal(closed[0], drifted[0])
    wrong = Edge(i=2, j=10, T_i_j=se3.pose(position=[3.0, 0, 0]), rotation_sigma=0.01, translation_sigma=0.01)
    robust = pose_errors(optimise(drifted, [*edges, wrong]), true)
    assert robust.translation_m.mean() < 2 * after.translation_m.mean()
    with pytest.raises(ValueError, match="connected"):
        optimise(true, edges[:5])


def test_matching_compares_floats_by_distance() -> None:
    """Rounding descriptors to bytes and counting bits, as the source did, pairs other features."""
    rng = np.random.default_rng(3)
    kept = rng.gamma(0.5, 30.0, (50, 128)).astype(np.float32)
    order = rng.permutation(50)
    noisy = kept[order] + rng.normal(size=(50, 128)).astype(np.float32) * 4
    none = np.zeros((50, 2))
    a, b = (Features(kind="sift", pixels=none, bearings=none, descriptors=d) for d in (kept, noisy))
    pairs = match(a, b)
    assert len(pairs) == 50
    np.testing.assert_array_equal(order[pairs[:, 1]], pairs[:, 0])
    twins = Features(kind="sift", pixels=none, bearings=none, descriptors=np.repeat(kept[:25], 2, axis=0))
    assert len(match(a, twins)) == 0


def test_orb_matching_is_the_hamming_distance() -> None:
    rng = np.random.default_rng(4)
    x, y = rng.integers(0, 256, (30, 32), dtype=np.uint8), rng.integers(0, 256, (40, 32), dtype=np.uint8)
    y[:30] = x ^ (rng.random((30, 32)) < 0.1).astype(np.uint8)
    a = Features(kind="orb", pixels=np.zeros((30, 2)), bearings=np.zeros((30, 2)), descriptors=x)
    b = Features(kind="orb", pixels=np.zeros((40, 2)), bearings=np.zeros((40, 2)), descriptors=y)
    np.testing.assert_array_equal(match(a, b), np.column_stack([np.arange(30)] * 2))


def test_depth_at_a_step_is_unknown_and_rows_are_rows() -> None:
    depth = np.full((6, 10), 2.0, np.float32)
    depth[:, 5:] = 3.0
    depth[4, 1] = np.nan
    frame = Frame(index=0, t_us=0, grey=np.zeros((6, 10), np.uint8), depth=depth)
    got = depth_at(frame, np.array([[1.2, 4.0], [4.0, 2.0], [8.0, 1.0]]))
    np.testing.assert_array_equal(got, [2.0, np.nan, 3.0])


def write_folder(folder: Path, *, scale: float = 1000.0, kind: type = np.uint16) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(3):
        stem = folder / f"frame-{k + 7:06d}"
        cv2.imwrite(f"{stem}.color.png", np.full((6, 8, 3), 50 * k, np.uint8))
        depth = np.full((6, 8), 2 * scale, np.float64)
        depth[0, :3] = 0, 65535 if kind is np.uint16 else 0, scale
        cv2.imwrite(f"{stem}.depth.png", np.minimum(depth, 65535).astype(kind))
        T = np.eye(4) if k else np.full((4, 4), -np.inf)
        np.savetxt(f"{stem}.pose.txt", T)
    np.savetxt(folder / "camera-intrinsics.txt", [[10, 0, 4], [0, 11, 3], [0, 0, 1]])


def test_numbered_folder(tmp_path: Path) -> None:
    write_folder(tmp_path / "room" / "frames")
    frames = open_frames(tmp_path / "room")
    assert (frames.camera.fx, frames.camera.fy, frames.camera.cx, frames.camera.height) == (10, 11, 4, 6)
    np.testing.assert_array_equal(frames.t_us, [233333, 266667, 300000])
    assert frames.ground_truth is not None
    assert len(frames.ground_truth) == 2
    frame = frames.read(1)
    assert frame.grey.shape == (6, 8)
    assert frame.depth is not None
    np.testing.assert_array_equal(frame.depth[0, :4], [np.nan, np.nan, 1.0, 2.0])


def test_eight_bit_depth_is_refused(tmp_path: Path) -> None:
    write_folder(tmp_path, kind=np.uint8, scale=100.0)
    with pytest.raises(FormatError, match="16 bits"):
        open_frames(tmp_path).read(0)


def test_tum_folder_joins_by_nearest_time(tmp_path: Path) -> None:
    write_folder(tmp_path, scale=5000.0)
    names = [f"frame-{k:06d}" for k in (7, 8, 9)]
    base = 1_305_031_453
    lines = [f"{base}.{100_000 + 33_000 * k:06d} {n}" for k, n in enumerate(names)]
    (tmp_path / "tum").mkdir()
    head = "# colour images\n"
    (tmp_path / "tum" / "rgb.txt").write_text(
        head + "".join(f"{x.split()[0]} ../{x.split()[1]}.color.png\n" for x in lines)
    )
    depth = f"{base}.110000 ../frame-000007.depth.png\n{base}.190000 ../frame-000009.depth.png\n"
    (tmp_path / "tum" / "depth.txt").write_text(depth)
    frames = open_frames(tmp_path / "tum")
    assert frames.t_us[0] == base * 1_000_000 + 100_000
    assert [p is not None for p in frames.depth_paths] == [True, False, False]
    depth_image = frames.read(0).depth
    assert depth_image is not None
    assert depth_image[3, 3] == 2.0
    np.testing.assert_array_equal(nearest(np.array([0, 5, 6, 100]), np.array([1, 10])), [0, 0, 1, 1])
    (tmp_path / "tum" / "rgb.txt").write_text("0.1 a.png\n0.2\n")
    with pytest.raises(FormatError, match=r"rgb.txt, line 2: expected a time and a file name"):
        open_frames(tmp_path / "tum")


def test_folders_that_are_no_frames(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="neither"):
        open_frames(tmp_path)
    with pytest.raises(FormatError, match="expected a folder"):
        open_frames(tmp_path / "nothing")
    write_folder(tmp_path)
    (tmp_path / "camera-intrinsics.txt").unlink()
    with pytest.raises(FormatError, match="no calibration"):
        open_frames(tmp_path)


def test_depth_moves_to_where_the_colour_camera_sees_it() -> None:
    depth_camera = Camera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0)
    rig = kinect(depth_camera)
    depth = np.full((480, 640), 2.5, np.float32)
    depth[200:280, 300:400] = 1.25
    seen = rig.depth_in_colour(depth)
    # A point at (300, 200) px and 1.25 m of the depth camera, by hand.
    x = ((300 - 320) / 585 * 1.25 - 0.025) / 1.25 * 525 + 319.5
    y = (200 - 240) / 585 * 525 + 239.5
    near = np.argwhere(seen < 2)
    np.testing.assert_allclose(near.min(axis=0), [y, x], atol=1.5)
    rng = np.random.default_rng(0)
    grey = np.where(seen < 2, 40, 180).astype(np.uint8) + rng.integers(0, 5, seen.shape, dtype=np.uint8)
    assert edge_agreement(grey, seen) > 2 * edge_agreement(grey, depth)


@pytest.fixture(scope="module")
def real_runs(data_dir: Path) -> dict[str, Any]:
    frames = open_frames(data_dir / "rgbd")
    assert frames.warnings
    runs: Any = study(frames, ("none", "pnp-iterative", "pnp-icp", "kabsch-weighted"), (5,))
    return {run.row.method: run.row for run in runs} | {"runs": runs}


@pytest.mark.data
def test_real_frames(real_runs: dict) -> None:
    names = ("none", "pnp-iterative", "pnp-icp", "kabsch-weighted")
    none, pnp, icp, kabsch = (real_runs[name] for name in names)
    assert none.relative_translation_m == pytest.approx(0.0232, abs=5e-4)
    assert np.rad2deg(none.relative_rotation_rad) == pytest.approx(3.34, abs=0.05)
    assert pnp.failures == kabsch.failures == 0
    # docs/registration.md says what holds the translation of PnP above a quarter.
    assert pnp.relative_rotation_rad < none.relative_rotation_rad / 7
    assert pnp.relative_translation_m < 0.6 * none.relative_translation_m
    # 0.9 degrees of one step were a lost depth image: see `association`.
    assert icp.relative_rotation_rad < none.relative_rotation_rad / 16
    assert icp.relative_translation_m < 0.28 * none.relative_translation_m
    assert kabsch.relative_rotation_rad < none.relative_rotation_rad / 11
    assert kabsch.relative_translation_m < 0.3 * none.relative_translation_m


@pytest.mark.data
def test_tables_hold_the_same_numbers(real_runs: dict) -> None:
    rows = [run.row for run in real_runs["runs"]]
    loaded = json.loads(format_table(rows, "json"))
    assert [row["method"] for row in loaded] == ["none", "pnp-iterative", "pnp-icp", "kabsch-weighted"]
    assert loaded[1]["relative_rotation_rad"] == rows[1].relative_rotation_rad
    again = list(csv.DictReader(format_table(rows, "csv").splitlines()))
    assert float(again[1]["relative_translation_m"]) == rows[1].relative_translation_m
    text = format_table(rows).splitlines()
    assert len(text) == 6
    assert f"{rows[1].relative_translation_m:.4f} ± " in text[3]
    latex = format_table(rows, "latex")
    assert latex.count(r"\\") == 5
    assert r"$\pm$" in latex
