"""A rerun recording on disk: written under a temporary name, checked, then renamed."""

from __future__ import annotations

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from dvsviz.errors import DvsvizError

APPLICATION = "dvsviz"


class RrdFile:
    """A recording stream into a file that has its name only when it is whole."""

    def __init__(self, path: Path, blueprint: rrb.Blueprint, *, name: str) -> None:
        """Begin a file.

        Args:
            path: its final name; replaced where it exists.
            blueprint: how it opens.
            name: what the viewer calls the recording.

        Raises:
            DvsvizError: the folder cannot be written.
        """
        self.path = path
        self._partial = path.with_name(f".{path.stem}.partial.rrd")
        try:
            # rerun only logs that it could not open a file.
            self._partial.write_bytes(b"")
        except OSError as error:
            raise DvsvizError(f"cannot be written: {error.strerror}", path=path, hint="check the folder") from error
        self.stream = rr.RecordingStream(APPLICATION)
        self.stream.save(self._partial, default_blueprint=blueprint)
        self.stream.send_recording_name(name)

    def finish(self, expected: dict[str, int]) -> None:
        """End the file, read it back and give it its name.

        Args:
            expected: rows that each entity must have at least.

        Raises:
            DvsvizError: what was read back is less than what was written.
        """
        self._end()
        try:
            found = count_rows(self._partial)
        except (OSError, RuntimeError, ValueError) as error:
            self._partial.unlink(missing_ok=True)
            raise self._broken(str(error)) from error
        missing = [name for name, rows in expected.items() if found.get(name, 0) < rows]
        if missing:
            self._partial.unlink(missing_ok=True)
            raise self._broken(f"rows of {', '.join(missing)} are missing")
        self._partial.replace(self.path)

    def abandon(self) -> None:
        """End and delete the file."""
        self._end()
        self._partial.unlink(missing_ok=True)

    def _end(self) -> None:
        self.stream.flush()
        self.stream.disconnect()

    def _broken(self, what: str) -> DvsvizError:
        return DvsvizError(
            f"the rerun recording is not whole: {' '.join(what.split())[:200]}",
            path=self.path,
            hint="check the free space and try again",
        )


def count_rows(path: Path) -> dict[str, int]:
    """Return the rows that are bound to time of each entity of a rerun recording."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        if not chunk.is_static:
            name = chunk.entity_path.lstrip("/")
            rows[name] = rows.get(name, 0) + chunk.num_rows
    return rows
