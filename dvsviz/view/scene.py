"""The 3-D scene of one browser tab: viser's only home.

Each tab has a viser server of its own, on an ephemeral loopback port (started in 6 ms, 0.5 MB). So a tab's scene needs
no pairing of viser's clients with tabs, a reconnecting client is sent the whole scene again by viser itself, and two
tabs may show two sessions. A connection without the proxy's key is closed before it is sent anything.
"""

from __future__ import annotations

import contextlib
import io
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from dvsviz.session.records import MapRevision
from dvsviz.view import geometry3d
from dvsviz.view.compared import ComparedScene
from dvsviz.view.images import BACKGROUND, ImageKind, texture_picture
from dvsviz.view.playback import Drawn
from dvsviz.view.registration_scene import RegistrationScene
from dvsviz.view.shown import ShownSession
from dvsviz.view.trial import TrialScene

_log = logging.getLogger(__name__)

KEY_HEADER = "x-dvsviz-key"
LAYERS = ("map", "trajectory", "keyframes", "truth", "frustum")

# A software-rendered frame costs a page 100 ms: more pushes than these only queue.
_IMAGE_EVERY_S = 1 / 15
_MAP_EVERY_S = 1.0
_TRUTH_RGB = (204, 121, 167)
_KEYFRAME_RGB = (240, 228, 66)
_FRUSTUM_RGB = (236, 240, 243)
_FOV_RAD = 0.9
# The wall is a little lighter than the room, so that its known part is seen.
_WALL_RGB = np.array((22, 27, 33), dtype=np.uint8)
_quiet = threading.Lock()


class _LocalViser(viser.ViserServer):
    """A viser server that never opens a tunnel to the outside, whoever asks."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse: recordings stay on this machine."""
        return None


@contextlib.contextmanager
def _no_banner() -> Iterator[None]:
    """Keep standard output clean: viser prints its address and its end even with `verbose=False`."""
    with _quiet, contextlib.redirect_stdout(io.StringIO()):
        yield


class TabScene:
    """Map, trajectory, keyframes, ground truth and the current camera of one tab.

    Args:
        go_to: called with a window when a keyframe is clicked.
        dragged: called with position (3,) and quaternion wxyz (4,) of the camera that is tried, when it was moved.
    """

    def __init__(
        self,
        go_to: Callable[[int], None],
        dragged: Callable[[NDArray[np.float64], NDArray[np.float64]], None] = lambda position, wxyz: None,
    ) -> None:
        self.key = secrets.token_urlsafe(32)
        self._go_to = go_to
        self._lock = threading.RLock()
        self._layers: dict[str, bool] = dict.fromkeys(LAYERS, True)
        self._handles: dict[str, Any] = {}
        self._shown: ShownSession | None = None
        self._map: int | None = None
        self._map_at = self._image_at = 0.0
        self._image: tuple[int, str] | None = None
        self._keyframe_windows: list[int] = []
        self._truth_windows = -1
        with _no_banner():
            self._server = _LocalViser(host="127.0.0.1", port=0, verbose=False)
        self.port = self._server.get_port()
        self._refuse_strangers()
        self._server.scene.set_up_direction("-y")
        self._server.scene.world_axes.visible = False
        self._server.scene.configure_environment_map(hdri=None)
        self._server.scene.set_background_image(np.full((2, 2, 3), BACKGROUND, dtype=np.uint8), format="png")
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.main_panel.minimize()
        self._server.initial_camera.position = (0.7, -0.6, -1.1)
        self._server.initial_camera.look_at = (0.0, 0.0, 0.7)
        self._server.initial_camera.fov = _FOV_RAD
        self._registration = RegistrationScene(self._server)
        self.trial = TrialScene(self._server, self._lock, dragged)
        self.compared = ComparedScene(self._server, self._lock)

    def open(self, shown: ShownSession) -> None:
        """Show a session from its first window on."""
        with self._lock, self._server.atomic():
            for handle in self._handles.values():
                handle.remove()
            self._handles.clear()
            self.trial.clear()
            self.compared.show((), None)
            self._shown, self._map, self._image = shown, None, None
            self._keyframe_windows, self._truth_windows = [], -1
            self._registration.open(shown.registration)
            self._look(shown)
            self._grow(shown)
        self._server.flush()

    def grow(self, shown: ShownSession) -> None:
        """Show what was added to a live session."""
        with self._lock:
            if self._shown is shown:
                with self._server.atomic():
                    self._grow(shown)
                    if time.monotonic() - self._map_at >= _MAP_EVERY_S:
                        self._show_map(shown)
                self._server.flush()

    def show(self, drawn: Drawn) -> None:
        """Move the frustum to a window; its image and the map follow as often as a page can take them."""
        with self._lock:
            shown = drawn.seek.shown
            if self._shown is not shown:
                return
            now = time.monotonic()
            with self._server.atomic():
                self._move_frustum(shown, drawn.seek.window)
                if now - self._image_at >= _IMAGE_EVERY_S:
                    self._show_image(drawn)
                if now - self._map_at >= _MAP_EVERY_S:
                    self._show_map(shown)
            self._server.flush()

    def settle(self, drawn: Drawn) -> None:
        """Bring pose, image and map up to date: the playhead rests on this window."""
        with self._lock:
            shown, window = drawn.seek.shown, drawn.seek.window
            if self._shown is not shown:
                return
            with self._server.atomic():
                self._move_frustum(shown, window)
                self._registration.move(shown.registration, window)
                self._show_image(drawn)
                self._show_map(shown)
            self._server.flush()

    def set_layers(self, layers: dict[str, bool]) -> None:
        """Show or hide layers by name; unknown names are ignored."""
        with self._lock:
            self._layers |= {name: bool(on) for name, on in layers.items() if name in self._layers}
            for name, handle in self._handles.items():
                handle.visible = self._layers[name]
            self._registration.set_layers(self._layers)

    def as_page(
        self, shown: ShownSession, windows: Sequence[int], step_s: float, progress: Callable[[float], None]
    ) -> str:
        """Return the open session as an HTML page of its own, in which the camera flies through windows.

        Args:
            shown: the session that is open.
            windows: where the camera stands at each step.
            step_s: seconds between them.
            progress: called with the share that is done, 0 to 1.
        """
        with self._lock:
            self._show_map(shown)
            self._move_frustum(shown, windows[0])
            film = self._server.get_scene_serializer()
            for step, window in enumerate(windows):
                self._move_frustum(shown, window)
                film.insert_sleep(step_s)
                if step % 50 == 0:
                    progress(min(0.9, step / len(windows)))
            return film.as_html(dark_mode=True)

    def stop(self) -> None:
        """Stop the viser server and its threads."""
        with _no_banner():
            self._server.stop()

    def _refuse_strangers(self) -> None:
        """Close connections without the key: any page of a browser can open a websocket to a loopback port."""
        infra = self._server._websock_server

        @infra.on_client_connect
        async def _(connection: Any) -> None:
            socket = infra._live_connections[connection.client_id]
            request = socket.request
            given = "" if request is None else request.headers.get(KEY_HEADER, "")
            if not secrets.compare_digest(given.encode(), self.key.encode()):
                _log.warning("refused a connection to the 3-D scene that did not come through the gateway")
                await socket.close(1008, "not allowed")

    def _grow(self, shown: ShownSession) -> None:
        self._draw_trajectory(shown)
        self._draw_keyframes(shown)
        self._draw_truth(shown)

    def _look(self, shown: ShownSession) -> None:
        """Look at the wall from behind the cameras, from the side, so that depth is seen."""
        position, look_at = geometry3d.viewpoint(shown.poses())
        self._server.initial_camera.position, self._server.initial_camera.look_at = position, look_at
        for client in self._server.get_clients().values():
            client.camera.up_direction = (0.0, -1.0, 0.0)
            client.camera.fov = _FOV_RAD
            client.camera.position, client.camera.look_at = position, look_at

    def _draw_trajectory(self, shown: ShownSession) -> None:
        points, colours = geometry3d.status_path(shown.poses(), shown.statuses())
        self._replace_lines("trajectory", points, colours, 3.0)

    def _draw_truth(self, shown: ShownSession) -> None:
        # The truth is laid on the estimate: it moves a little with each window of a live session.
        if not shown.has_truth or self._truth_windows == shown.window_count:
            return
        truth = shown.errors().truth_world
        if truth is not None:
            self._truth_windows = shown.window_count
            first, last = shown.session.header.first_us, shown.session.header.last_us
            inside = (truth.t_us >= first) & (truth.t_us <= last)
            points = geometry3d.path(truth.positions[inside], geometry3d.MAX_TRUTH_SEGMENTS)
            self._replace_lines("truth", points, geometry3d.line_rgb(_TRUTH_RGB), 1.5)

    def _draw_keyframes(self, shown: ShownSession) -> None:
        every = shown.keyframes
        keyframes = [every[k] for k in geometry3d.thinned(len(every), geometry3d.MAX_KEYFRAMES)]
        windows = [k.window for k in keyframes]
        if windows == self._keyframe_windows:
            return
        self._keyframe_windows = windows
        poses = shown.poses()
        Ts = np.stack([poses[k.window] if k.window < len(poses) else k.T_world_camera for k in keyframes])
        vertices, faces = geometry3d.pyramid(shown.session.header.camera, 0.04)
        handle = self._server.scene.add_batched_meshes_simple(
            "/keyframes",
            vertices,
            faces,
            batched_wxyzs=geometry3d.quaternions(Ts),
            batched_positions=Ts[:, :3, 3],
            batched_colors=_KEYFRAME_RGB,
            side="double",
            flat_shading=True,
            cast_shadow=False,
            receive_shadow=False,
            lod="off",
            visible=self._layers["keyframes"],
        )
        self._handles["keyframes"] = handle

        @handle.on_click
        def _(event: Any) -> None:
            if event.instance_index is not None and 0 <= event.instance_index < len(windows):
                self._go_to(windows[event.instance_index])

    def _replace_lines(
        self,
        layer: str,
        points: NDArray[np.float32],
        colours: NDArray[np.uint8] | tuple[int, int, int],
        thickness_px: float,
    ) -> None:
        if len(points):
            self._handles[layer] = self._server.scene.add_line_segments(
                f"/{layer}",
                points,
                colours,
                thickness=thickness_px,
                thickness_units="screen",
                visible=self._layers[layer],
            )

    def _move_frustum(self, shown: ShownSession, window: int) -> None:
        T = shown.poses()[window]
        if not np.all(np.isfinite(T)):
            return
        self.compared.move(shown.result(window).start_us)
        wxyz, position = geometry3d.quaternions(T[None])[0], T[:3, 3]
        frustum = self._handles.get("frustum")
        if frustum is None:
            camera = shown.session.header.camera
            fov, aspect = geometry3d.field_of_view(camera)
            self._handles["frustum"] = self._server.scene.add_camera_frustum(
                "/frustum",
                fov,
                aspect,
                scale=0.16,
                thickness=2.0,
                thickness_units="screen",
                color=_FRUSTUM_RGB,
                format="png",
                wxyz=wxyz,
                position=position,
                cast_shadow=False,
                receive_shadow=False,
                visible=self._layers["frustum"],
            )
        else:
            frustum.wxyz, frustum.position = wxyz, position

    def _show_image(self, drawn: Drawn) -> None:
        frustum = self._handles.get("frustum")
        chosen = sorted(
            drawn.images, key=lambda image: (image.kind != ImageKind.WARPED, image.kind != ImageKind.RAW)
        )
        chosen = [image for image in chosen if image.kind != ImageKind.TEXTURE]
        if frustum is None or not chosen:
            return
        shown = (drawn.seek.window, str(drawn.seek.options) + chosen[0].kind)
        if self._image != shown:
            self._image, self._image_at = shown, time.monotonic()
            frustum.image = geometry3d.thumbnail(chosen[0].data)

    def _show_map(self, shown: ShownSession) -> None:
        """Show the newest map: trajectory and frustum are as refined with it, whatever window they stand at."""
        number = shown.map_now()
        if number == self._map:
            return
        revision = shown.newest_map()
        self._map, self._map_at = number, time.monotonic()
        if revision is None:
            if (old := self._handles.pop("map", None)) is not None:
                old.remove()
            return
        self._draw_map(revision)

    def _draw_map(self, revision: MapRevision) -> None:
        width, height, position, wxyz = geometry3d.map_image_pose(revision)
        texture = np.maximum(texture_picture(revision).rgb(), _WALL_RGB)
        shrink = geometry3d.MAX_TEXTURE_PX / max(texture.shape[:2])
        if shrink < 1:
            texture = cv2.resize(texture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        self._handles["map"] = self._server.scene.add_image(
            "/map",
            np.asarray(texture, dtype=np.uint8),
            width,
            height,
            format="png",
            wxyz=wxyz,
            position=position,
            cast_shadow=False,
            receive_shadow=False,
            visible=self._layers["map"],
        )
