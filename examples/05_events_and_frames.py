"""The event tracker and the methods of frames on one recording, in one table: a fast shake in front of a wall.

Frames of 30 Hz are blurred by a shutter of 10 ms and have depth; the events are those of the same seconds. With a file
(one that has intensity frames and the truth, such as slider_depth.zip) the frames are its own, without depth.
"""

import argparse
import time
from pathlib import Path

import dvsviz
from dvsviz.pipeline import track
from dvsviz.registration.events import session_rows
from dvsviz.registration.frames import RecordingFrames, open_frames
from dvsviz.registration.methods import WITHOUT_DEPTH
from dvsviz.registration.study import study
from dvsviz.registration.tables import format_table
from dvsviz.simulate.rgbd import simulate_rgbd
from dvsviz.simulate.simulate import default_camera, simulate

METHODS = (
    "none",
    "essential",
    "essential-refined",
    "homography",
    "kabsch",
    "pnp-iterative",
    "pnp-refined",
    "pnp-icp",
)

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("file", type=Path, nargs="?", help="a recording; simulated where none is given")
parser.add_argument("--out", type=Path, default=Path("events-and-frames"), help="folder for what is made")
parser.add_argument("--scene", choices=("shapes", "poster"), default="shapes")
parser.add_argument("--motion", choices=("shake", "handheld"), default="shake")
parser.add_argument("--seconds", type=float, default=4.0)
parser.add_argument("--exposure-ms", type=float, default=10.0)
parser.add_argument("--skips", type=int, nargs="+", default=(1, 2, 5))
parser.add_argument("--speed", type=float, help="m/s: the length of each step for methods that no depth tells it")
said = parser.parse_args()

said.out.mkdir(parents=True, exist_ok=True)
name = f"{said.scene}-{said.motion}" if said.file is None else said.file.stem
if said.file is None:
    flight = {"scene": said.scene, "motion": said.motion, "seconds": said.seconds, "seed": 1}
    simulate(said.out / f"{name}.h5", **flight)
    exposure_s = said.exposure_ms * 1e-3
    simulate_rgbd(said.out / name, **flight, camera=default_camera(), rate_hz=30.0, exposure_s=exposure_s)
    recording = dvsviz.open_recording(said.out / f"{name}.h5")
    frames, methods = open_frames(said.out / name), METHODS
    # One length has to be told to events alone: how far the wall is from the first camera.
    truth, normal = recording.ground_truth, recording.plane_normal_world
    distance = float(recording.plane_distance_world + truth.positions[0] @ normal)
else:
    recording = dvsviz.open_recording(said.file)
    frames, methods, distance = RecordingFrames(recording), tuple(m for m in METHODS if m in WITHOUT_DEPTH), None

session = said.out / f"{name}-session.h5"
# Of a file nobody has said that a plane is before the camera: what moves how is found out.
model = "planar" if said.file is None else "auto"
track(recording, dvsviz.TrackerConfig(motion=model, plane_distance=distance), session, force=True)
runs = study(frames, methods, tuple(said.skips), speed=said.speed, clock=time.process_time)
print(format_table([run.row for run in runs] + session_rows(session, frames, runs)))
