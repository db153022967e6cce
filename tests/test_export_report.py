"""Reports: the figures of the session, its failures with pictures and causes, and nothing of the machine."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import gateway_samples as samples
import numpy as np
import pytest

from dvsviz.cli import main
from dvsviz.errors import DvsvizError
from dvsviz.export.causes import EXPLANATIONS
from dvsviz.export.curves_svg import line, ticks
from dvsviz.export.paths_svg import map_svg
from dvsviz.export.report import report_html
from dvsviz.session.records import Cause, Failure, MapRevision, TrackerUpdates
from dvsviz.session.store import open_session
from dvsviz.view.shown import ShownSession

WINDOWS = 40
FAILURES = (
    Failure(cause=Cause.TOO_FAST, start=9, end=10, worst=9, message="faster than <b>the search</b> & more"),
    Failure(cause=Cause.LEFT_MAP, start=19, end=20, worst=19, message="left the map"),
)
STATIC = Path(__file__).resolve().parents[1] / "static"


class Tags(HTMLParser):
    """Opened and closed tags, and what attributes point to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in {"meta", "link", "img", "path", "rect", "image", "br"}:
            self.open.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "xlink:href") and value:
                self.addresses.append(value)

    def handle_endtag(self, tag: str) -> None:
        if tag in {"path", "rect", "image"}:
            return
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("secret-folder")
    recording = samples.make_recording(folder / "r.h5", WINDOWS)
    path = folder / "walk.h5"
    with samples.create_session(path, recording, WINDOWS) as writer:
        for k in range(WINDOWS):
            writer.append(samples.result(k))
            if k == 0:
                writer.add(samples.first_updates())
            writer.add(TrackerUpdates(failures=tuple(f for f in FAILURES if f.end == k)))
        writer.close({"real_time_factor": 1.25})
    return path


@pytest.fixture(scope="module")
def page(session: Path) -> str:
    out = session.with_name("walk.html")
    assert main(["report", str(session), "--out", str(out)]) == 0
    return out.read_text(encoding="utf-8")


def test_it_is_whole_and_points_only_into_itself(page: str) -> None:
    tags = Tags(page)
    assert tags.open == []
    assert all(a.startswith(("data:image/png;base64,", "#failure-")) for a in tags.addresses)
    assert "<script" not in page
    assert "secret-folder" not in page
    assert "http" not in page.replace("http-equiv", "")


def test_it_says_what_the_session_says(page: str) -> None:
    # 4 of 40 windows are lost, none is initializing; the truth is a known one.
    assert "90.0 % of the 40 windows were tracked. It was lost 4 times" in page
    assert "1.25×" in page
    for number, failure in enumerate(FAILURES, 1):
        assert f'id="failure-{number}"' in page
        assert EXPLANATIONS[failure.cause].todo in page
    assert "Faster than &lt;b&gt;the search&lt;/b&gt; &amp; more" in page
    assert page.count('class="is-lost"') == 4


def test_each_failure_has_its_three_pictures_and_the_raw_one_shows_its_events(page: str) -> None:
    assert page.count("<figure>") == 3 * len(FAILURES)
    for failure in FAILURES:
        found = re.search(rf'alt="Window {failure.worst}: raw[^"]*" src="data:image/png;base64,([^"]+)"', page)
        assert found is not None
        image = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert image.shape == (samples.CAMERA.height, samples.CAMERA.width)
        row, column = np.unravel_index(int(image.argmax()), image.shape)
        assert (column, row) == samples.pixel_of(failure.worst)


def test_json_says_where_it_is_and_a_file_is_not_replaced_unasked(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.html"
    argv = ["report", str(session), "--out", str(out), "--json"]
    assert main(argv) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {"report": str(out), "bytes": out.stat().st_size, "windows": WINDOWS, "failures": 2}
    assert main(argv) == 2
    assert "already exists; replace it with --force" in capsys.readouterr().err


def test_without_the_recording_it_is_made_without_pictures(session: Path) -> None:
    with open_session(session) as opened:
        text = report_html(ShownSession(opened, None, "it was in /a/secret/place"))
    assert "Without pictures" in text
    assert "secret" not in text.replace("walk", "")
    assert "<figure>" not in text
    assert "left the map" in text


def test_a_session_without_windows_has_no_report(tmp_path: Path) -> None:
    recording = samples.make_recording(tmp_path / "r.h5", 2)
    with samples.create_session(tmp_path / "s.h5", recording, 2) as writer:
        writer.close({})
    with open_session(tmp_path / "s.h5") as opened, pytest.raises(DvsvizError, match="has no windows"):
        report_html(ShownSession(opened, None))


def test_page_and_report_explain_the_causes_alike() -> None:
    text = (STATIC / "causes.js").read_text(encoding="utf-8")
    assert set(EXPLANATIONS) == set(Cause)
    for cause, explanation in EXPLANATIONS.items():
        block = text[text.index(f"  {cause}: {{") :].split("},")[0]
        for said in (explanation.name, explanation.means, explanation.told_from, explanation.todo):
            assert f'"{said}"' in block


def test_ticks_are_round_and_inside() -> None:
    assert ticks(0, 10, 5) == [0, 2, 4, 6, 8, 10]
    assert ticks(0.13, 0.52, 4) == [0.2, 0.3, 0.4, 0.5]
    assert ticks(3, 3, 4) == [3]


def test_a_thinned_line_keeps_every_peak_and_gap() -> None:
    x, y = np.arange(100_000.0), np.zeros(100_000)
    y[[777, 50_001]] = [9.0, -5.0]
    y[60_000:70_000] = np.nan
    path = line(x, y)
    assert "L777.0 9.0" in path
    assert "L50001.0 -5.0" in path
    assert path.count("M") == 2
    assert path.count("L") < 2500


def test_the_path_on_the_map_lies_where_the_camera_was() -> None:
    revision = MapRevision(
        revision=0,
        window=0,
        texture=np.zeros((50, 100), np.uint8),
        origin=np.array([-1.0, -0.5]),
        px_per_unit=50.0,
        normal_world=np.array([0.0, 0.0, -1.0]),
        distance=1.0,
    )
    positions = np.array([[-1.0, -0.5, 0.0], [0.0, 0.0, 0.3]])
    # Pixel (0, 0)'s centre, then 50 and 25 px farther: the picture is ten times as wide as the texture.
    assert 'd="M5.0 5.0L505.0 255.0"' in map_svg(revision, positions, np.array([1, 1], np.uint8), None)
