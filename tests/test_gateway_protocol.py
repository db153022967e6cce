"""The page's side of `docs/dashboard-protocol.md`, spoken to the real server."""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from gateway_samples import (
    PER_WINDOW,
    TAB,
    base_and_token,
    cookie_of,
    create_session,
    first_updates,
    logged_in,
    make_recording,
    make_session,
    pixel_of,
    result,
    running,
    unpack,
)
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from dvsviz.gateway.app import Dashboard
from dvsviz.view.playback import Renderer

WINDOWS = 120


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("protocol")
    recording = make_recording(folder / "r.h5", WINDOWS)
    (folder / "sessions").mkdir()
    make_session(folder / "sessions" / "first.h5", recording, WINDOWS)
    gone = make_recording(folder / "gone.h5", WINDOWS)
    make_session(folder / "sessions" / "orphan.h5", gone, WINDOWS)
    gone.unlink()
    return folder


@pytest.fixture(scope="module")
def dashboard(folder: Path) -> Iterator[Dashboard]:
    with running((), folder / "sessions") as dashboard:
        yield dashboard


class Page:
    """A tab without a browser."""

    def __init__(self, dashboard: Dashboard, tab: str = TAB) -> None:
        base, _ = base_and_token(dashboard.address)
        self.http = logged_in(dashboard.address)
        self.socket: ClientConnection = connect(
            f"{base.replace('http', 'ws')}/ws?tab={tab}",
            origin=base,  # type: ignore[arg-type]
            additional_headers={"Cookie": cookie_of(self.http)},
            proxy=None,
            max_size=None,
        )

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()
        self.http.close()

    def send(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def seek(
        self, session: str, window: int, request: int = 1, kinds: tuple[str, ...] = ("raw",), **options: Any
    ) -> None:
        self.send(type="seek", session=session, window=window, request=request, kinds=kinds, options=options)

    def next(self, kind: str, timeout: float = 20) -> Any:
        """The next message of a type; images come as (header, list of PNG bytes)."""
        end = time.monotonic() + timeout
        while True:
            message = self.socket.recv(timeout=end - time.monotonic())
            if isinstance(message, bytes):
                if kind == "images":
                    return unpack(message)
            elif (found := json.loads(message))["type"] == kind:
                return found


@pytest.fixture
def page(dashboard: Dashboard) -> Iterator[Page]:
    with Page(dashboard) as page:
        yield page


def brightest_pixel(png: bytes) -> tuple[int, int]:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    row, column = np.unravel_index(int(np.argmax(image)), image.shape)
    return int(column), int(row)


def test_the_list_comes_at_once_and_by_request(page: Page) -> None:
    told = page.next("sessions")["sessions"]
    assert told == page.http.get("/api/sessions").json()
    entry = next(entry for entry in told if entry["name"] == "first")
    assert (entry["width"], entry["height"], entry["windows"], entry["state"]) == (48, 32, WINDOWS, "complete")
    assert entry["tracked_share"] == pytest.approx(0.9)
    assert entry["losses"] == WINDOWS // 10
    assert len(entry["sparkline"]) == 64
    assert entry["has_ground_truth"]


def test_a_session_is_described(page: Page) -> None:
    told = page.http.get(f"/api/sessions/first?tab={TAB}").json()
    assert told["windows"] == WINDOWS
    assert told["viser"] == f"/viser/{TAB}/"
    assert told["keyframes"] == [{"keyframe": 0, "window": 0}]
    assert told["log"] == [{"window": 0, "level": "info", "text": "initialized"}]
    assert told["summary"] == {"note": "made for tests"}
    assert told["recording_found"]
    assert page.http.get("/api/sessions/nobody").status_code == 404


def test_a_window_that_cannot_be_drawn_is_answered_too(page: Page, folder: Path) -> None:
    path = make_session(folder / "sessions" / "cut.h5", folder / "r.h5", WINDOWS)
    assert page.http.get("/api/sessions/cut").json()["windows"] == WINDOWS
    path.write_bytes(b"")  # rows and textures are read when they are asked for
    page.seek("cut", 4, request=7, kinds=("raw", "texture"))
    error = page.next("error")
    assert error["request"] == 7
    assert "cut.h5" in error["text"]
    page.seek("first", 5, request=8)
    assert page.next("images")[0]["request"] == 8
    path.unlink()


def test_a_tab_survives_the_end_of_its_renderer(dashboard: Dashboard, page: Page) -> None:
    page.seek("first", 5)
    page.next("images")
    (renderer,) = (thread for thread in threading.enumerate() if thread.name == f"tab {TAB}")
    assert isinstance(renderer, Renderer)
    renderer.mailbox.close()
    renderer.join(10)
    page.seek("first", 6, request=2)
    assert page.next("images")[0]["window"] == 6


@pytest.mark.parametrize("start", [0, 77, WINDOWS, 9999])
def test_columns_are_laid_out_as_specified(page: Page, start: int) -> None:
    data = page.http.get(f"/api/sessions/first/columns?start={start}").content
    length = struct.unpack_from("<I", data)[0]
    assert (4 + length) % 8 == 0
    header = json.loads(data[4 : 4 + length])
    first = min(start, WINDOWS)
    assert (header["start"], header["count"]) == (first, WINDOWS - first)
    offset, columns = 4 + length, {}
    for column in header["columns"]:
        dtype = {"f64": "<f8", "f32": "<f4", "u8": "u1"}[column["dtype"]]
        columns[column["name"]] = np.frombuffer(data, dtype, header["count"], offset)
        offset += -(-columns[column["name"]].nbytes // 8) * 8
    assert offset == len(data)
    k = np.arange(first, WINDOWS)
    np.testing.assert_allclose(columns["t_s"], 0.01 * k, atol=1e-9)
    np.testing.assert_array_equal(columns["status"], np.where(k % 10 == 9, 3, 1))
    np.testing.assert_allclose(columns["contrast_gain"], 2.0)
    np.testing.assert_allclose(columns["event_rate_hz"], PER_WINDOW / 0.01)
    # The truth is the estimate: no error but rounding.
    assert np.all(columns["error_percent"] < 1e-3)
    assert np.all(columns["error_deg"] < 1e-3)


@pytest.mark.parametrize("window", [0, 1, 47, 48, 119])
def test_the_right_window_is_drawn(page: Page, window: int) -> None:
    page.seek("first", window, request=7, kinds=("raw", "warped", "map", "texture"))
    header, images = page.next("images")
    assert (header["session"], header["window"], header["request"]) == ("first", window, 7)
    assert [image["kind"] for image in header["images"]] == ["raw", "warped", "map", "texture"]
    assert [(i["width"], i["height"]) for i in header["images"]] == [(48, 32)] * 3 + [(90, 60)]
    assert brightest_pixel(images[0]) == pixel_of(window)
    assert brightest_pixel(images[1]) == pixel_of(window)
    values = header["values"]
    assert values["t_s"] == pytest.approx(0.01 * window)
    assert values["position"] == pytest.approx([0.002 * window, 0, 0])
    assert values["truth"]["position"] == pytest.approx(values["position"], abs=1e-6)
    assert values["score"] is None  # not a number has no JSON
    assert values["weak"] == "motion along x and rotation about y"


def test_scale_makes_a_finer_grid(page: Page) -> None:
    page.seek("first", 50, kinds=("raw", "warped"), scale=3)
    header, images = page.next("images")
    assert {(i["width"], i["height"]) for i in header["images"]} == {(144, 96)}
    column, row = pixel_of(50)
    assert brightest_pixel(images[1]) == (3 * column + 1, 3 * row + 1)


def test_values_are_clamped(page: Page) -> None:
    page.seek("first", 10**9, request=1, kinds=("raw",), scale=99)
    header, _ = page.next("images")
    assert header["window"] == WINDOWS - 1
    assert header["images"][0]["width"] == 4 * 48


@pytest.mark.parametrize(
    "text",
    [
        "x",
        "[]",
        "{}",
        '{"type": "seek"}',
        '{"type": "seek", "session": "first", "window": "NaN", "request": 1, "kinds": []}',
        '{"type": "seek", "session": "first", "window": 1, "request": 1, "kinds": ["../x"]}',
        '{"type": "open", "session": "../secret"}',
        '{"type": "layers", "layers": 5}',
        '{"type": "explode"}',
        '{"type": "seek", "session": "first", "window": Infinity, "request": 1, "kinds": []}',
        '{"type": "seek", "session": "first", "window": 1, "request": 1e999, "kinds": []}',
        '{"type": "landscape", "session": "first", "window": -1e999, "request": 1, "axes": [0, 1]}',
        '{"type": "layers", "request": NaN, "layers": [[[1]]]}',
        "[" * 9_000,
        '{"type": "' + "x" * 20_000 + '"}',
    ],
)
def test_senseless_messages_are_answered_and_survived(page: Page, text: str) -> None:
    page.socket.send(text)
    told = page.next("error")
    assert told["text"] and (told["request"] is None or told["request"] == 1)
    page.seek("first", 3)
    assert page.next("images")[0]["window"] == 3


def test_the_latest_seek_wins(page: Page) -> None:
    for k in range(100):
        page.seek("first", k, request=k, kinds=("raw", "warped", "map"))
    seen = []
    while not seen or seen[-1] != 99:
        header, _ = page.next("images")
        assert header["window"] == header["request"]
        seen.append(header["window"])
    assert seen == sorted(seen)
    assert len(seen) < 100, "seeks that were overtaken are not drawn"


def test_each_tab_has_its_own_playhead(dashboard: Dashboard) -> None:
    tabs = [Page(dashboard, f"{k:016x}") for k in range(10)]
    try:
        for k, page in enumerate(tabs):
            page.seek("first", 11 * k, request=k)
        for k, page in enumerate(tabs):
            header, images = page.next("images")
            assert header["window"] == 11 * k
            assert brightest_pixel(images[0]) == pixel_of(11 * k)
    finally:
        for page in tabs:
            page.__exit__()


def test_a_second_page_of_one_name_is_turned_away(dashboard: Dashboard, page: Page) -> None:
    page.next("sessions")
    with Page(dashboard) as twin, pytest.raises(ConnectionClosed) as closed:
        twin.socket.recv(timeout=10)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 4409
    page.seek("first", 5)
    assert page.next("images")[0]["window"] == 5


def test_without_its_recording_a_session_shows_what_is_stored(page: Page) -> None:
    page.seek("orphan", 0, kinds=("raw", "warped", "map", "texture"))
    header, _ = page.next("images")
    assert [image["kind"] for image in header["images"]] == ["warped", "texture"]  # window 0 is a keyframe
    page.seek("orphan", 1, kinds=("raw", "warped", "map"))
    header, images = page.next("images")
    assert images == []
    assert "recording is not there" in header["values"]["note"]
    assert page.http.get("/api/sessions/orphan").json()["recording_found"] is False


def test_a_page_that_opens_a_session_is_told_how_far_it_is(page: Page) -> None:
    page.seek("first", 0)
    grown = page.next("grown")
    while grown["session"] != "first":  # what the tab showed before a reload is told, too
        grown = page.next("grown")
    assert (grown["windows"], grown["state"]) == (WINDOWS, "complete")


def test_a_growing_session_is_told(dashboard: Dashboard, folder: Path, page: Page) -> None:
    writer = create_session(folder / "sessions" / "growing.h5", folder / "r.h5", WINDOWS)
    with writer:
        writer.append(result(0))
        writer.add(first_updates())
        writer.flush()
        page.seek("growing", 0)
        assert page.next("images")[0]["window"] == 0
        for k in range(1, 40):
            writer.append(result(k))
        writer.flush()
        grown = page.next("grown")
        while grown["session"] != "growing" or grown["windows"] < 40:
            grown = page.next("grown")
        assert grown["state"] == "live"
        assert grown["status"] == "lost"
        assert grown["progress"]["share"] == pytest.approx(40 / WINDOWS)
        page.seek("growing", 39)
        header, images = page.next("images")
        assert header["window"] == 39
        assert brightest_pixel(images[0]) == pixel_of(39)
        writer.close({})
    while grown["state"] == "live":
        grown = page.next("grown")
    assert grown["state"] == "complete"


def test_the_scene_is_joined_with_viser_and_closed_to_others(dashboard: Dashboard, page: Page) -> None:
    import viser

    base, _ = base_and_token(dashboard.address)
    page.seek("first", 4)
    page.next("images")
    html = page.http.get(f"/viser/{TAB}/")
    assert html.status_code == 200
    assert "Viser" in html.text
    assert "frame-ancestors 'self'" in html.headers["content-security-policy"]
    protocol: Any = f"viser-v{viser.__version__}"
    with connect(
        f"{base.replace('http', 'ws')}/viser/{TAB}",
        origin=base,  # type: ignore[arg-type]
        subprotocols=[protocol],
        additional_headers={"Cookie": cookie_of(page.http)},
        proxy=None,
        max_size=None,
    ) as through:
        assert through.subprotocol == protocol
        assert len(through.recv(timeout=10)) > 100
    port = dashboard._tabs.get(TAB).scene.port
    with connect(f"ws://127.0.0.1:{port}/", subprotocols=[protocol], proxy=None) as around:
        with pytest.raises(ConnectionClosed) as closed:
            around.recv(timeout=10)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1008


def test_an_export_says_how_far_it_is_and_the_same_one_is_made_once(page: Page) -> None:
    def number() -> str:
        body = {"to": "rrd", "reuse": True}
        return page.http.post("/api/sessions/orphan/export", json=body).raise_for_status().json()["id"]

    first, until = number(), time.monotonic() + 30
    while not (told := page.http.get(f"/api/exports/{first}/progress").json())["done"]:
        assert not told["error"]
        assert time.monotonic() < until
        time.sleep(0.05)
    assert told["share"] == 1.0
    assert page.http.get(f"/api/exports/{first}").content.startswith(b"RRF")
    assert number() == first
    page.http.post("/api/sessions/orphan/bookmarks", json={"window": 3, "text": "changed"}).raise_for_status()
    assert number() != first, "the file is another one now"
    assert page.http.get("/api/exports/none/progress").status_code == 404


def test_reruns_viewer_is_the_installed_one_and_may_reach_this_server_only(page: Page) -> None:
    answer = page.http.get("/rerun/")
    assert "connect-src 'self';" in answer.headers["Content-Security-Policy"]
    assert 'src="/rerun/re_viewer.js"' in answer.text
    program = page.http.get("/rerun/re_viewer_bg.wasm")
    assert program.headers["Content-Type"] == "application/wasm"
    assert program.content.startswith(b"\0asm")
    assert "wasm_bindgen" in page.http.get("/rerun/re_viewer.js").text
    assert page.http.get("/rerun/secret.js").status_code == 404
