"""Trying again, as it is seen: a camera to be dragged, a branch beside its origin, a window from another pose."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from dvsviz.errors import DvsvizError
from dvsviz.geometry import se3
from dvsviz.view import geometry3d, images
from dvsviz.view.images import ImageOptions
from dvsviz.view.moving import MovingWindow
from dvsviz.view.picture import Picture
from dvsviz.view.shown import ShownSession

Array = NDArray[np.float64]

# Seen on the dark ground, and none of the states' colours: what is tried stands apart from what was.
_TRIED_RGB = (222, 165, 255)
_GIZMO_SIZE = 0.28
# Levels of `overlay_picture`: above the first an edge is drawn, from the second on it is explained by the map.
_DRAWN, _EXPLAINED, _END = 13, 86, 172


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """How a window lies on the map from a pose.

    Attributes:
        picture: its events on the map.
        explained: share (0 to 1) of its edge pixels that the map explains; NaN where it has none.
    """

    picture: Picture
    explained: float


def fit(shown: ShownSession, window: int, T_world_camera: Array) -> Fit:
    """Return how a window's events lie on the map, as it was before the window, from a pose.

    Raises:
        ValueError: there is no such window, or no map yet.
        DvsvizError: the recording is gone.
    """
    result, revision = shown.result(window), shown.map_at(window - 1)
    if revision is None:
        raise ValueError("there is no map yet at this window")
    events = shown.events_of(result)
    if events is None:
        raise DvsvizError(shown.missing or "the recording is not there any more")
    moving = MovingWindow(
        window=events, T_world_camera=T_world_camera, omega=result.omega, velocity=result.velocity
    )
    camera = shown.session.header.camera
    picture = images.overlay_picture([moving], T_world_camera, revision, camera, ImageOptions())
    known = int(np.count_nonzero((picture.pixels > _EXPLAINED + _DRAWN) & (picture.pixels < _END)))
    unknown = int(np.count_nonzero((picture.pixels > _DRAWN) & (picture.pixels < _EXPLAINED)))
    return Fit(picture=picture, explained=known / (known + unknown) if known + unknown else float("nan"))


class TrialScene:
    """What trying again adds to a tab's scene.

    Args:
        server: the tab's viser server.
        lock: the scene's.
        dragged: called with position (3,) and quaternion wxyz (4,) when a person moves the camera.
    """

    def __init__(
        self, server: viser.ViserServer, lock: threading.RLock, dragged: Callable[[Array, Array], None]
    ) -> None:
        self._server, self._lock, self._dragged = server, lock, dragged
        self._gizmo: Any = None
        self._pyramid: Any = None
        self._path: Any = None
        self._beside: ShownSession | None = None
        self._drawn = -1

    @property
    def beside(self) -> ShownSession | None:
        """The branch that is drawn."""
        return self._beside

    def clear(self) -> None:
        """Take everything away."""
        with self._lock:
            self.take_away()
            self.show_beside(None)

    def place(self, shown: ShownSession, T_world_camera: Array) -> None:
        """Show a camera with handles at a pose (4, 4), or move it there."""
        wxyz = se3.quaternion_from_rotation(T_world_camera[:3, :3])
        position = T_world_camera[:3, 3]
        with self._lock:
            if self._gizmo is None:
                self._gizmo = self._server.scene.add_transform_controls(
                    "/trial", scale=_GIZMO_SIZE, wxyz=wxyz, position=position, depth_test=False
                )
                self._gizmo.on_update(lambda event: self._dragged(event.target.position, event.target.wxyz))
                fov, aspect = geometry3d.field_of_view(shown.session.header.camera)
                self._pyramid = self._server.scene.add_camera_frustum(
                    "/trial/camera",
                    fov,
                    aspect,
                    scale=0.16,
                    thickness=3.0,
                    thickness_units="screen",
                    color=_TRIED_RGB,
                    cast_shadow=False,
                    receive_shadow=False,
                )
            else:
                self._gizmo.wxyz, self._gizmo.position = wxyz, position
            self._server.flush()

    def take_away(self) -> None:
        """Take the camera with handles away."""
        with self._lock:
            for handle in (self._pyramid, self._gizmo):
                if handle is not None:
                    handle.remove()
            self._pyramid = self._gizmo = None
            self._server.flush()

    def show_beside(self, shown: ShownSession | None) -> None:
        """Draw a branch's trajectory from where it begins; None takes it away."""
        with self._lock:
            if shown is not self._beside and self._path is not None:
                self._path.remove()
                self._path = None
            self._beside, self._drawn = shown, -1
            if shown is not None:
                self.grow(shown)
            self._server.flush()

    def grow(self, shown: ShownSession) -> None:
        """Draw what was added to the branch."""
        with self._lock:
            if shown is not self._beside or shown.window_count == self._drawn:
                return
            self._drawn = shown.window_count
            origin = shown.session.header.origin
            first = max(0, origin.window - 1) if origin is not None else 0
            points = geometry3d.path(shown.poses()[first:, :3, 3])
            if len(points):
                self._path = self._server.scene.add_line_segments(
                    "/beside", points, geometry3d.line_rgb(_TRIED_RGB), thickness=4.0, thickness_units="screen"
                )
            self._server.flush()
