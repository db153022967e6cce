"""The trajectories of other sessions in a tab's scene, with the camera of the same time."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from dvsviz.geometry import se3
from dvsviz.view import geometry3d
from dvsviz.view.compare import Laid
from dvsviz.view.shown import ShownSession

# The page's --compare-1, -2, -3.
COMPARED_RGB = ((53, 201, 220), (181, 211, 52), (255, 157, 157))


class ComparedScene:
    """What comparing adds to a tab's scene.

    Args:
        server: the tab's viser server.
        lock: the scene's.
    """

    def __init__(self, server: viser.ViserServer, lock: threading.RLock) -> None:
        self._server, self._lock = server, lock
        self._handles: list[Any] = []
        self._laid: list[tuple[Laid, Any]] = []

    def show(self, others: Sequence[tuple[ShownSession, Laid]], t_us: int | None) -> None:
        """Draw sessions in the open one's world; none takes them away.

        Args:
            others: sessions, laid into the open one's world.
            t_us: time of the playhead, for the cameras.
        """
        with self._lock, self._server.atomic():
            for handle in self._handles:
                handle.remove()
            self._handles, self._laid = [], []
            for number, (shown, laid) in enumerate(others[: len(COMPARED_RGB)]):
                rgb = COMPARED_RGB[number]
                points = geometry3d.path(laid.Ts_world_camera[:, :3, 3])
                if len(points) == 0:
                    continue
                self._handles.append(
                    self._server.scene.add_line_segments(
                        f"/compared/{number}",
                        points,
                        geometry3d.line_rgb(rgb),
                        thickness=2.5,
                        thickness_units="screen",
                    )
                )
                fov, aspect = geometry3d.field_of_view(shown.session.header.camera)
                camera = self._server.scene.add_camera_frustum(
                    f"/compared/camera{number}",
                    fov,
                    aspect,
                    scale=0.13,
                    thickness=2.0,
                    thickness_units="screen",
                    color=rgb,
                    cast_shadow=False,
                    receive_shadow=False,
                )
                self._handles.append(camera)
                self._laid.append((laid, camera))
            if t_us is not None:
                self.move(t_us)
        self._server.flush()

    def move(self, t_us: int) -> None:
        """Put the cameras where the sessions had them at a time."""
        for laid, camera in self._laid:
            window = int(np.searchsorted(laid.t_us, t_us, side="right")) - 1
            T = laid.Ts_world_camera[max(0, window)]
            if np.isfinite(T).all():
                camera.wxyz, camera.position = se3.quaternion_from_rotation(T[:3, :3]), T[:3, 3]
