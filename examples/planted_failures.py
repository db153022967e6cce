"""Write three short recordings that go wrong for one reason each, and track them: sessions to try the dashboard on.

python examples/planted_failures.py [FOLDER]
dvsviz serve --sessions FOLDER/sessions
"""

import sys
from pathlib import Path
from typing import get_args

import dvsviz
from dvsviz.pipeline import track
from dvsviz.simulate.planted import Planted, plant

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "planted")
for name in get_args(Planted):
    recording, session = folder / "recordings" / f"{name}.h5", folder / "sessions" / f"{name}.h5"
    if not recording.exists():
        plant(name, recording)
    track(dvsviz.open_recording(recording), dvsviz.TrackerConfig(), session, force=True)
    with dvsviz.open_session(session) as found:
        for failure in found.failures:
            print(f"{name}: windows {failure.start} to {failure.end - 1}: {failure.cause}: {failure.message}")
