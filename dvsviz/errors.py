"""Typed errors: what is wrong, in which file, at which place, and what to do next."""

from __future__ import annotations

from pathlib import Path


class DvsvizError(Exception):
    """An error that a user can act on: one line that names file, place and next step.

    Args:
        message: what is wrong, without a full stop.
        path: the file it is about.
        place: where in the file (`line 12`, `events/t`, `byte 4096`).
        hint: what the user can do next.
    """

    def __init__(
        self,
        message: str,
        *,
        path: Path | str | None = None,
        place: str | None = None,
        hint: str | None = None,
    ) -> None:
        self.message, self.path, self.place, self.hint = message, path, place, hint
        where = ", ".join(str(part) for part in (path, place) if part is not None)
        text = f"{where}: {message}" if where else message
        super().__init__(f"{text}; {hint}" if hint else text)


class FormatError(DvsvizError):
    """A recording, calibration or trajectory file that cannot be read as it is."""


class SessionError(DvsvizError):
    """A session file that cannot be opened, written or resumed."""


class ConfigError(DvsvizError):
    """A setting that is unknown or out of range."""


class EvaluationError(DvsvizError):
    """Trajectories that cannot be compared (no overlap in time, too few poses)."""


class RunCancelled(DvsvizError):
    """A run that was stopped by the user; what was written stays."""
