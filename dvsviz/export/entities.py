"""A run as rerun entities: one code for exports of finished sessions and for logging while a run goes on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from dvsviz.export.frames import MAP_CANVAS_PX, map_png
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import rotation_to_map
from dvsviz.session.records import STATUSES, LogEntry, MapRevision, Status

Array = NDArray[np.float64]

# Okabe-Ito, as in the dashboard.
STATUS_RGB: dict[Status, tuple[int, int, int]] = {
    Status.INITIALIZING: (153, 153, 153),
    Status.TRACKING: (0, 158, 115),
    Status.WEAK: (230, 159, 0),
    Status.LOST: (213, 94, 0),
    Status.RELOCALIZING: (86, 180, 233),
}
TRUTH_RGB = (204, 121, 167)
KEYFRAME_RGB = (240, 228, 66)
PLOTS: dict[str, tuple[str, tuple[int, int, int]]] = {
    "contrast_gain": ("contrast gain (×)", (86, 180, 233)),
    "overlap": ("overlap (0–1)", (0, 158, 115)),
    "event_rate": ("event rate (1/s)", (230, 159, 0)),
    "error": ("position error (% of distance)", TRUTH_RGB),
}
_LEVELS = {"info": rr.TextLogLevel.INFO, "warning": rr.TextLogLevel.WARN, "error": rr.TextLogLevel.ERROR}
# In plane distances: large enough to see the frame, small enough not to hide the map.
_FRUSTUM_DEPTH = 0.3
_HIDDEN = (0, 0, 0, 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moments:
    """Windows and their times: what every row is bound to.

    Attributes:
        window: window numbers (N,).
        t_us: microseconds since the recording's first event (N,), int64.
    """

    window: NDArray[np.int64]
    t_us: NDArray[np.int64]

    def columns(self) -> list[rr.TimeColumn]:
        """Return the two timelines, `window` and `time`."""
        return [
            rr.TimeColumn("window", sequence=self.window),
            rr.TimeColumn("time", duration=self.t_us.astype("timedelta64[us]")),
        ]


class Entities:
    """Sends a run to a recording stream; rows may come in any number of portions."""

    def __init__(self, stream: rr.RecordingStream, camera: Camera) -> None:
        """Send what does not change."""
        self._stream = stream
        self._status: int | None = None
        self._position: Array | None = None
        stream.log("world", rr.ViewCoordinates.RDF, static=True)
        stream.log(
            "world/camera",
            rr.Pinhole(
                image_from_camera=_shifted(camera.matrix),
                resolution=[camera.width, camera.height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=_FRUSTUM_DEPTH,
                color=(200, 205, 212),
                line_width=0.003,
            ),
            static=True,
        )
        stream.log("world/map", rr.Pinhole.from_fields(color=_HIDDEN, line_width=0.0), static=True)
        stream.log(
            "state",
            rr.StateConfiguration(
                values=[status.value for status in STATUSES],
                labels=[status.value for status in STATUSES],
                colors=[STATUS_RGB[status] for status in STATUSES],
            ),
            static=True,
        )
        for name, (label, rgb) in PLOTS.items():
            stream.log(f"plots/{name}", rr.SeriesLines(names=label, colors=rgb, widths=1.5), static=True)

    def windows(
        self, moments: Moments, Ts_world_camera: Array, status: NDArray[np.uint8], plots: dict[str, Array]
    ) -> None:
        """Send poses (N, 4, 4), statuses (N,) and plotted numbers (N,) of consecutive windows."""
        if len(moments.window) == 0:
            return
        positions = Ts_world_camera[:, :3, 3]
        quaternions = se3.quaternion_from_rotation(Ts_world_camera[:, :3, :3])
        self._send(
            "world/camera",
            moments,
            rr.Transform3D.columns(translation=positions, quaternion=se3.xyzw_from_wxyz(quaternions)),
        )
        before = positions[:1] if self._position is None else self._position[None]
        starts = np.concatenate([before, positions[:-1]])
        colors = np.array([STATUS_RGB[STATUSES[s]] for s in status], dtype=np.uint8)
        self._send(
            "world/trajectory",
            moments,
            rr.LineStrips3D.columns(
                strips=list(np.stack([starts, positions], axis=1)),
                colors=colors,
                radii=np.full(len(status), 0.004),
            ),
        )
        for name, values in plots.items():
            known = np.isfinite(values)
            self._send(f"plots/{name}", _some(moments, known), rr.Scalars.columns(scalars=values[known]))
        last = np.concatenate([[-1 if self._status is None else self._status], status[:-1]])
        changed = status != last
        names = [STATUSES[s].value for s in status[changed]]
        self._send("state", _some(moments, changed), rr.StateChange.columns(state=names))
        self._status, self._position = int(status[-1]), positions[-1]

    def frames(self, moments: Moments, pngs: Sequence[bytes]) -> None:
        """Send the camera's images."""
        blobs = [np.frombuffer(png, np.uint8) for png in pngs]
        self._send(
            "world/camera/image",
            moments,
            rr.EncodedImage.columns(blob=blobs, media_type=["image/png"] * len(blobs)),
        )

    def map(self, moments: Moments, revisions: Sequence[MapRevision]) -> None:
        """Send the map's textures, each on its plane.

        A texture is drawn as the image of a camera that looks at the plane from one plane distance away, upright:
        unlit and compressed, which a textured mesh is not.
        """
        if not revisions:
            return
        K, position, quaternion, blobs = [], [], [], []
        for revision in revisions:
            rows, columns = revision.texture.shape
            png, scale = map_png(revision.texture)
            R_world_map = rotation_to_map(revision.normal_world).T
            focal_px = scale * revision.px_per_unit * revision.distance
            # The camera stands over the middle of the texture, which is the middle of the canvas.
            centre = revision.origin + np.array([columns - 1, rows - 1]) / 2 / revision.px_per_unit
            K.append([[focal_px, 0, MAP_CANVAS_PX / 2], [0, focal_px, MAP_CANVAS_PX / 2], [0, 0, 1]])
            position.append(R_world_map @ [*centre, 0.0])
            quaternion.append(se3.xyzw_from_wxyz(se3.quaternion_from_rotation(R_world_map)))
            blobs.append(np.frombuffer(png, np.uint8))
        self._send(
            "world/map",
            moments,
            rr.Transform3D.columns(translation=position, quaternion=quaternion),
            rr.Pinhole.columns(
                image_from_camera=np.array(K),
                resolution=np.full((len(K), 2), MAP_CANVAS_PX, dtype=np.float32),
                image_plane_distance=[revision.distance for revision in revisions],
            ),
            rr.EncodedImage.columns(blob=blobs, media_type=["image/png"] * len(blobs)),
        )

    def keyframes(self, moments: Moments, positions: Array, numbers: Iterable[int]) -> None:
        """Send keyframes' positions (N, 3)."""
        self._send(
            "world/keyframes",
            moments,
            rr.Points3D.columns(
                positions=positions,
                radii=np.full(len(positions), 0.012),
                colors=[KEYFRAME_RGB] * len(positions),
                labels=[f"keyframe {number}" for number in numbers],
                show_labels=[False] * len(positions),
            ),
        )

    def log(self, moments: Moments, entries: Sequence[LogEntry]) -> None:
        """Send lines of the log."""
        self._send(
            "log",
            moments,
            rr.TextLog.columns(
                text=[entry.text for entry in entries],
                level=[_LEVELS.get(entry.level, rr.TextLogLevel.INFO) for entry in entries],
            ),
        )

    def truth(self, positions: Array) -> None:
        """Send the true path (N, 3), laid into the session's world."""
        line = rr.LineStrips3D([positions], colors=[TRUTH_RGB], radii=[0.003])
        self._stream.log("world/ground_truth", line, static=True)

    def _send(self, name: str, moments: Moments, *columns: Iterable[rr.ComponentColumn]) -> None:
        if len(moments.window):
            self._stream.send_columns(
                name, indexes=moments.columns(), columns=[column for part in columns for column in part]
            )


def _some(moments: Moments, mask: NDArray[np.bool_]) -> Moments:
    return Moments(window=moments.window[mask], t_us=moments.t_us[mask])


def _shifted(K: Array) -> Array:
    # Our (0, 0) is the centre of the first pixel, rerun's its corner.
    K = K.copy()
    K[..., :2, 2] += 0.5
    return K
