"""Trying again in one tab: the camera that is dragged, and the branch that is shown beside its origin."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import DvsvizError
from dvsviz.gateway import wishes
from dvsviz.gateway.library import Library
from dvsviz.view.shown import ShownSession
from dvsviz.view.trial import TrialScene

KINDS = ("gizmo", "beside")


async def obey(message: dict[str, Any], shown: ShownSession | None, library: Library, scene: TrialScene) -> None:
    """Obey a page's `gizmo` or `beside` message.

    Raises:
        ValueError, KeyError, TypeError: it makes no sense.
        DvsvizError: there is no such session.
    """
    if message["type"] == "gizmo":
        pose = wishes.pose_from(message.get("pose"))
        if pose is None or shown is None:
            await asyncio.to_thread(scene.take_away)
        else:
            await asyncio.to_thread(scene.place, shown, pose)
        return
    name = message["session"]
    if name is None:
        await asyncio.to_thread(scene.show_beside, None)
        return
    try:
        beside = await asyncio.to_thread(library.open, wishes.text_from(name, "session"))
    except KeyError:
        raise DvsvizError(f"there is no session {name!r}", hint="choose one of the list") from None
    await asyncio.to_thread(scene.show_beside, beside)


def dragged(position: NDArray[np.float64], wxyz: NDArray[np.float64]) -> dict[str, Any]:
    """Return the message that tells a page where its camera was dragged."""
    return {
        "type": "gizmo",
        "position": [float(value) for value in position],
        "quaternion_wxyz": [float(value) for value in wxyz],
    }
