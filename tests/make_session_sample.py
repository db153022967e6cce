"""Writes tests/data/session-v1.h5, the sample that has to stay readable for ever: run once for each version."""

from pathlib import Path

import numpy as np
import session_samples as samples

from dvsviz.session.store import SessionWriter, add_bookmark, set_tags

SAMPLE = Path(__file__).parent / "data" / "session-v1.h5"
WINDOWS = 44


def main() -> None:
    SAMPLE.parent.mkdir(exist_ok=True)
    with SessionWriter.create(SAMPLE, samples.header(), chunk_rows=4) as writer:
        writer.set_ground_truth(samples.truth(3))
        for k in range(WINDOWS):
            writer.append(samples.result(k), samples.updates(k))
            if k == 39:
                writer.checkpoint(k, {"pose": samples.pose(k)})
        writer.close({"windows": WINDOWS})
    add_bookmark(SAMPLE, 41, "lost here")
    set_tags(SAMPLE, ("sample",))
    print(SAMPLE, SAMPLE.stat().st_size, "bytes", np.__version__)


if __name__ == "__main__":
    main()
