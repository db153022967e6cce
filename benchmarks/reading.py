"""Million events a second that are read of each format, beside the library used directly where there is one.

    python benchmarks/reading.py [FOLDER]      the folder of real recordings, else DVSVIZ_DATA or ../shared/data

`first` converts into an empty cache, `again` reads all events of the converted copy.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

FILES = (
    "ecd/slider_depth.zip",
    "gyro/rotdisk_events.npz",
    "gyro/rotdisk.aedat",
    "formats/davis346.aedat4",
    "formats/evt2.raw",
    "formats/evt3.raw",
    "formats/gen4.dat",
    "formats/dvs.es",
    "formats/test_events_1.bag",
    "formats/test_events_1",
    "formats/test_events_2",
    "dvs128/garfield.mat",
)


def aedat4_library(path: Path) -> int:
    import dv_processing as dv

    reader, count = dv.io.MonoCameraRecording(str(path)), 0
    while (batch := reader.getNextEventBatch()) is not None:
        count += len(batch.numpy())
    return count


def raw_library(path: Path) -> int:
    import evlib

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return len(evlib.load_events(str(path), sort=False).collect())


LIBRARIES: dict[str, tuple[str, Callable[[Path], int]]] = {
    ".aedat4": ("dv-processing", aedat4_library),
    ".raw": ("evlib", raw_library),
}


def main() -> None:
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else os.environ.get("DVSVIZ_DATA", beside))
    from dvsviz.formats.open import open_recording

    print(f"{'file':28} {'events':>10} {'first':>7} {'again':>7}  library   (million events a second)")
    for name in FILES:
        path = folder / name
        with tempfile.TemporaryDirectory() as scratch:
            # Once before the clock starts, for kernels and imports; then into another, empty cache.
            os.environ["DVSVIZ_CACHE"] = f"{scratch}/warm"
            open_recording(path).close()
            os.environ["DVSVIZ_CACHE"] = f"{scratch}/cold"
            start = time.perf_counter()
            open_recording(path).close()
            first = time.perf_counter() - start
            start = time.perf_counter()
            recording = open_recording(path)
            count = sum(len(events) for events in recording.chunks())
            again = time.perf_counter() - start
            recording.close()
        text = ""
        if path.suffix in LIBRARIES:
            label, read = LIBRARIES[path.suffix]
            read(path)
            start = time.perf_counter()
            found = read(path)
            text = f"{found / (time.perf_counter() - start) / 1e6:.1f} {label}"
        print(f"{name:28} {count:10,d} {count / first / 1e6:7.1f} {count / again / 1e6:7.1f}  {text}", flush=True)


if __name__ == "__main__":
    main()
