"""Track a file in a loop of five lines. Any recording that `dvsviz info` opens will do."""

import sys
from pathlib import Path

import dvsviz

path = Path(sys.argv[1] if len(sys.argv) > 1 else "example.h5")

recording = dvsviz.open_recording(path)
tracker = dvsviz.Tracker(recording.camera)
for window in dvsviz.windows(recording, lambda: tracker.window_size):
    result = tracker.step(window)
    print(f"{result.start_us * 1e-6:8.3f} s  {result.status:12}  {result.T_world_camera[:3, 3].round(4)}")
