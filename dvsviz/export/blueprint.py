"""How a rerun recording opens: the scene large, images beside it, state and plots over the full width."""

from __future__ import annotations

import rerun.blueprint as rrb
from rerun.blueprint.components import AbsoluteTimeRange
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind

_EVERYTHING = rrb.TimeRangeBoundary.infinite()


def blueprint(
    *,
    has_truth: bool,
    target: tuple[float, float, float] = (0.0, 0.0, 0.7),
    reach: float = 1.1,
    live: bool = False,
    windows: tuple[int, int] | None = None,
) -> rrb.Blueprint:
    """Return the layout.

    Args:
        has_truth: whether there is an error to plot.
        target: point of the world (x, y, z) that the scene's eye looks at, plane distances.
        reach: from there to the farthest thing to be seen, plane distances.
        live: the newest window is followed.
        windows: first and last window that are marked on the time line.
    """
    # From behind the camera's left shoulder: the frustum, the path and the map beside each other.
    eye = tuple(at + reach * away for at, away in zip(target, (-0.68, -0.48, -1.12), strict=True))
    everything = [
        rrb.VisibleTimeRange(timeline, start=_EVERYTHING, end=_EVERYTHING) for timeline in ("window", "time")
    ]
    path = rrb.VisibleTimeRanges(everything)
    scene = rrb.Spatial3DView(
        origin="world",
        name="Scene (unit: plane distance)",
        background=[13, 16, 20],
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0.0, -1.0, 0.0)),
        overrides={"world/trajectory": [path], "world/keyframes": [path]},
    )
    images = rrb.Vertical(
        rrb.Spatial2DView(origin="world/camera", name="Warped window", background=[13, 16, 20]),
        rrb.Spatial2DView(origin="world/map", name="Map", background=[13, 16, 20]),
    )
    names = ["contrast_gain", "overlap", "event_rate"] + (["error"] if has_truth else [])
    titles = {
        "contrast_gain": "Contrast gain",
        "overlap": "Overlap",
        "event_rate": "Event rate (1/s)",
        "error": "Error (% of plane distance)",
    }
    legend = rrb.PlotLegend(visible=False)
    plots = [rrb.TimeSeriesView(origin=f"plots/{n}", name=titles[n], plot_legend=legend) for n in names]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(scene, images, column_shares=[3, 1]),
            rrb.StateTimelineView(origin="state", name="State"),
            rrb.Horizontal(*plots, _log(), column_shares=[1] * len(plots) + [1.3]),
            row_shares=[5.2, 0.9, 1.9],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed" if windows is None else "expanded",
            timeline="window",
            play_state="following" if live else None,
            time_selection=None if windows is None else AbsoluteTimeRange(min=windows[0], max=windows[1]),
        ),
        auto_views=False,
        auto_layout=False,
    )


def _log() -> rrb.TextLogView:
    kinds = [TextLogColumn(TextLogColumnKind.LogLevel), TextLogColumn(TextLogColumnKind.Body)]
    return rrb.TextLogView(origin="log", name="Log", columns=rrb.TextLogColumns(text_log_columns=kinds))
