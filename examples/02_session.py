"""Track a file into a session, and read what is in it."""

import sys
from pathlib import Path

import dvsviz
from dvsviz.pipeline import track

path = Path(sys.argv[1] if len(sys.argv) > 1 else "example.h5")
out = Path("sessions") / f"{path.stem}.h5"

summary = track(dvsviz.open_recording(path), dvsviz.TrackerConfig(motion="planar"), out, force=True)
print(f"{summary['windows']} windows, {summary['real_time_factor']:.1f} times real time")

with dvsviz.open_session(out) as session:
    columns = session.columns()  # every number of every window, as arrays
    print("contrast gain, median:", round(float(sorted(columns["contrast_gain"])[session.window_count // 2]), 2))
    print("keyframes were made of windows", [keyframe.window for keyframe in session.keyframes])
    last_map = session.map_at(session.window_count - 1)
    if last_map is not None:
        rows, cols = last_map.texture.shape
        print(f"the map has {cols} x {rows} texels, {last_map.px_per_unit:.0f} a plane distance")
    for entry in session.log:
        print(f"window {entry.window}: {entry.text}")
