"""What a dashboard with clients costs: the tracker's time, the right frame in ten tabs, memory over many seeks.

    python benchmarks/dashboard.py [--seconds 8] [--tab-seeks 60] [--seeks 5000] [--repeats 3] [--json]

* **slowed**: a recording is tracked by a real server, alone and with a client attached that follows the run, takes the
  images of every window it hears of and renders nothing; by turns, so that a busy machine is busy for both. Told are
  the ratios of the medians of the tracker's own time (the sum of the windows' `time_spent_s`), of its process's time on
  the processor (which other programs of a busy machine change less) and of the wall time.
* **ten tabs**: ten connections with playheads of their own seek at once; every picture is decoded and compared with the
  window it was asked for.
* **memory**: one connection seeks many times to random windows of a session of 5,000; the server's resident memory is
  read from the system after the first fifth and at the end.

Nothing is drawn by a browser here: `benchmarks/seek.py` measures what is seen in one.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import httpx
import numpy as np
import websockets

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "browser"))
import browser_samples as samples
from browser_server import served
from gateway_samples import unpack

from dvsviz.session.store import open_session
from dvsviz.simulate.simulate import simulate

_KINDS = ["raw", "warped", "map", "texture"]
_TABS = 10
_BIG = 5000


class Client:
    """A page without a page: it is logged in and speaks the dashboard's protocol."""

    def __init__(self, address: str) -> None:
        self.base, _, token = address.partition("/#token=")
        self.http = httpx.Client(base_url=self.base, trust_env=False, timeout=60)
        self.http.post("/api/login", json={"token": token}).raise_for_status()
        self._cookie = "; ".join(f"{c.name}={c.value}" for c in self.http.cookies.jar)

    def connect(self, tab: int) -> Any:
        """A websocket of a tab of its own."""
        return websockets.connect(
            f"{self.base.replace('http', 'ws')}/ws?tab={tab:016x}",
            additional_headers={"Cookie": self._cookie, "Origin": self.base},
            max_size=None,
            proxy=None,
        )

    def entry(self, name: str) -> dict[str, Any] | None:
        return next((e for e in self.http.get("/api/sessions").json() if e["name"] == name), None)


def seek(session: str, window: int, request: int, kinds: list[str]) -> str:
    return json.dumps(
        {"type": "seek", "session": session, "window": window, "request": request, "kinds": kinds, "options": {}}
    )


def bits_of(png: bytes) -> int | None:
    """The window that a picture of the bar code shows, or None where its rows do not complement each other."""
    decoded = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    if decoded is None:
        return None
    image = decoded.max(axis=2)
    half, window = samples.SQUARE // 2, 0
    for bit in range(samples.BITS):
        x = samples.LEFT + samples.PITCH * bit + half
        one = image[samples.UPPER + half, x] > 60
        if one == (image[samples.LOWER + half, x] > 60):
            return None
        window += int(one) << bit
    return window


async def follow(client: Client, name: str) -> int:
    """Take the images of every window that is told while a session grows; return how many came."""
    came, request, windows, state = 0, 0, 0, "live"
    async with client.connect(1) as socket:
        await socket.send(json.dumps({"type": "open", "session": name}))
        while state == "live":
            message = await socket.recv()
            if isinstance(message, bytes):
                came += 1
                continue
            told = json.loads(message)
            if told["type"] == "grown" and told["session"] == name:
                state = told["state"]
                if told["windows"] > windows:
                    windows, request = told["windows"], request + 1
                    await socket.send(seek(name, windows - 1, request, _KINDS))
    return came


class CpuClock(threading.Thread):
    """Reads the processor time of a server's tracking process until it is stopped."""

    def __init__(self, server: int) -> None:
        super().__init__(daemon=True)
        self._server, self._ended = server, threading.Event()
        self.seconds = 0.0

    def run(self) -> None:
        while not self._ended.wait(0.05):
            tasks = Path(f"/proc/{self._server}/task").glob("*/children")
            children = [int(pid) for task in tasks for pid in _text(task).split()]
            found = [_text(Path(f"/proc/{pid}/stat")).rpartition(")")[2].split() for pid in children]
            ticks = [int(stat[11]) + int(stat[12]) for stat in found if len(stat) > 12]
            self.seconds = max([self.seconds, *(count / os.sysconf("SC_CLK_TCK") for count in ticks)])

    def stop(self) -> None:
        self._ended.set()
        self.join()


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""  # the process has ended


def track(client: Client, pid: int, number: str, name: str, *, attached: bool) -> tuple[float, float, int]:
    """Start a run as the page does; return its wall and processor seconds and the images that a client took."""
    clock = CpuClock(pid)
    clock.start()
    client.http.post("/api/runs", json={"recording": number, "name": name}).raise_for_status()
    came = 0
    while (entry := client.entry(name)) is None or not entry["windows"]:
        time.sleep(0.05)
    before_s = clock.seconds
    if attached:
        came = asyncio.run(follow(client, name))
    while (entry := client.entry(name)) is None or entry["state"] != "complete" or entry["run"]:
        time.sleep(0.2)
    clock.stop()
    wall_s = float(client.http.get(f"/api/sessions/{name}").json()["summary"]["wall_s"])
    return wall_s, clock.seconds - before_s, came


def slowed(folder: Path, seconds: float, repeats: int) -> dict[str, Any]:
    """Compare runs with a client and without one, by turns."""
    recordings, sessions = folder / "recordings", folder / "slowed"
    recordings.mkdir()
    simulate(recordings / "wall.h5", scene="shapes", motion="handheld", seconds=seconds, seed=1)
    own: dict[bool, list[float]] = {False: [], True: []}
    wall: dict[bool, list[float]] = {False: [], True: []}
    taken = []
    cpu: dict[bool, list[float]] = {False: [], True: []}
    running = served(sessions, folder / "cache", "--recordings", str(recordings))
    with running as address:
        client, pid = Client(address), running.process.pid
        (number,) = (r["id"] for r in client.http.get("/api/recordings").json()["recordings"])
        while client.http.get(f"/api/recordings/{number}").json()["state"] != "ready":
            time.sleep(0.1)
        track(client, pid, number, "warm", attached=True)
        for repeat in range(repeats):
            for attached in (repeat % 2 == 0, repeat % 2 == 1):
                name = f"r{repeat}{'with' if attached else 'alone'}"
                took, worked, came = track(client, pid, number, name, attached=attached)
                with open_session(sessions / f"{name}.h5") as session:
                    own[attached].append(float(session.column("time_spent_s").sum()))
                    wall[attached].append(took)
                    cpu[attached].append(worked)
                    if attached:
                        taken.append(came / session.window_count)
    return {
        "tracker_alone_s": round(median(own[False]), 2),
        "tracker_with_client_s": round(median(own[True]), 2),
        "tracker_slowed_percent": round(100 * (median(own[True]) / median(own[False]) - 1), 1),
        "tracker_cpu_slowed_percent": round(100 * (median(cpu[True]) / median(cpu[False]) - 1), 1),
        "run_slowed_percent": round(100 * (median(wall[True]) / median(wall[False]) - 1), 1),
        "windows_taken_share": round(median(taken), 2),
    }


async def ten_tabs(client: Client, session: str, windows: int, seeks: int, seed: int) -> dict[str, Any]:
    """Seek in ten tabs at once; every answer must show its own window."""

    async def one(tab: int) -> tuple[int, int, list[float]]:
        rng, right, wrong, took = np.random.default_rng(seed + tab), 0, 0, []
        async with client.connect(100 + tab) as socket:
            await socket.send(json.dumps({"type": "open", "session": session}))
            for request in range(1, seeks + 1):
                window = int(rng.integers(windows))
                from_s = time.perf_counter()
                await socket.send(seek(session, window, request, ["raw"]))
                while True:
                    message = await socket.recv()
                    if isinstance(message, bytes):
                        header, parts = unpack(message)
                        if header["request"] == request:
                            break
                took.append(time.perf_counter() - from_s)
                ok = header["window"] == window and bits_of(parts[0]) == window
                right, wrong = right + ok, wrong + (not ok)
        return right, wrong, took

    found = await asyncio.gather(*(one(tab) for tab in range(_TABS)))
    took = np.concatenate([times for *_, times in found])
    return {
        "tabs": _TABS,
        "right_frames": sum(right for right, *_ in found),
        "wrong_frames": sum(wrong for _, wrong, _ in found),
        "answer_median_ms": round(1e3 * float(np.median(took)), 1),
        "answer_p95_ms": round(1e3 * float(np.percentile(took, 95)), 1),
    }


async def memory(client: Client, session: str, windows: int, seeks: int, pid: int) -> dict[str, Any]:
    """Seek again and again; the caches are full after a fifth of it, and nothing may grow from then on."""
    rng, marks = np.random.default_rng(7), [max(1, seeks // 5), seeks]
    read = []
    async with client.connect(7) as socket:
        await socket.send(json.dumps({"type": "open", "session": session}))
        for request in range(1, seeks + 1):
            await socket.send(seek(session, int(rng.integers(windows)), request, _KINDS))
            while True:
                message = await socket.recv()
                if isinstance(message, bytes) and unpack(message)[0]["request"] == request:
                    break
            if request in marks:
                read.append(resident_mb(pid))
    return {
        "seeks": seeks,
        "memory_after_a_fifth_mb": round(read[0], 1),
        "memory_at_the_end_mb": round(read[-1], 1),
        "grown_percent": round(100 * (read[-1] / read[0] - 1), 1),
    }


def resident_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def barcode_server(folder: Path, windows: int) -> Iterator[tuple[Client, int]]:
    """A server over a session whose pictures tell their window."""
    sessions = folder / f"barcode-{windows}"
    sessions.mkdir()
    recording = samples.write_recording(folder / f"barcode-{windows}.h5", windows)
    samples.write_session(sessions / "barcode.h5", recording, windows)
    running = served(sessions, folder / "cache")
    with running as address:
        yield Client(address), running.process.pid


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="length of the recording that is tracked")
    parser.add_argument("--seeks", type=int, default=5000)
    parser.add_argument("--tab-seeks", type=int, default=60, help="of each of the ten tabs")
    parser.add_argument("--repeats", type=int, default=3, help="runs with a client, and as many without")
    parser.add_argument("--windows", type=int, default=_BIG, help="windows of the session that is sought in")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    figures: dict[str, Any] = {}

    def tell(found: dict[str, Any]) -> None:
        figures.update(found)
        if not asked.json:
            for name, value in found.items():
                print(f"{name:26} {value}", flush=True)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with barcode_server(folder, asked.windows) as (client, pid):
            if asked.tab_seeks:
                tell(asyncio.run(ten_tabs(client, "barcode", asked.windows, asked.tab_seeks, seed=1)))
            if asked.seeks:
                tell(asyncio.run(memory(client, "barcode", asked.windows, asked.seeks, pid)))
        if asked.repeats:
            tell(slowed(folder, asked.seconds, asked.repeats))
    if asked.json:
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
