"""Who is let in, against the real server with a real client."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from gateway_samples import TAB, base_and_token, cookie_of, logged_in, make_recording, make_session, running
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from dvsviz.errors import DvsvizError
from dvsviz.gateway.app import Dashboard
from dvsviz.gateway.security import host_is_allowed

SECRET = "root:x:0"


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("security")
    recording = make_recording(folder / "r.h5", 20)
    (folder / "sessions").mkdir()
    make_session(folder / "sessions" / "s.h5", recording, 20)
    (folder / "secret.h5").write_text(SECRET)
    with running((), folder / "sessions") as dashboard:
        yield dashboard.address


@pytest.fixture(scope="module")
def client(address: str) -> Iterator[httpx.Client]:
    client = logged_in(address)
    yield client
    client.close()


def anonymous(address: str, **headers: str) -> httpx.Client:
    return httpx.Client(base_url=base_and_token(address)[0], headers=headers, trust_env=False)


@pytest.mark.parametrize(
    "path", ["/api/sessions", "/api/sessions/s", "/api/sessions/s/columns", "/api/exports/1", "/rerun/"]
)
def test_nothing_is_told_without_the_cookie(address: str, path: str) -> None:
    with anonymous(address) as stranger:
        assert stranger.get(path).status_code == 403


def test_the_scene_needs_the_cookie(address: str) -> None:
    with anonymous(address) as stranger:
        assert stranger.get(f"/viser/{TAB}/").status_code == 403


@pytest.mark.parametrize("token", ["", "wrong", None, 5, ["x"]])
def test_a_wrong_token_gives_no_cookie(address: str, token: object) -> None:
    with anonymous(address) as stranger:
        answer = stranger.post("/api/login", json={"token": token})
        assert answer.status_code == 403
        assert "set-cookie" not in answer.headers


def test_the_cookie_is_out_of_reach_of_scripts_and_other_sites(address: str) -> None:
    base, token = base_and_token(address)
    answer = httpx.post(f"{base}/api/login", json={"token": token}, trust_env=False)
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert token.lower() not in cookie


def test_the_page_itself_needs_no_cookie_and_has_a_policy(address: str) -> None:
    with anonymous(address) as stranger:
        answer = stranger.get("/")
    assert answer.status_code == 200
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self';" in policy
    assert "frame-ancestors 'none'" in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
def test_a_name_pointed_at_this_machine_is_refused(client: httpx.Client, host: str) -> None:
    assert client.get("/api/sessions", headers={"Host": host}).status_code in (400, 421)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://localhost"])
def test_another_page_is_refused_even_with_the_cookie(client: httpx.Client, origin: str) -> None:
    assert client.post("/api/runs/s", json={"action": "cancel"}, headers={"Origin": origin}).status_code == 403
    assert client.get("/api/sessions", headers={"Origin": origin}).status_code == 403


@pytest.mark.parametrize("path", ["/ws?tab=" + TAB, "/viser/" + TAB])
@pytest.mark.parametrize("origin", ["http://evil.example", None, "null"])
def test_a_websocket_needs_this_servers_origin(address: str, client: httpx.Client, path: str, origin: str) -> None:
    url = base_and_token(address)[0].replace("http", "ws") + path
    headers = {"Cookie": cookie_of(client)}
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(url, origin=origin, additional_headers=headers, proxy=None),
    ):  # type: ignore[arg-type]
        pass
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize("path", ["/ws?tab=" + TAB, "/viser/" + TAB])
def test_a_websocket_needs_the_cookie(address: str, path: str) -> None:
    base = base_and_token(address)[0]
    with pytest.raises(InvalidStatus), connect(base.replace("http", "ws") + path, origin=base, proxy=None):  # type: ignore[arg-type]
        pass


@pytest.mark.parametrize(
    "path",
    [
        "/api/sessions/..%2Fsecret",
        "/api/sessions/%2e%2e%2fsecret",
        "/api/sessions/..",
        "/api/sessions/%2Fetc%2Fpasswd",
        "/api/sessions/secret/columns",
        "/api/exports/..%2F..%2Fsecret.h5",
        "/static/..%2f..%2fsecret.h5",
        "/static/%2e%2e/pyproject.toml",
        "/static/../pyproject.toml",
        f"/viser/{TAB}/..%2f..%2fpyproject.toml",
        "/viser/..%2f..%2fetc/passwd",
        "/viser/0123/",
        "/viser/0123456789ABCDEF/",
    ],
)
def test_no_path_leads_out(address: str, client: httpx.Client, path: str) -> None:
    host, port = base_and_token(address)[0].removeprefix("http://").split(":")
    # Not through httpx, which would tidy the path.
    with socket.create_connection((host, int(port)), timeout=10) as raw:
        head = f"GET {path} HTTP/1.1\r\nHost: {host}:{port}\r\nCookie: {cookie_of(client)}\r\n"
        raw.sendall(f"{head}Connection: close\r\n\r\n".encode())
        answer = b"".join(iter(lambda: raw.recv(65536), b"")).decode("utf-8", "replace")
    assert answer.split()[1] in ("404", "307"), answer[:200]
    assert SECRET not in answer
    assert "[project]" not in answer


def test_a_large_body_is_refused(client: httpx.Client) -> None:
    assert client.post("/api/login", content=b"x" * 100_000).status_code == 413


@pytest.mark.parametrize("body", [b"", b"[]", b"{", b'{"action": "explode"}'])
def test_a_senseless_body_is_an_error_not_a_crash(client: httpx.Client, body: bytes) -> None:
    answer = client.post("/api/runs/s", content=body)
    assert answer.status_code == 400
    assert answer.json()["error"]


@pytest.mark.parametrize(
    ("host", "is_allowed"),
    [
        ("127.0.0.1:8765", True),
        ("localhost:9", True),
        ("[::1]:8765", True),
        ("192.168.1.5:80", True),
        ("my-host:80", True),
        ("evil.example", False),
        ("localhost.evil.example", False),
        ("[", False),
        ("", False),
    ],
)
def test_hosts(host: str, is_allowed: bool) -> None:
    assert host_is_allowed(host, "my-host") is is_allowed


def test_a_port_in_use_is_said(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(DvsvizError, match=f"port {port} is in use; .*--port"):
            Dashboard((), sessions_dir=tmp_path, port=port)


def test_a_path_that_is_nothing_is_said_and_the_port_is_given_back(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    for _ in range(2):
        with pytest.raises(DvsvizError, match="missing"):
            Dashboard((tmp_path / "missing.h5",), sessions_dir=tmp_path, port=port)
