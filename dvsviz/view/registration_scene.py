"""What a registration of frames adds to a tab's scene: the trajectories of all methods, and the points of a frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from dvsviz.session.registration import RegistrationRecord
from dvsviz.view import geometry3d
from dvsviz.view.registration_colours import INLIER_RGB, method_colours

_LINE_PX, _POINT_SIZE = 2.0, 0.008


class RegistrationScene:
    """Trajectories and points of one tab.

    Args:
        server: the tab's viser server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._handles: dict[str, Any] = {}
        self._lines_on = self._points_on = True

    def clear(self) -> None:
        """Take everything away: another session is shown."""
        for handle in self._handles.values():
            handle.remove()
        self._handles.clear()

    def open(self, record: RegistrationRecord | None) -> None:
        """Show the trajectories of all methods at the shown run's skip."""
        self.clear()
        if record is None:
            return
        colours = method_colours(record)
        for k, run in enumerate(record.runs):
            if run.skip != record.shown_run.skip or k == record.primary or run.name == "none":
                continue
            positions = run.Ts_world_camera[:, :3, 3]
            points = geometry3d.path(positions)
            if len(points):
                handle = self._server.scene.add_line_segments(
                    f"/methods/{k}",
                    points,
                    geometry3d.line_rgb(colours[run.name]),
                    thickness=_LINE_PX,
                    thickness_units="screen",
                    visible=self._lines_on,
                )
                self._handles[f"line {k}"] = handle

    def move(self, record: RegistrationRecord | None, window: int) -> None:
        """Show the 3-D points that a frame was registered by."""
        if record is None:
            return
        old = self._handles.pop("points", None)
        points = record.steps[window - 1].points if window else np.zeros((0, 3), np.float32)
        if len(points) == 0:
            if old is not None:
                old.remove()
            return
        T = record.shown_run.Ts_world_camera[window]
        self._handles["points"] = self._server.scene.add_point_cloud(
            "/points",
            (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
            INLIER_RGB,
            point_size=_POINT_SIZE,
            point_shape="circle",
            visible=self._points_on,
        )

    def set_layers(self, layers: dict[str, bool]) -> None:
        """Show or hide: the trajectories with `trajectory`, the points with `map`."""
        self._lines_on = layers.get("trajectory", self._lines_on)
        self._points_on = layers.get("map", self._points_on)
        for name, handle in self._handles.items():
            handle.visible = self._points_on if name == "points" else self._lines_on
