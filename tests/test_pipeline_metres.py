"""A recording with an accelerometer, tracked without any length: the run tells the metre, and exports by it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dvsviz.cli import main
from dvsviz.config import TrackerConfig
from dvsviz.errors import SessionError
from dvsviz.export.tum import export_tum
from dvsviz.formats.open import open_recording
from dvsviz.geometry.tum import read_tum
from dvsviz.pipeline import track
from dvsviz.session.store import open_session
from dvsviz.simulate.simulate import simulate


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("metres")
    simulate(folder / "wall.h5", motion="handheld", seconds=10.0, seed=4, distance=0.6)
    out = folder / "wall.session.h5"
    return out, track(open_recording(folder / "wall.h5"), TrackerConfig(), out)


def test_the_run_tells_how_long_a_unit_is(tracked: tuple[Path, dict[str, Any]]) -> None:
    session, summary = tracked
    scale = summary["metric_scale"]
    # A unit is the distance of the plane from the first camera.
    recording = open_recording(session.parent / "wall.h5")
    assert recording.ground_truth is not None
    assert recording.plane_normal_world is not None
    assert recording.plane_distance_world is not None
    first = recording.ground_truth.positions[0]
    true = recording.plane_distance_world + float(recording.plane_normal_world @ first)
    assert scale["metres_per_unit"] == pytest.approx(true, rel=max(0.02, 2 * scale["deviation"]))
    assert scale["deviation"] < 0.1
    assert scale["explained"] > 0.9


def test_a_trajectory_is_exported_in_metres(tracked: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    session, summary = tracked
    assert main(["export", str(session), "--to", str(tmp_path / "m.tum"), "--metres"]) == 0
    assert main(["export", str(session), "--to", str(tmp_path / "u.tum")]) == 0
    metres, units = read_tum(tmp_path / "m.tum"), read_tum(tmp_path / "u.tum")
    factor = summary["metric_scale"]["metres_per_unit"]
    np.testing.assert_allclose(metres.positions, factor * units.positions, atol=1e-6)
    np.testing.assert_allclose(metres.rotations, units.rotations, atol=1e-6)


def test_a_told_distance_is_the_scale(tracked: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    recording = open_recording(tracked[0].parent / "wall.h5")
    track(recording, TrackerConfig(plane_distance=0.5), tmp_path / "s.h5", end_s=1.0)
    with open_session(tmp_path / "s.h5") as session:
        export_tum(session, tmp_path / "m.tum", metres=True)
        np.testing.assert_allclose(
            read_tum(tmp_path / "m.tum").positions, 0.5 * session.trajectory().positions, atol=1e-6
        )


def test_metres_are_refused_where_nothing_tells_them(
    tracked: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = open_recording(tracked[0].parent / "wall.h5")
    out = tmp_path / "short.h5"
    summary = track(recording, TrackerConfig(), out, end_s=1.0)
    assert "are needed" in summary["metric_scale"]["unknown"]
    with pytest.raises(SessionError, match="scale is not known"), open_session(out) as session:
        export_tum(session, tmp_path / "x.tum", metres=True)
    assert not (tmp_path / "x.tum").exists()
    assert main(["export", str(out), "--to", str(tmp_path / "x.csv"), "--metres"]) == 2
    assert "--metres is for trajectories" in capsys.readouterr().err
