"""A registration of frames as a rerun recording: images, depth, matches, points, all trajectories, all errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from dvsviz.errors import EvaluationError
from dvsviz.evaluate.chart import PALETTE
from dvsviz.export.entities import TRUTH_RGB, Moments
from dvsviz.export.rrd_file import RrdFile
from dvsviz.geometry import se3
from dvsviz.session.registration import RegistrationRecord, StoredRun

Array = NDArray[np.float64]

INLIER_RGB, OUTLIER_RGB = (0, 200, 140), (240, 100, 20)
# The column of `StoredRun.errors`, and its title.
ERRORS = {
    "relative_rotation": "Relative rotation error (rad)",
    "relative_translation": "Relative translation error (m)",
    "absolute_rotation": "Absolute rotation error (rad)",
    "absolute_translation": "Absolute translation error (m)",
}


def export_registration(
    record: RegistrationRecord, out: Path, progress: Callable[[float], None] | None = None
) -> None:
    """Write a registration as a rerun recording; the scene's world is the first frame's camera, in metres.

    Args:
        record: what is written.
        out: the .rrd file; replaced where it exists.
        progress: called with the share that is done, 0 to 1.

    Raises:
        DvsvizError: the file cannot be written.
    """
    run = record.shown_run
    same = [other for other in record.runs if other.skip == run.skip and other.name != "none"]
    file = RrdFile(out, _blueprint(record), name=f"{record.source.name}: {run.name}, skip {run.skip}")
    try:
        _send_still(file.stream, record, same)
        moments = _moments(run, np.arange(len(run.t_us)))
        _send_poses(file.stream, record, moments)
        _send_errors(file.stream, run, same)
        for k in range(len(record.frames)):
            _send_step(file.stream, record, k)
            if progress is not None:
                progress((k + 1) / len(record.frames))
        steps = len(record.steps)
        expected = {"world/camera": steps + 1, "world/camera/image": steps + 1, "world/points": steps}
        file.finish(expected | {"world/camera/inliers": steps, "world/camera/outliers": steps})
    except BaseException:
        file.abandon()
        raise


def truth_in_world(record: RegistrationRecord) -> Array | None:
    """Return the true positions (N, 3) while frames were registered, in the world of the first one; None without."""
    run, truth = record.shown_run, record.truth
    if truth is None or not truth.covers(run.t_us[:1])[0]:
        return None
    first = se3.inverse(truth.at(run.t_us[:1]).Ts_world_camera[0])
    inside = (truth.t_us >= run.t_us[0]) & (truth.t_us <= run.t_us[-1])
    return (first @ truth.Ts_world_camera[inside])[:, :3, 3]


def method_rgb(runs: list[StoredRun]) -> dict[str, tuple[int, int, int]]:
    """Return a colour for each run's name, the same in all pictures; lighter than on paper: the ground is dark."""
    names = list(dict.fromkeys(run.name for run in runs))
    return {name: _light(PALETTE[k % len(PALETTE)]) for k, name in enumerate(names)}


def _light(rgb: tuple[int, int, int]) -> tuple[int, int, int]:
    r, g, b = (round(value + 0.3 * (255 - value)) for value in rgb)
    return r, g, b


def _moments(run: StoredRun, index: NDArray[np.int64]) -> Moments:
    return Moments(window=index.astype(np.int64), t_us=run.t_us[index] - run.t_us[0])


def _send_still(stream: rr.RecordingStream, record: RegistrationRecord, runs: list[StoredRun]) -> None:
    camera = record.camera
    K = camera.matrix.copy()
    # Our (0, 0) is the centre of the first pixel, rerun's its corner.
    K[:2, 2] += 0.5
    stream.log("world", rr.ViewCoordinates.RDF, static=True)
    pinhole = rr.Pinhole(
        image_from_camera=K,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.25,
        color=(200, 205, 212),
        line_width=0.003,
    )
    stream.log("world/camera", pinhole, static=True)
    truth = truth_in_world(record)
    if truth is not None:
        stream.log("world/ground_truth", rr.LineStrips3D([truth], colors=[TRUTH_RGB], radii=[0.004]), static=True)
    colours = method_rgb(list(record.runs))
    for run in runs:
        line = rr.LineStrips3D([run.Ts_world_camera[:, :3, 3]], colors=[colours[run.name]], radii=[0.003])
        stream.log(f"world/methods/{_entity(run.name)}", line, static=True)
        for kind in ERRORS:
            series = rr.SeriesLines(names=run.name, colors=colours[run.name], widths=1.5)
            stream.log(f"plots/{kind}/{_entity(run.name)}", series, static=True)


def _send_poses(stream: rr.RecordingStream, record: RegistrationRecord, moments: Moments) -> None:
    Ts = record.shown_run.Ts_world_camera
    quaternions = se3.xyzw_from_wxyz(se3.quaternion_from_rotation(Ts[:, :3, :3]))
    columns = rr.Transform3D.columns(translation=Ts[:, :3, 3], quaternion=quaternions)
    stream.send_columns("world/camera", indexes=moments.columns(), columns=list(columns))


def _send_errors(stream: rr.RecordingStream, shown: StoredRun, runs: list[StoredRun]) -> None:
    for run in runs:
        # Runs of one skip have the same frames.
        if len(run.t_us) != len(shown.t_us):
            raise EvaluationError(f"{run.name} has other frames than {shown.name} at the same skip")
        for column, kind in enumerate(ERRORS):
            known = np.flatnonzero(np.isfinite(run.errors[:, column]))
            if len(known):
                stream.send_columns(
                    f"plots/{kind}/{_entity(run.name)}",
                    indexes=_moments(run, known + 1).columns(),
                    columns=list(rr.Scalars.columns(scalars=run.errors[known, column])),
                )


def _send_step(stream: rr.RecordingStream, record: RegistrationRecord, k: int) -> None:
    run, frame = record.shown_run, record.frames[k]
    stream.set_time("window", sequence=k)
    stream.set_time("time", duration=float(run.t_us[k] - run.t_us[0]) * 1e-6)
    stream.log("world/camera/image", rr.EncodedImage(contents=frame.grey, media_type="image/jpeg"))
    if frame.depth is not None:
        depth = rr.EncodedDepthImage(blob=frame.depth, media_type="image/png", meter=1000.0)
        stream.log("world/camera/depth", depth)
    if k == 0:
        return
    step = record.steps[k - 1]
    for name, mask, rgb in (("inliers", step.is_inlier, INLIER_RGB), ("outliers", ~step.is_inlier, OUTLIER_RGB)):
        lines = np.stack([step.pixels_a[mask], step.pixels_b[mask]], axis=1) + 0.5
        stream.log(f"world/camera/{name}", rr.LineStrips2D(list(lines), colors=[rgb], radii=[0.7]))
    T = run.Ts_world_camera[k]
    points = step.points @ T[:3, :3].T + T[:3, 3]
    stream.log("world/points", rr.Points3D(points, colors=[INLIER_RGB], radii=[0.006]))


def _blueprint(record: RegistrationRecord) -> rrb.Blueprint:
    ground = [13, 16, 20]
    everything = rrb.TimeRangeBoundary.infinite()
    ranges = [rrb.VisibleTimeRange(line, start=everything, end=everything) for line in ("window", "time")]
    scene = rrb.Spatial3DView(
        origin="world",
        name="Scene (metres)",
        background=ground,
        line_grid=False,
        contents=["$origin/**", "- /world/camera/inliers", "- /world/camera/outliers"],
        overrides={"world/points": [rrb.VisibleTimeRanges(ranges)]},
    )
    images = [rrb.Spatial2DView(
        origin="world/camera",
        name="Matches (green: inliers, orange: outliers)",
        contents=["$origin/image", "$origin/inliers", "$origin/outliers"],
        background=ground,
    )]  # fmt: skip
    if any(frame.depth is not None for frame in record.frames):
        images.append(rrb.Spatial2DView(origin="world/camera/depth", name="Depth", background=ground))
    plots = [rrb.TimeSeriesView(origin=f"plots/{kind}", name=title) for kind, title in ERRORS.items()]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(scene, rrb.Vertical(*images), column_shares=[2, 1]),
            rrb.Horizontal(*plots),
            row_shares=[2.4, 1],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="window"),
        auto_views=False,
        auto_layout=False,
    )


def _entity(name: str) -> str:
    return name.replace(" (", "_").replace(")", "").replace("+", "_").replace("-", "_")
