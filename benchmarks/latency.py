"""Time from a sensor event to its pose in the server, on a stream of half a million events a second.

    python benchmarks/latency.py [--seconds 10] [--rate 500000] [--motion planar]

A simulated recording is replayed by one process at the speed that gives the rate, and tracked by a dashboard's run in
another. Of each window: from the moment when its last event was due in the replay to the moment when the server has
its pose, and told a page so. The page is a websocket without a browser. The machine's load is printed, too: two
processes that wait for a core make every figure larger.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
import threading
import time
import urllib.request
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np


def replaying(path: Path, speed: float, pipe: Connection) -> None:
    from dvsviz.formats.open import open_recording
    from dvsviz.live.server import EventServer, replay

    recording = open_recording(path)
    camera = recording.camera
    with EventServer("127.0.0.1", 0, width=camera.width, height=camera.height) as server:
        pipe.send(server.port)
        server.wait_for_client()
        pipe.send(time.monotonic())
        pipe.send(replay(recording, server, speed=speed))


def told_windows(
    address: str,
    name: str,
    poses: list[tuple[float, int]],
    times: list[tuple[float, int]],
    stop: threading.Event,
) -> None:
    """Take down when the server told the pose of the last of so many windows, and that there were so many to see."""
    from websockets.sync.client import connect

    base, token = address.split("/#token=")
    request = urllib.request.Request(
        f"{base}/api/login",
        json.dumps({"token": token}).encode(),
        {"Origin": base, "Content-Type": "application/json"},
    )
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request) as answer:
        headers = {"Cookie": answer.headers["Set-Cookie"].split(";")[0]}
    socket = connect(
        f"{base.replace('http', 'ws')}/ws?tab=1a7e0c1a7e0c1a7e",
        origin=base,  # type: ignore[arg-type]
        additional_headers=headers,
        proxy=None,
        max_size=None,
    )
    asked = False
    with socket:
        while not stop.is_set():
            try:
                message = socket.recv(timeout=0.2)
            except TimeoutError:
                continue
            now = time.monotonic()
            if isinstance(message, bytes):
                continue
            told = json.loads(message)
            if told["type"] == "sessions" and not asked and any(one["windows"] for one in told["sessions"]):
                options = {"session": name, "window": 0, "request": 1, "kinds": ["raw"], "options": {}}
                socket.send(json.dumps({"type": "seek", **options}))
                asked = True
            if told["type"] == "pose":
                poses.append((now, told["window"] + 1))
            if told["type"] == "grown":
                times.append((now, told["windows"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=5e5)
    parser.add_argument("--motion", default="planar")
    parser.add_argument("--recording", type=Path, help="instead of the simulated one")
    given = parser.parse_args()
    from dvsviz.config import TrackerConfig
    from dvsviz.formats.open import open_recording
    from dvsviz.gateway.app import Dashboard
    from dvsviz.gateway.orders import RunOrder, RunState
    from dvsviz.geometry.camera import Camera
    from dvsviz.session.store import open_session
    from dvsviz.simulate.simulate import simulate

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        path = given.recording or folder / "wall.h5"
        camera = Camera(width=360, height=270, fx=300.0, fy=300.0, cx=179.5, cy=134.5)
        if given.recording is None:
            # Its rate of events is about right as it is, so that nothing moves faster than a hand does.
            simulate(path, scene="shapes", motion="handheld", seconds=given.seconds, seed=1, camera=camera)
        recording = open_recording(path)
        speed = given.rate / (recording.events.count / recording.duration_s)
        spawn = multiprocessing.get_context("spawn")
        ours, theirs = spawn.Pipe()
        process = spawn.Process(target=replaying, args=(path, speed, theirs), daemon=True)
        process.start()
        out = folder / "sessions" / "live.h5"
        order = RunOrder(
            recording=Path("live"),
            out=out,
            live=f"aedat4+tcp://127.0.0.1:{ours.recv()}",
            config=TrackerConfig(motion=given.motion),
        )
        dashboard = Dashboard(sessions_dir=out.parent, port=0, live=order)
        stop, poses, times = threading.Event(), [], []
        server = threading.Thread(target=dashboard.run)
        server.start()
        page = threading.Thread(target=told_windows, args=(dashboard.address, "live", poses, times, stop))
        page.start()
        begun_s, late_s = ours.recv(), ours.recv()
        run = dashboard.runs.get("live")
        while run is not None and run.state not in (RunState.DONE, RunState.FAILED):
            time.sleep(0.1)
        figures = {} if run is None else run.progress
        stop.set()
        page.join()
        dashboard.stop()
        server.join()
        dashboard.close()
        process.join()
        with open_session(out) as session:
            ends = session.column("end_event")
            summary = session.summary or {}
        t_us = np.array([int(recording.events.read(int(end) - 1, int(end)).t_us[0]) for end in ends])
        due_s = begun_s + (t_us - recording.first_us) * 1e-6 / speed
        live = summary.get("live", {})
        print(
            f"stream      {recording.events.count:,d} events at {given.rate / 1e6:g} Mev/s, speed {speed:.2f}, "
            f"sent at most {1e3 * late_s:.0f} ms late; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        )
        print(
            f"tracked     {len(ends)} windows, {live.get('used_share', 0):.1%} of the events used, "
            f"left out {live.get('skips', 0)} times, {summary.get('tracked_share', 0):.1%} tracked"
        )
        for what, told in (("pose in the page's state ", poses), ("window in the session   ", times)):
            known, ms = 0, []
            for at, count in told:
                ms += [1e3 * (at - due) for due in due_s[known:count]]
                known = max(known, count)
            if not ms:
                print(f"due event to {what}  none was told: the stream ended before the tracker was ready")
                continue
            median, p95 = np.percentile(ms, [50, 95])
            print(f"due event to {what}  median {median:.0f} ms, p95 {p95:.0f} ms, of {len(ms)} windows")
        print(
            f"arrival to pose, as the page shows it  median {live.get('latency_median_ms', 0):.0f} ms, "
            f"p95 {live.get('latency_p95_ms', 0):.0f} ms ({figures.get('stream', '')})"
        )


if __name__ == "__main__":
    main()
