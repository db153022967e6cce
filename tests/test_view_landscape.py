"""Landscapes of a stored window: units, marks, and the latest wish that wins."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gateway_samples import make_recording, make_session

from dvsviz.errors import DvsvizError
from dvsviz.formats.open import open_recording
from dvsviz.session.store import open_session
from dvsviz.view.landscape import CELLS, LandscapeWish, LandscapeWorker, Objective, landscape
from dvsviz.view.shown import ShownSession


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> ShownSession:
    folder: Path = tmp_path_factory.mktemp("landscape")
    recording = make_recording(folder / "r.h5", 40)
    return ShownSession(open_session(make_session(folder / "s.h5", recording, 40)), open_recording(recording))


def wish(shown: ShownSession, window: int = 20, request: int = 1, **changes: Any) -> LandscapeWish:
    plain = LandscapeWish(
        shown=shown, window=window, request=request, objective=Objective.VARIANCE, axes=(1, 3), zoom=1.0
    )
    return replace(plain, **changes)


@pytest.mark.parametrize("objective", list(Objective))
def test_axes_have_units_and_the_estimate_stands_in_the_middle(shown: ShownSession, objective: Objective) -> None:
    answer = landscape(wish(shown, objective=objective), 9)
    assert answer is not None
    json.dumps(answer, allow_nan=False)
    assert np.shape(answer["values"]) == (9, 9)
    units = [axis["unit"] for axis in answer["axes"]]
    assert units == (["°", "d"] if objective is Objective.MAP else ["°/s", "d/s"])
    assert [axis["name"] for axis in answer["axes"]] == ["rotation about y", "motion along x"]
    for k, axis in enumerate(answer["axes"]):
        assert answer["estimate"][k] == pytest.approx((axis["from"] + axis["to"]) / 2)
        assert axis["from"] < answer["prior"][k] < axis["to"]
    assert answer["values"][4][4] == pytest.approx(answer["at_estimate"], rel=1e-4)
    assert answer["at_best"] >= answer["at_estimate"]
    if objective is not Objective.MAP:
        r = shown.result(20)
        assert answer["estimate"] == pytest.approx([np.degrees(r.omega[1]), r.velocity[0]])
        assert answer["truth"] is not None


def test_a_wider_slice_is_wider(shown: ShownSession) -> None:
    usual, wide = (landscape(wish(shown, zoom=zoom), 5) for zoom in (1.0, 3.0))
    assert usual is not None
    assert wide is not None
    widths = [[axis["to"] - axis["from"] for axis in answer["axes"]] for answer in (usual, wide)]
    np.testing.assert_allclose(widths[1], 3 * np.array(widths[0]))


def test_without_events_it_is_said(shown: ShownSession) -> None:
    with pytest.raises(DvsvizError, match="the recording is gone"):
        landscape(wish(ShownSession(shown.session, None, "the recording is gone")), 5)


def test_the_latest_wish_is_answered_coarse_then_fine(shown: ShownSession) -> None:
    answers: list[dict[str, Any]] = []
    final = threading.Event()

    def tell(answer: dict[str, Any]) -> None:
        answers.append(answer)
        if answer.get("final") and answer["request"] == 9:
            final.set()

    worker = LandscapeWorker("test", tell)
    for request in range(1, 10):
        worker.want(wish(shown, window=10 + request, request=request))
    worker.start()
    assert final.wait(30)
    assert [(answer["request"], answer["cells"]) for answer in answers] == [(9, CELLS[0]), (9, CELLS[1])]
    worker.mailbox.close()
    worker.join(5)
    assert not worker.is_alive()


def test_a_playhead_that_moves_on_ends_it(shown: ShownSession) -> None:
    answers: list[dict[str, Any]] = []
    begun, done = threading.Event(), threading.Event()

    def tell(answer: dict[str, Any]) -> None:
        answers.append(answer)
        if answer["request"] == 2:
            return done.set()
        worker.moved(shown, 20)  # the same window: goes on
        worker.moved(shown, 21)
        begun.set()
        return None

    worker = LandscapeWorker("test", tell)
    worker.start()
    worker.want(wish(shown))
    assert begun.wait(30)
    worker.want(wish(shown, window=21, request=2))
    assert done.wait(30)
    assert [(answer["request"], answer["cells"]) for answer in answers[:2]] == [(1, CELLS[0]), (2, CELLS[0])]
    worker.mailbox.close()
    worker.join(5)
