"""Plots of a study: errors over time, trajectories from above, errors against the frame skip."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import DvsvizError
from dvsviz.evaluate.chart import PALETTE, TRUTH, Chart, Line, Rgb, to_png, to_svg
from dvsviz.registration.frames import FrameSequence
from dvsviz.registration.study import StudyRun

Array = NDArray[np.float64]


def write_plots(folder: Path, sequence: FrameSequence, runs: Sequence[StudyRun], *, title: str = "") -> list[Path]:
    """Write `errors-skip-N`, `trajectories-skip-N` for each skip and `skips`, each as SVG and PNG; return the files.

    Args:
        folder: made where it is missing.
        sequence: the frames, with ground truth.
        runs: of `study`.
        title: what was registered.

    Raises:
        DvsvizError: there is no ground truth to plot against, or the folder cannot be written.
    """
    if sequence.ground_truth is None:
        raise DvsvizError("plots need ground truth", hint="these frames have none: leave out the plots")
    colours = _colours(runs)
    made: dict[str, tuple[list[Chart], int]] = {}
    steps = {run.row.skip: len(run.odometry.frames) for run in runs}
    for skip in steps:
        part = [run for run in runs if run.row.skip == skip]
        name = f"{title}, skip {skip}".strip(", ")
        made[f"errors-skip-{skip}"] = (error_charts(part, colours, name), 250)
        made[f"trajectories-skip-{skip}"] = (trajectory_charts(sequence, part, colours, name), 420)
    if len(steps) > 1:
        made["skips"] = (skip_charts(runs, colours, title), 300)
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, (charts, height) in made.items():
            svg, png = folder / f"{name}.svg", folder / f"{name}.png"
            svg.write_text(to_svg(charts, height=height), encoding="utf-8")
            png.write_bytes(to_png(charts, height=height))
            written += [svg, png]
    except OSError as error:
        raise DvsvizError(f"cannot be written: {error.strerror}", path=folder, hint="check the folder") from error
    return written


def error_charts(runs: Sequence[StudyRun], colours: dict[str, Rgb], title: str) -> list[Chart]:
    """Return four charts of one skip: relative and absolute errors of rotation and translation over time."""
    charts = []
    for kind in ("relative", "absolute"):
        for quantity, unit in (("rotation", "rad"), ("translation", "m")):
            lines = []
            for run in runs:
                errors = run.relative if kind == "relative" else run.absolute
                if errors is not None:
                    t_us = run.odometry.trajectory.t_us
                    values = errors.rotation_rad if quantity == "rotation" else errors.translation_m
                    t_s = (t_us[1:] - t_us[0]) * 1e-6
                    lines.append(Line(name=_name(run), x=t_s, y=values, rgb=colours[_name(run)]))
            charts.append(
                Chart(
                    title=f"{title}: {kind} {quantity} error",
                    x_label="time (s)",
                    y_label=f"{quantity} error ({unit})",
                    lines=tuple(lines),
                    log_y=True,
                )
            )
    return charts


def trajectory_charts(
    sequence: FrameSequence, runs: Sequence[StudyRun], colours: dict[str, Rgb], title: str
) -> list[Chart]:
    """Return the trajectories of one skip seen along the axis in which the truth moves least, and from the side."""
    truth = sequence.ground_truth
    if truth is None or not runs:
        return []
    axes = np.argsort(-np.ptp(truth.positions, axis=0))
    names = [("x", "y", "z")[int(axis)] for axis in axes]
    frames_us = runs[0].odometry.trajectory.t_us
    inside = (truth.t_us >= frames_us[0]) & (truth.t_us <= frames_us[-1])
    charts = []
    for across, up in ((0, 1), (0, 2)):
        p = truth.positions[inside]
        lines = [Line(name="truth", x=p[:, axes[across]], y=p[:, axes[up]], rgb=TRUTH)]
        for run in runs:
            if run.row.method != "none":
                q = placed(sequence, run)
                name = _name(run)
                lines.append(Line(name=name, x=q[:, axes[across]], y=q[:, axes[up]], rgb=colours[name]))
        charts.append(
            Chart(
                title=f"{title}: trajectories",
                x_label=f"{names[across]} (m)",
                y_label=f"{names[up]} (m)",
                lines=tuple(lines),
                equal=True,
            )
        )
    return charts


def skip_charts(runs: Sequence[StudyRun], colours: dict[str, Rgb], title: str) -> list[Chart]:
    """Return the mean relative errors against the frame skip."""
    charts = []
    for quantity, unit in (("rotation", "rad"), ("translation", "m")):
        lines = []
        for name in dict.fromkeys(_name(run) for run in runs):
            rows = sorted((run.row for run in runs if _name(run) == name), key=lambda row: row.skip)
            y = [
                row.relative_rotation_rad if quantity == "rotation" else row.relative_translation_m for row in rows
            ]
            x = np.array([row.skip for row in rows], np.float64)
            lines.append(Line(name=name, x=x, y=np.array(y), rgb=colours[name], marks=True))
        charts.append(
            Chart(
                title=f"{title}: mean relative {quantity} error".strip(": "),
                x_label="frames from one registered frame to the next",
                y_label=f"{quantity} error ({unit})",
                lines=tuple(lines),
                log_y=True,
            )
        )
    return charts


def placed(sequence: FrameSequence, run: StudyRun) -> Array:
    """Return a run's positions (N, 3) in the truth's world, chained from the first true pose.

    Raises:
        ValueError: the sequence has no ground truth.
    """
    if sequence.ground_truth is None:
        raise ValueError("sequence: expected one with ground truth")
    trajectory = run.odometry.trajectory
    first = sequence.ground_truth.at(trajectory.t_us[:1]).Ts_world_camera[0]
    return (first @ trajectory.Ts_world_camera)[:, :3, 3]


def _name(run: StudyRun) -> str:
    return run.row.method if run.row.mode == "frames" else f"{run.row.method} ({run.row.mode})"


def _colours(runs: Sequence[StudyRun]) -> dict[str, Rgb]:
    names = list(dict.fromkeys(_name(run) for run in runs))
    return {name: PALETTE[k % len(PALETTE)] for k, name in enumerate(names)}
