"""Byte mutations of files of every format: each must open or be refused by one line, within time and memory.

`make nightly` runs 2,000 a file (`python tests/fuzz_formats.py [--cases N] [FILE...]`), `test_formats_fuzz.py` a few.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

from dvsviz.errors import DvsvizError
from dvsviz.formats.open import open_recording

FILES = (
    "ecd/slider_depth.zip",
    "ecd/shapes_start/events.txt",
    "ecd/shapes_rotation_start/events.npz",
    "gyro/rotdisk.aedat",
    "dvs128/building.mat",
    "formats/dvs.es",
    "formats/atis.es",
    "formats/gen4.dat",
    "formats/evt2.raw",
    "formats/evt3.raw",
    "formats/davis346.aedat4",
    "formats/test_events_1.bag",
    "formats/test_events_1/test_events_1.db3",
    "formats/test_events_2/test_events_2_0.mcap",
)
MAX_BYTES = 100_000
MAX_SECONDS = 20.0
MAX_RESIDENT_MB = 1024


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the bytes cut short, with flipped bits, overwritten runs, or a part doubled or removed."""
    out = bytearray(data)
    kind = rng.integers(0, 6)
    if kind == 0:
        return bytes(out[: rng.integers(0, len(out))])
    at = int(rng.integers(0, min(len(out), 2048) if rng.random() < 0.5 else len(out)))
    size = int(rng.integers(1, 64))
    if kind == 1:
        for _ in range(int(rng.integers(1, 20))):
            out[int(rng.integers(0, len(out)))] ^= 1 << int(rng.integers(0, 8))
    elif kind == 2:
        out[at : at + size] = rng.bytes(len(out[at : at + size]))
    elif kind == 3:
        out[at : at + size] = b"\xff" * len(out[at : at + size])
    elif kind == 4:
        del out[at : at + size]
    else:
        out[at:at] = out[at : at + size]
    return bytes(out)


def try_one(path: Path, *, repair: bool) -> str:
    """Return `opened` or the error's text.

    Raises:
        AssertionError: the error is not one line with the file's name, or it took too long.
    """
    start = time.monotonic()
    try:
        recording = open_recording(path, size=None if repair else (1280, 720), repair=repair)
        for events in recording.chunks():
            assert np.all(np.diff(events.t_us) >= 0)
            assert events.x_px.max() < recording.camera.width and events.y_px.max() < recording.camera.height
        found = "opened"
    except DvsvizError as error:
        found = str(error)
        assert "\n" not in found and path.name.split(".")[0] in found, found
    seconds = time.monotonic() - start
    assert seconds < MAX_SECONDS, f"{seconds:.1f} s"
    return found


def fuzz(source: Path, cases: int, seed: int, scratch: Path) -> dict[str, int]:
    """Return how many mutations of a file were opened and refused."""
    # The first part of a file holds its header and enough events; bags and archives keep their index at the end.
    data = source.read_bytes()
    # A large file is tried whole less often: reading all of it takes most of a case's time.
    whole = 0.5 if len(data) < 1 << 20 else 0.15 if len(data) < 4 << 20 else 0.06
    counts = {"opened": 0, "refused": 0}
    for case in range(cases):
        rng = np.random.default_rng([seed, case])
        base = data if rng.random() < whole else data[:MAX_BYTES]
        path = scratch / f"fuzzed{source.suffix}"
        path.write_bytes(mutate(base, rng))
        try:
            found = try_one(path, repair=bool(case % 2))
        except BaseException:
            print(f"{source.name}: case {case} of seed {seed}", file=sys.stderr)
            raise
        counts["opened" if found == "opened" else "refused"] += 1
    return counts


def main() -> None:
    import os
    import tempfile

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "files", nargs="*", type=Path, help="all kinds of DVSVIZ_DATA or ../shared/data if left away"
    )
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    folder = Path(os.environ.get("DVSVIZ_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    files = arguments.files or [folder / name for name in FILES]
    with tempfile.TemporaryDirectory() as scratch:
        os.environ["DVSVIZ_CACHE"] = f"{scratch}/cache"
        for source in files:
            counts = fuzz(source, arguments.cases, arguments.seed, Path(scratch))
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"{source.name}: {counts}, peak {peak:.0f} MB", flush=True)
            if peak > MAX_RESIDENT_MB:
                sys.exit(f"{source.name}: more than {MAX_RESIDENT_MB} MB were needed")


if __name__ == "__main__":
    main()
