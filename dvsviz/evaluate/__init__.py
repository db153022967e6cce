"""How far a trajectory is from the truth: association in time, alignment, ATE, RPE, tables.

The public function has the room's name, so that `dvsviz.evaluate(session)` reads as it is meant. Importing anything
of this room binds the *module* to `dvsviz.evaluate`; the module is therefore callable and passes the call on.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dvsviz.evaluate.evaluate import Evaluation


class _CallableRoom(ModuleType):
    """The room as a module that can be called like its function."""

    def __call__(self, *args: Any, **options: Any) -> Evaluation:
        """Return `dvsviz.evaluate.evaluate.evaluate(*args, **options)`."""
        from dvsviz.evaluate.evaluate import evaluate

        return evaluate(*args, **options)


sys.modules[__name__].__class__ = _CallableRoom
