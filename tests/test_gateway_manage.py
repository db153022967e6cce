"""What the page changes: runs that are started, tried again, renamed, tagged, kept, resumed and deleted."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gateway_samples as samples
import httpx
import pytest

from dvsviz.config import TrackerConfig
from dvsviz.errors import ConfigError
from dvsviz.gateway import wishes
from dvsviz.gateway.app import Dashboard
from dvsviz.geometry.camera import Camera
from dvsviz.session.store import open_session
from dvsviz.simulate.simulate import simulate

HOSTILE = ("../gone", "/etc/passwd", "a/b", ".hidden", "", "x" * 300, "a\x00b", "..", "con\nsole")


def until(is_so: Callable[[], Any], what: str, seconds: float = 120.0) -> Any:
    end = time.monotonic() + seconds
    while not (found := is_so()):
        assert time.monotonic() < end, f"after {seconds:g} s it was not so that {what}"
        time.sleep(0.05)
    return found


class Page:
    """A client that is logged in."""

    def __init__(self, client: httpx.Client) -> None:
        self.client = client

    def entries(self) -> dict[str, dict[str, Any]]:
        return {entry["name"]: entry for entry in self.client.get("/api/sessions").json()}

    def post(self, path: str, /, **body: Any) -> httpx.Response:
        return self.client.post(path, json=body)

    def change(self, session: str, /, **body: Any) -> httpx.Response:
        return self.post(f"/api/sessions/{session}/change", **body)

    def recording(self, file: str) -> tuple[str, dict[str, Any]]:
        """Number and description of a recording of the list."""
        listed = self.client.get("/api/recordings").json()["recordings"]
        number = next(r["id"] for r in listed if r["file"] == file)
        return number, until(
            lambda: (
                told if (told := self.client.get(f"/api/recordings/{number}").json())["state"] == "ready" else None
            ),
            "it was read",
        )


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    camera = Camera(width=160, height=120, fx=140, fy=140, cx=79.5, cy=59.5)
    simulate(folder / "wall.h5", seconds=1.5, seed=1, camera=camera)
    (folder / "trajectory.txt").write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    (folder / "deep").mkdir()
    (folder / "deep" / "events.txt").write_text("0.001 1 2 1\n0.002 3 4 0\n")
    (folder / "link.h5").symlink_to("/etc/hostname")
    return folder


@pytest.fixture
def sessions(tmp_path: Path) -> Path:
    return tmp_path / "sessions"


@pytest.fixture
def dashboard(sessions: Path, recordings: Path) -> Iterator[Dashboard]:
    sessions.mkdir()
    recording = samples.make_recording(sessions / "recordings.h5", 30)
    samples.make_session(sessions / "old.h5", recording, 30)
    samples.create_session(sessions / "cut.h5", recording, 30).abandon()
    with samples.running((), sessions, (recordings,)) as dashboard:
        yield dashboard


@pytest.fixture
def page(dashboard: Dashboard) -> Iterator[Page]:
    client = samples.logged_in(dashboard.address)
    yield Page(client)
    client.close()


def test_only_recordings_of_the_folders_are_offered(page: Page, recordings: Path) -> None:
    offer = page.client.get("/api/recordings").json()
    assert {r["file"] for r in offer["recordings"]} == {"wall.h5", "deep", "recordings.h5"}
    assert str(recordings.parent) not in json.dumps(offer)
    fields = {field["name"]: field for field in offer["config"]}
    assert fields["motion"]["choices"] == ["planar", "translation", "rotation", "auto"]
    assert fields["window"]["kind"] == "whole" and fields["window"]["optional"]
    for number in ("0" * 16, "wall.h5", "..%2f..%2fetc%2fpasswd", str(recordings / "wall.h5")):
        assert page.client.get(f"/api/recordings/{number}").status_code == 404
        assert page.post("/api/runs", recording=number, name="x").status_code == 404


def test_a_run_is_started_with_everything_that_was_set(page: Page, sessions: Path) -> None:
    number, told = page.recording("wall.h5")
    assert told["name"] == "wall" and told["ground_truth"] and told["camera"]["fx"] == 140
    estimate = told["estimate"]
    assert estimate["free_bytes"] > 0 and estimate["bytes_per_s"] > 0 and estimate["events_per_second"] > 0
    camera = {"fx": 150.0, "fy": 151.0, "cx": 80.0, "cy": 60.0, "distortion": [0.01, 0, 0, 0, 0]}
    started = page.post(
        "/api/runs",
        recording=number,
        name="my wall",
        config={"motion": "planar", "window": 3000, "seed": 5},
        start_s=0.2,
        end_s=1.2,
        filters={"hot_pixels": False, "background_us": None, "refractory_us": 100},
        camera=camera,
    )
    assert started.json() == {"name": "my wall"}
    assert page.post("/api/runs", recording=number, name="my wall").status_code == 409
    second = page.post("/api/runs", recording=number, name="second").json()["name"]
    waits = until(lambda: page.entries().get(second), "the second waits", 5)
    assert waits["state"] == "queued" and waits["run"]["before"] == 1
    assert page.post(f"/api/runs/{second}", action="cancel").status_code == 204
    until(lambda: second not in page.entries(), "the second is gone", 5)
    entry = until(
        lambda: e if (e := page.entries().get("my wall")) and e["state"] == "complete" and not e["run"] else None,
        "it ends",
    )
    assert entry["duration_s"] == pytest.approx(1.0, abs=0.01)
    with open_session(sessions / "my wall.h5") as session:
        assert (session.header.camera.fx, session.header.camera.fy) == (150, 151)
        assert session.header.camera.distortion[0] == 0.01
        assert TrackerConfig.from_json(session.header.config_json) == TrackerConfig(window=3000, seed=5)
        assert session.header.filters_json is not None and "100" in session.header.filters_json
        assert session.header.part_s == pytest.approx((0.2, 1.2), abs=1e-3)
    described = page.client.get("/api/sessions/my%20wall").json()
    assert described["recording_found"] and described["filters"]["refractory_us"] == 100

    # Tried again from its middle, kept, and its origin deleted.
    window = described["windows"] // 2
    branch = page.post("/api/sessions/my wall/branch", window=window, config={"window": 1500}).json()["name"]
    assert branch == "my wall try"
    assert page.change("my wall", do="delete", name="my wall").status_code == 409
    tried = until(
        lambda: e if (e := page.entries().get(branch)) and e["state"] == "complete" and not e["run"] else None,
        "the branch ends",
    )
    assert not tried["kept"] and tried["origin"]["window"] == window
    assert tried["origin"]["changes"] == {"window": [3000, 1500]}
    assert (sessions / "branches" / f"{branch}.h5").exists()
    assert page.change(branch, do="keep", name="better wall").json() == {"name": "better wall"}
    assert page.entries()["better wall"]["kept"] and (sessions / "better wall.h5").exists()
    assert page.change("better wall", do="keep", name="again").status_code == 409


def test_a_pose_is_previewed_and_checked(page: Page) -> None:
    pose = {"position": [0.01, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}
    seen = page.post("/api/sessions/old/preview", window=20, pose=pose).json()
    assert seen["png"].startswith("iVBOR")
    wrong: tuple[Any, ...] = (
        None,
        {"position": [0, 0], "quaternion_wxyz": [1, 0, 0, 0]},
        {"position": [0, 0, 0], "quaternion_wxyz": [0, 0, 0, 0]},
        {"position": [0, 0, float("1e9")], "quaternion_wxyz": [1, 0, 0, 0]},
        {"position": ["0", 0, 0], "quaternion_wxyz": [1, 0, 0, 0]},
        {"position": [10**400, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]},
    )
    for bad in wrong:
        assert page.post("/api/sessions/old/preview", window=20, pose=bad).status_code == 400
    deep = page.client.post("/api/sessions/old/preview", content="[" * 20_000)
    assert deep.status_code == 400 and "nested" in deep.json()["error"]
    assert page.post("/api/sessions/old/branch", window=2, config={"seed": 2**63}).status_code == 409
    assert page.post("/api/sessions/old/branch", window=300).status_code == 400
    assert page.post("/api/sessions/old/branch", window=0, pose=pose).status_code == 400
    assert page.post("/api/sessions/old/branch", window=2, config={"motion": "sideways"}).status_code == 409
    assert page.post("/api/sessions/none/branch", window=2).status_code == 404


def test_sessions_are_renamed_tagged_and_deleted(page: Page, sessions: Path) -> None:
    for name in HOSTILE:
        assert page.change("old", do="rename", name=name).status_code in (400, 409), name
    assert sorted(p.name for p in sessions.iterdir()) == ["cut.h5", "old.h5", "recordings.h5"]
    assert page.change("old", do="rename", name="cut").status_code == 409
    assert page.change("old", do="rename", name="new name").json() == {"name": "new name"}
    assert page.client.get("/api/sessions/old").status_code == 404
    assert page.client.get("/api/sessions/new%20name").json()["windows"] == 30
    assert page.change("new name", do="tag", tags=[" a ", "b", "a", ""]).status_code == 200
    until(lambda: page.entries()["new name"]["tags"] == ["a", "b"], "the tags are listed", 5)
    for tags in (["x" * 99], "a", [1], [str(k) for k in range(40)]):
        assert page.change("new name", do="tag", tags=tags).status_code == 400

    assert page.change("new name", do="delete").status_code == 400
    assert page.change("new name", do="delete", name="cut").status_code == 400
    assert page.change("..%2Frecordings", do="delete", name="../recordings").status_code == 404
    assert page.change("recordings", do="delete", name="recordings").status_code == 409
    assert page.change("new name", do="delete", name="new name").json() == {"name": None}
    assert sorted(p.name for p in sessions.iterdir()) == ["cut.h5", "recordings.h5"]
    assert page.change("new name", do="delete", name="new name").status_code == 404
    assert page.change("cut", do="sing").status_code == 400


def test_what_is_written_is_left_alone(page: Page, sessions: Path) -> None:
    recording = sessions / "recordings.h5"
    with samples.create_session(sessions / "busy.h5", recording, 30) as writer:
        writer.append(samples.result(0))
        writer.flush()
        until(lambda: "busy" in page.entries(), "it is listed", 5)
        for body in ({"do": "delete", "name": "busy"}, {"do": "rename", "name": "x"}, {"do": "tag", "tags": ["a"]}):
            refused = page.change("busy", **body)
            assert refused.status_code == 409
            assert "being written" in refused.json()["error"]
        assert page.change("busy", do="resume").status_code == 409
        writer.close({})
    assert (sessions / "busy.h5").exists()
    assert page.change("busy", do="resume").status_code == 409  # it is complete
    assert page.change("busy", do="delete", name="busy").status_code == 200


def test_an_incomplete_session_is_resumed(page: Page, sessions: Path, recordings: Path) -> None:
    number, _ = page.recording("wall.h5")
    page.post("/api/runs", recording=number, name="part", config={"window": 1500})
    until(lambda: (e := page.entries().get("part")) and e["windows"] > 8 and e["run"], "it tracks")
    refused = page.change("part", do="delete", name="part")
    assert refused.status_code == 409 and "is being tracked" in refused.json()["error"]
    page.post("/api/runs/part", action="cancel")
    entry = until(
        lambda: e if (e := page.entries()["part"])["state"] != "live" and not e["run"] else None, "it stops"
    )
    if entry["state"] == "incomplete":
        assert page.change("part", do="resume").json() == {"name": "part"}
    until(lambda: page.entries()["part"]["state"] == "complete", "it ends")
    with open_session(sessions / "part.h5") as session:
        assert session.column("end_event")[-1] == session.header.events


def test_changes_need_the_cookie_and_the_right_origin(dashboard: Dashboard, page: Page, sessions: Path) -> None:
    base, _ = samples.base_and_token(dashboard.address)
    paths = ("/api/runs", "/api/sessions/old/change", "/api/sessions/old/branch", "/api/sessions/old/preview")
    with httpx.Client(base_url=base, trust_env=False) as stranger:
        for path in paths:
            assert stranger.post(path, json={"do": "delete", "name": "old"}).status_code == 403
        assert stranger.get("/api/recordings").status_code == 403
    for path in paths:
        foreign = {"Origin": "http://elsewhere.example"}
        assert page.client.post(path, json={"do": "delete", "name": "old"}, headers=foreign).status_code == 403
        assert page.client.get(path).status_code in (404, 405)
    assert (sessions / "old.h5").exists()


def test_values_are_checked() -> None:
    recorded = Camera.guess(160, 120)
    same = {"fx": 128.0, "fy": 128.0, "cx": 79.5, "cy": 59.5, "distortion": [0, 0, 0, 0, 0]}
    assert wishes.camera_from(same, recorded) is None
    changed = wishes.camera_from(same | {"fx": 200}, recorded)
    assert changed is not None and changed.fx == 200 and not changed.is_guess
    for bad in ({"fx": 0}, {"fx": 1e9}, {"cx": float("nan")}, {"fy": "1"}, {"distortion": [0]}, {"cy": 1e6}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            wishes.camera_from(same | bad, recorded)
    with pytest.raises(ConfigError, match="unknown setting"):
        wishes.config_from({"colour": 1})
    for bad in ({"background_us": 0}, {"background_us": 1.5}, {"hot_pixels": 1}, {"other": 1}, []):
        with pytest.raises(ValueError, match=r"background|hot|filters"):
            wishes.filters_from(bad)
    assert wishes.filters_from({"hot_pixels": False, "background_us": None}) is None
    for bad in (-1, float("nan"), True, "1"):
        with pytest.raises(ValueError, match="start"):
            wishes.seconds_from(bad, "start")


def test_a_full_disk_is_told(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage("/")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    _, told = page.recording("wall.h5")
    assert told["estimate"]["free_bytes"] == told["estimate"]["free_copy_bytes"] == 1000
