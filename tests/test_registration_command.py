"""The command, its files, the session and the rerun recording of a registration, on simulated frames."""

from __future__ import annotations

import csv
import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvsviz.cli import main
from dvsviz.evaluate.chart import Chart, Line, to_png, to_svg
from dvsviz.export.registration import export_registration
from dvsviz.export.rrd_file import count_rows
from dvsviz.geometry import se3
from dvsviz.registration.dense import surface_of
from dvsviz.registration.epipolar import refine_essential, sampson_px
from dvsviz.registration.features import detect
from dvsviz.registration.frames import Frame, open_frames
from dvsviz.registration.methods import register
from dvsviz.registration.odometry import FeatureTable
from dvsviz.registration.records import MatchedPoints, RegistrationConfig
from dvsviz.session.edits import add_bookmark
from dvsviz.session.registration import RegistrationRecord, read_registration
from dvsviz.session.store import open_session
from dvsviz.simulate.motion import free_motion
from dvsviz.simulate.rgbd import PERFECT, rgbd_camera, simulate_rgbd
from dvsviz.simulate.rooms import planes
from dvsviz.view.captions import captions
from dvsviz.view.images import ImageKind
from dvsviz.view.registration import registration_picture
from dvsviz.view.registration_colours import INLIER_RGB, OUTLIER_RGB

METHODS = "none,kabsch-weighted,pnp-iterative,pnp-icp"


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames of a camera that moves and turns before four walls; not square."""
    # Texels of 6 mm: painting the walls is what costs.
    scene = planes(np.random.default_rng(5), texel=0.006)
    out = tmp_path_factory.mktemp("frames") / "walls"
    camera = replace(rgbd_camera(), width=320, height=200, fx=262.5, fy=262.5, cx=159.5, cy=99.5)

    def turn(t: np.ndarray) -> np.ndarray:
        return np.outer(t, [0.02, 0.1, 0.03])

    motion = free_motion(lambda t: np.outer(t, [0.1, -0.02, 0.05]), turn)
    simulate_rgbd(out, scene=scene, motion=motion, seconds=1.0, rate_hz=5, camera=camera, model=PERFECT)
    return out


@pytest.fixture(scope="module")
def session(frames: Path) -> Path:
    out = frames.parent / "walls.h5"
    assert main(["register", str(frames), "--methods", METHODS, "--out", str(out), "--json"]) == 0
    return out


@pytest.fixture(scope="module")
def record(session: Path) -> RegistrationRecord:
    found = read_registration(session)
    assert found is not None
    return found


def test_command_prints_one_object_and_writes_all_files(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, tex, plots = tmp_path / "t.csv", tmp_path / "t.tex", tmp_path / "plots"
    words = ["register", str(frames), "--methods", METHODS, "--skips", "1,2", "--keyframes", "--json"]
    assert main([*words, "--csv", str(table), "--latex", str(tex), "--plots", str(plots)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["frames"] == 6
    rows = {(r["method"], r["skip"], r["mode"]): r for r in told["rows"]}
    # "none" has no keyframes.
    assert len(rows) == 2 * (1 + 2 * 3)
    for method in ("kabsch-weighted", "pnp-iterative", "pnp-icp"):
        row = rows[method, 2, "frames"]
        assert row["failures"] == 0
        assert row["relative_translation_m"] < 0.1 * rows["none", 2, "frames"]["relative_translation_m"]
    assert len(list(csv.DictReader(table.read_text().splitlines()))) == len(told["rows"])
    assert tex.read_text().count(r"\\") == len(told["rows"]) + 1
    names = {path.name for path in plots.iterdir()}
    assert {"errors-skip-1.svg", "errors-skip-2.png", "trajectories-skip-1.png", "skips.svg"} <= names
    for path in plots.glob("*.svg"):
        ElementTree.parse(path)
    for path in plots.glob("*.png"):
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None and image.shape[1] == 1600 and image.std() > 5


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere"], "no such file or folder"),
        (["FRAMES", "--methods", "magic"], "unknown method magic"),
        (["FRAMES", "--skips", "0"], "expected whole numbers"),
        (["FRAMES", "--skips", "50"], "smaller --skips"),
        (["FRAMES", "--rerun", "x.txt"], "name x.rrd"),
    ],
)
def test_errors_are_one_line_with_a_hint(
    frames: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["register", *(str(frames) if word == "FRAMES" else word for word in words)]) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1


def test_session_is_one_of_windows_with_truth(session: Path, record: RegistrationRecord) -> None:
    with open_session(session) as opened:
        assert opened.complete and opened.window_count == 6
        assert opened.ground_truth is not None
        np.testing.assert_allclose(opened.Ts_world_camera(), record.shown_run.Ts_world_camera)
        share = opened.column("overlap")
    step = record.steps[0]
    assert share[1] == pytest.approx(step.is_inlier.mean())
    assert {run.name for run in record.runs} == set(METHODS.split(","))
    best = min((r for r in record.runs if r.name != "none"), key=lambda r: r.errors[:, 3].mean())
    assert record.shown_run.name == best.name
    # Points that are kept are where the true geometry has them: before the camera, on their pixels.
    seen = record.camera.project(step.points[:, :2] / step.points[:, 2:])
    gap = np.linalg.norm(seen[:, None] - step.pixels_b[step.is_inlier][None], axis=-1).min(axis=1)
    assert len(seen) > 20 and gap.max() < 0.01


def test_bookmarks_keep_the_registration(session: Path, record: RegistrationRecord, tmp_path: Path) -> None:
    copy = tmp_path / "copy.h5"
    copy.write_bytes(session.read_bytes())
    add_bookmark(copy, 2, "look here")
    again = read_registration(copy)
    assert again is not None and len(again.steps) == len(record.steps)


def test_export_reads_back_whole(record: RegistrationRecord, tmp_path: Path) -> None:
    out = tmp_path / "walls.rrd"
    export_registration(record, out)
    rows = count_rows(out)
    assert rows["world/camera"] == rows["world/camera/image"] == rows["world/camera/depth"] == 6
    assert rows["world/points"] == rows["world/camera/inliers"] == rows["world/camera/outliers"] == 5
    assert rows["plots/absolute_translation/pnp_icp"] == 5
    assert not list(tmp_path.glob(".*partial*"))


def test_pictures_show_matches_in_two_colours(record: RegistrationRecord) -> None:
    step = record.steps[1]
    half = np.arange(len(step.is_inlier)) % 2 == 0
    mixed = replace(record, steps=(record.steps[0], replace(step, is_inlier=half), *record.steps[2:]))
    picture = registration_picture(mixed, 2, ImageKind.WARPED)
    assert picture is not None and picture.rgb().shape == (200, 320, 3)
    for mask, rgb in ((half, INLIER_RGB), (~half, OUTLIER_RGB)):
        there = [picture.rgb()[round(float(y)), round(float(x))] for x, y in step.pixels_b[mask]]
        assert np.mean([tuple(pixel) == rgb for pixel in there]) > 0.7
    assert captions(mixed, 2)["captions"]["warped"]["note"] == f"{half.sum()} of {len(half)} agree"
    pair = registration_picture(record, 2, ImageKind.RAW)
    depth = registration_picture(record, 2, ImageKind.MAP)
    errors = registration_picture(record, 2, ImageKind.TEXTURE)
    assert pair is not None and pair.width == 2 * 320 + 4
    assert depth is not None and (depth.pixels > 0).mean() > 0.9
    assert errors is not None and len(np.unique(errors.pixels)) > 10


def test_blocks_of_a_slanted_wall_have_its_normal(frames: Path) -> None:
    sequence = open_frames(frames)
    camera = sequence.camera
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    rays = np.concatenate([camera.bearing_table(), np.ones((200, 320, 1))], axis=-1)
    depth = (-1.5 / (rays @ normal)).astype(np.float32)
    surface = surface_of(Frame(index=0, t_us=0, grey=np.zeros((200, 320), np.uint8), depth=depth), camera)
    assert surface is not None and surface.points.shape == (50, 80, 3)
    known = np.isfinite(surface.normals[..., 0])
    assert known.mean() > 0.8
    np.testing.assert_allclose(surface.normals[known] @ normal, 1.0, atol=1e-4)
    np.testing.assert_allclose(surface.points[known] @ normal, -1.5, atol=2e-3)


def test_dense_alignment_beats_matches_with_noisy_pixels(frames: Path) -> None:
    """Matches that a wrong calibration moves by pixels do not turn a motion that the surfaces know."""
    sequence = open_frames(frames)
    table = FeatureTable(sequence)
    T_true = sequence.ground_truth.at(sequence.t_us[[0, 2]]).Ts_world_camera  # pyright: ignore[reportOptionalMemberAccess]
    T_a_b = se3.inverse(T_true[0]) @ T_true[1]
    matched, _, _ = table.matched(0, 2)
    wrong = replace(matched, bearings_b=matched.bearings_b + np.array([0.01, 0.0]), image_sigma_px=2.0)

    def turn_error(method: str, points: MatchedPoints) -> float:
        found = register(points, method, RegistrationConfig())
        assert found.is_found
        return float(se3.rotation_angle(T_a_b[:3, :3].T @ found.T_a_b[:3, :3]))

    dense = replace(wrong, surface_a=table.surface(0)[0], surface_b=table.surface(2)[0])
    assert turn_error("pnp-icp", dense) < 0.5 * turn_error("pnp-iterative", wrong)


def test_essential_of_all_inliers_beats_five_points() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (200, 3))
    T_b_a = se3.pose(se3.exp_so3([0.02, 0.1, -0.03]), np.array([0.6, 0.0, 0.8]))
    moved = points @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    clean = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    noise = rng.normal(0, 0.5 / 500, (200, 2))
    nothing = np.full(200, np.nan)
    matched = MatchedPoints(
        bearings_a=clean[0], bearings_b=clean[1] + noise, depth_a=nothing, depth_b=nothing, focal_px=500.0
    )
    start = se3.pose(se3.exp_so3([0.0, 0.02, 0.0]) @ T_b_a[:3, :3], np.array([0.7, 0.1, 0.7]) / np.sqrt(0.99))
    found = refine_essential(start, matched, 1.0)
    assert se3.rotation_angle(found[:3, :3].T @ T_b_a[:3, :3]) < 0.003
    assert found[:3, 3] @ T_b_a[:3, 3] > np.cos(0.03)
    rays = [np.column_stack([c, np.ones(200)]) for c in clean]
    np.testing.assert_allclose(sampson_px(T_b_a, rays[0], rays[1], 500.0), 0, atol=1e-10)


def test_fast_features_lie_where_the_others_do(frames: Path) -> None:
    sequence = open_frames(frames)
    image = sequence.read(0)
    slow, fast = (detect(image, sequence.camera, kind=kind) for kind in ("sift", "sift-fast"))
    assert 0.2 * len(slow) < len(fast) < len(slow)
    gap = slow.pixels[None] - fast.pixels[:, None]
    nearest = gap[np.arange(len(fast)), np.linalg.norm(gap, axis=-1).argmin(axis=1)]
    close = np.linalg.norm(nearest, axis=1) < 1.0
    assert close.mean() > 0.6
    # Half a pixel of shift would be seen at once.
    assert np.abs(nearest[close].mean(axis=0)).max() < 0.1


def test_chart_breaks_lines_where_nothing_is_known() -> None:
    line = Line(name="a<b", x=np.arange(6.0), y=np.array([1, 2, np.nan, 4, 5, 6.0]), rgb=(1, 2, 3))
    chart = Chart(title="t & t", x_label="x (s)", y_label="y (m)", lines=(line,))
    tree = ElementTree.fromstring(to_svg([chart, chart]))
    curves = [
        e for e in tree.iter() if e.get("stroke") == "rgb(1,2,3)" and len((e.get("points") or "").split()) > 1
    ]
    # Twice: two pieces and the legend.
    assert len(curves) == 6
    assert "t & t" in [e.text for e in tree.iter()]
    image = cv2.imdecode(np.frombuffer(to_png([chart]), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None and image.shape == (600, 1600, 3)
