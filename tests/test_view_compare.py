"""A session laid into another one's world, with a known answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gateway_samples import WINDOW_US, create_session, first_updates, make_recording, make_session, result

from dvsviz.errors import DvsvizError
from dvsviz.geometry import se3
from dvsviz.session.records import Status
from dvsviz.session.store import open_session
from dvsviz.view.compare import beside_curves, figures, lay, settings_apart
from dvsviz.view.shown import ShownSession

WINDOWS = 50
R = se3.exp_so3([0.3, -0.2, 0.5])


def moved(path: Path, recording: Path, *, off: float = 0.0, later_us: int = 0) -> ShownSession:
    """The sample's session in another world, half as large; every second window `off` plane distances away."""
    with create_session(path, recording, WINDOWS) as writer:
        for k in range(WINDOWS):
            r = result(k)
            T = r.T_world_camera.copy()
            T[:3, 3] += [0.0, 0.0, off * (1 if k % 2 else -1)]
            T = se3.pose(R @ T[:3, :3], 0.5 * R @ T[:3, 3] + [1.0, 2.0, 3.0])
            writer.append(replace(r, T_world_camera=T, start_us=r.start_us + later_us, end_us=r.end_us + later_us))
            if k == 0:
                writer.add(first_updates())
        writer.close({})
    return ShownSession(open_session(path), None, "gone", name=path.stem)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp("compare") / "r.h5", WINDOWS)


@pytest.fixture(scope="module")
def base(recording: Path) -> ShownSession:
    return ShownSession(open_session(make_session(recording.parent / "base.h5", recording, WINDOWS)), None, "gone")


def test_another_world_is_taken_back(base: ShownSession, recording: Path) -> None:
    laid = lay(moved(recording.parent / "same.h5", recording), base)
    np.testing.assert_allclose(laid.Ts_world_camera, base.poses(), atol=1e-8)
    lost = (Status.LOST, Status.RELOCALIZING)
    assert laid.common == sum(result(k).status not in lost for k in range(WINDOWS))
    assert laid.rmse_percent < 1e-5
    assert laid.rmse_deg < 1e-4


def test_what_is_off_is_measured(base: ShownSession, recording: Path) -> None:
    other = moved(recording.parent / "off.h5", recording, off=0.01)
    laid = lay(other, base)
    # One per cent to and fro: the alignment can take away no more than a little of it.
    assert laid.rmse_percent == pytest.approx(1.0, rel=0.1)
    assert np.nanmedian(laid.apart_percent) == pytest.approx(1.0, rel=0.15)
    curves = beside_curves(other, base, 10)
    assert len(curves["x"]) == WINDOWS - 10
    np.testing.assert_allclose(curves["apart_percent"], laid.apart_percent[10:], rtol=1e-5)
    told = figures(other, base)
    assert told["apart_percent"] == laid.rmse_percent
    assert figures(base, base)["apart_percent"] is None


def test_sessions_of_other_times_are_refused(base: ShownSession, recording: Path) -> None:
    late = moved(recording.parent / "late.h5", recording, later_us=10 * WINDOWS * WINDOW_US)
    with pytest.raises(DvsvizError, match="no pose at the same time"):
        lay(late, base)


def test_settings_that_differ_are_told() -> None:
    told = settings_apart('{"a": 1, "b": {"c": 2, "d": 3}}', '{"a": 1, "b": {"c": 5}, "e": null}')
    assert told == {"b.c": [2, 5], "b.d": [3, None]}
