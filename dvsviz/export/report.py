"""A session as one page to send: what was tracked, how well, and each failure with its pictures and its cause.

The page holds everything it shows and asks nothing of a network; it names no folder of the machine it was made on.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from dvsviz import __version__
from dvsviz.errors import DvsvizError
from dvsviz.evaluate.summary import evaluation_of, summarize
from dvsviz.evaluate.tables import ROWS, figure
from dvsviz.export.causes import EXPLANATIONS
from dvsviz.export.curves_svg import Band, Curve, curves_svg
from dvsviz.export.paths_svg import map_svg, view_svg
from dvsviz.export.report_failures import failures_html
from dvsviz.session.records import STATUSES, Cause
from dvsviz.view.shown import ShownSession

_STYLE = Path(__file__).with_name("report.css")
# A page that fetched anything would be stopped by this: it is self-contained or visibly broken.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def write_report(shown: ShownSession, out: Path, progress: Callable[[float], None] = lambda share: None) -> None:
    """Write the report of a session; replaced where it exists.

    Args:
        shown: the session; its recording gives the pictures of the failures.
        out: the HTML file.
        progress: called with the share that is done, 0 to 1.

    Raises:
        DvsvizError: there are no windows, or the file cannot be written.
    """
    text = report_html(shown, progress)
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise DvsvizError(f"cannot be written: {error.strerror}", path=out, hint="check the folder") from error
    progress(1.0)


def report_html(shown: ShownSession, progress: Callable[[float], None] = lambda share: None) -> str:
    """Return the report of a session as one HTML document.

    Raises:
        DvsvizError: there are no windows, or frames were registered instead of events tracked.
    """
    if shown.window_count == 0:
        raise DvsvizError("has no windows", path=shown.session.path, hint="there is nothing to report")
    if shown.registration is not None:
        raise DvsvizError(
            "holds registered frames", path=shown.session.path, hint="reports are made of tracked events"
        )
    session = shown.session
    plotted = {name: np.asarray(values, dtype=np.float64) for name, values in shown.plotted(0).items()}
    count = len(plotted["t_s"])
    status = shown.statuses()[:count]
    found = summarize(status)
    evaluation = evaluation_of(session)
    end_s = (int(session.columns()["end_us"][count - 1]) - session.header.first_us) * 1e-6
    name = escape(shown.name)
    body = [
        _head(shown, found, evaluation, status),
        _tiles(shown, found, evaluation),
        _curves(shown, plotted, end_s, status),
        _trajectory(shown, status),
        failures_html(shown, plotted, end_s, progress),
        '<div class="columns">',
        _evaluation(evaluation),
        _recording(shown),
        "</div>",
        _settings(shown),
        _notes(shown, plotted["t_s"]),
        f"<footer>Written by dvsviz {escape(__version__)}. With the session file at hand, <code>dvsviz serve</code> "
        "shows every window of it.</footer>",
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<link rel="icon" href="data:image/png;base64,iVBORw0KGgo=">'
        f"<title>{name} · tracking report</title><style>{_STYLE.read_text(encoding='utf-8')}</style></head>\n"
        "<body><main>\n" + "\n".join(part for part in body if part) + "\n</main></body></html>\n"
    )


def facts(rows: list[tuple[str, str]]) -> str:
    """Return names and values, which are texts, as a list."""
    return '<dl class="facts">' + "".join(f"<dt>{escape(n)}</dt><dd>{escape(v)}</dd>" for n, v in rows) + "</dl>"


def _head(shown: ShownSession, found: dict[str, Any], evaluation: dict[str, Any] | None, status: np.ndarray) -> str:
    session, header = shown.session, shown.session.header
    state = "" if session.complete else "The session is incomplete: its first part is reported. "
    lost = ["It was never lost", "It was lost once", f"It was lost {found['losses']} times"][
        min(2, found["losses"])
    ]
    causes = [EXPLANATIONS[f.cause].name for f in session.failures if f.cause is not Cause.UNKNOWN]
    common = max(set(causes), key=causes.count) if causes else ""
    why = f", mostly by {escape(common)}" if found["losses"] > 1 and causes.count(common) > 1 else ""
    position = evaluation and evaluation["position_rmse_percent_of_distance"]
    truth = (
        f" Against the ground truth the position is off by {position:.2f} % of the distance to the plane (RMSE)."
        if position is not None and position is not False
        else ""
    )
    tracked = f"{100 * found['tracked_share']:.1f} % of the {len(status):,d} windows were tracked."
    sentence = f"{state}{tracked} {lost}{why}.{truth}"
    place = (
        f"{header.camera.width}×{header.camera.height} px · {header.duration_s:.2f} s · {escape(header.created)}"
    )
    return (
        f'<header><p class="kicker">Tracking report</p><h1>{escape(shown.name)}</h1>'
        f'<p class="dim">{escape(header.recording_name)} · {place}</p><p class="verdict">{sentence}</p></header>'
    )


def _tiles(shown: ShownSession, found: dict[str, Any], evaluation: dict[str, Any] | None) -> str:
    summary = shown.session.summary or {}
    rows = [
        (f"{100 * found['tracked_share']:.1f} %", "of the windows tracked"),
        (f"{found['losses']}", "times lost"),
        (f"{len(shown.keyframes)}", "keyframes"),
    ]
    if evaluation is not None:
        rows.append((figure(evaluation["position_rmse_percent_of_distance"], ".2f", "%"), "position error (RMSE)"))
        rows.append((figure(evaluation["rotation_rmse_deg"], ".2f", "°"), "rotation error (RMSE)"))
    if shown.session.header.events:
        rows.append((_count(shown.session.header.events), "events"))
    if (factor := summary.get("real_time_factor")) is not None:
        rows.append((f"{factor:.2f}×", "real time"))
    tiles = "".join(f"<div><b>{escape(value)}</b><span>{escape(what)}</span></div>" for value, what in rows)
    return f'<div class="tiles">{tiles}</div>'


def _curves(shown: ShownSession, plotted: dict[str, Any], end_s: float, status: np.ndarray) -> str:
    t_s = plotted["t_s"]
    rate = plotted["event_rate_hz"]
    unit, per = ("million/s", 1e6) if np.nanmax(rate) > 1e6 else ("thousand/s", 1e3)
    curves = [
        Curve(name="event rate", unit=unit, values=rate / per, style="events"),
        Curve(name="map score", unit="0 to 1", values=plotted["score"], style="score"),
        Curve(name="overlap", unit="0 to 1", values=plotted["overlap"], style="overlap", top=1.0),
    ]
    if np.isfinite(plotted["error_percent"]).any():
        curves.append(Curve(name="position", unit="error, % of d", values=plotted["error_percent"], style="error"))
    if np.isfinite(plotted["error_deg"]).any():
        curves.append(Curve(name="rotation", unit="error, degrees", values=plotted["error_deg"], style="degrees"))
    bands = [
        Band(
            number=number,
            start_s=float(t_s[min(failure.start, len(t_s) - 1)]),
            end_s=float(t_s[failure.end]) if failure.end < len(t_s) else end_s,
            title=f"Failure {number}: {EXPLANATIONS[failure.cause].name}",
        )
        for number, failure in enumerate(shown.session.failures, 1)
    ]
    return f"<section><h2>Over time</h2>{curves_svg(t_s, end_s, status, curves, bands)}{_legend()}</section>"


def _legend(*more: tuple[str, str]) -> str:
    rows = [*((str(status), str(status)) for status in STATUSES), *more]
    items = "".join(f'<li><i class="i-{style}"></i>{escape(word)}</li>' for style, word in rows)
    return f'<ul class="legend">{items}</ul>'


def _trajectory(shown: ShownSession, status: np.ndarray) -> str:
    Ts = shown.poses()[: len(status)]
    x, y, z = Ts[:, :3, 3].T
    errors = shown.errors().truth_world if shown.has_truth else None
    truth: list[Any] = [None, None, None]
    if errors is not None:
        first, last = shown.session.header.first_us, shown.session.header.last_us
        inside = (errors.t_us >= first) & (errors.t_us <= last)
        truth = list(errors.positions[inside].T)
    metres = shown.session.header.mean_plane_distance
    keyframes = [k.window for k in shown.keyframes]
    top = view_svg(
        "From the top", ("x", x, truth[0]), ("z", z, truth[2]), status, keyframes, metres, upward=True
    ).replace("clip-the", "clip-top")
    side = view_svg("From the side", ("z", z, truth[2]), ("y", y, truth[1]), status, keyframes, metres).replace(
        "clip-the", "clip-side"
    )
    revision = shown.newest_map()
    over = "" if revision is None else map_svg(revision, Ts[:, :3, 3], status, metres)
    words = (
        '<p class="dim">The newest map with the camera\'s path laid onto its plane, and the path from two sides: x to '
        "the right, y down, z forward as the first camera had them. d is the distance of the plane from the first "
        "camera.</p>"
    )
    more = [("keyframe", "keyframe")] + ([("truth", "ground truth")] if truth[0] is not None else [])
    return (
        f"<section><h2>Map and trajectory</h2>{words}{over}"
        f'<div class="views">{top}{side}</div>{_legend(*more)}</section>'
    )


def _evaluation(evaluation: dict[str, Any] | None) -> str:
    if evaluation is None:
        why = '<p class="dim">No ground truth, or too little of it was tracked.</p>'
        return f"<section><h2>Against the ground truth</h2>{why}</section>"
    rows = "".join(
        f'<tr><td>{escape(name.strip())}</td><td class="figure">{escape(figure(evaluation[key], spec, unit))}</td></tr>'
        for name, key, spec, unit in ROWS
    )
    return f"<section><h2>Against the ground truth</h2><table>{rows}</table></section>"


def _recording(shown: ShownSession) -> str:
    header = shown.session.header
    c = header.camera
    start_s, end_s = header.part_s
    rows = [
        ("recording", f"{header.recording_name} ({header.recording_format})"),
        ("sensor", f"{c.width}×{c.height} px"),
        ("focal length", f"{c.fx:.2f}, {c.fy:.2f} px" + (" (a guess)" if c.is_guess else "")),
        ("principal point", f"{c.cx:.2f}, {c.cy:.2f} px"),
        ("distortion", ", ".join(f"{value:.4g}" for value in c.distortion) if any(c.distortion) else "none"),
        ("tracked", f"{start_s:.2f} to {end_s:.2f} s"),
        ("events", f"{header.events:,d}"),
        ("windows", f"{shown.window_count:,d}"),
        ("plane distance", figure(header.mean_plane_distance, ".4g", "m")),
        ("tracked with", f"dvsviz {header.program_version}"),
    ]
    guess = (
        '<p class="warning">The calibration is a guess. A wrong focal length is the commonest cause of drift.</p>'
        if c.is_guess
        else ""
    )
    return f"<section><h2>Recording</h2>{facts(rows)}{guess}</section>"


def _settings(shown: ShownSession) -> str:
    header = shown.session.header
    config: dict[str, Any] = json.loads(header.config_json)
    rows = [(name.replace("_", " "), _word(value)) for name, value in config.items()]
    if header.filters_json is not None:
        rows += [
            (f"filter: {name}".replace("_", " "), _word(v)) for name, v in json.loads(header.filters_json).items()
        ]
    if header.origin is not None:
        changes = ", ".join(f"{name}: {a} → {b}" for name, (a, b) in header.origin.changes.items())
        rows.append(
            (
                "tried again",
                f"{header.origin.session} from window {header.origin.window}; {changes or 'same settings'}",
            )
        )
    if shown.session.tags:
        rows.append(("tags", ", ".join(shown.session.tags)))
    return f"<section><h2>Settings</h2>{facts(rows)}</section>"


def _notes(shown: ShownSession, t_s: np.ndarray) -> str:
    marks = [(mark.window, mark.text or "bookmark") for mark in shown.session.bookmarks]
    marks = [(window, text) for window, text in marks if window < len(t_s)]
    if not marks:
        return ""
    rows = "".join(
        f"<tr><td>{t_s[window]:.3f} s</td><td>{window}</td><td>{escape(text)}</td></tr>" for window, text in marks
    )
    head = "<tr><th>time</th><th>window</th><th>note</th></tr>"
    return f"<section><h2>Bookmarks</h2><table>{head}{rows}</table></section>"


def _count(number: int) -> str:
    for size, word in ((1e9, "G"), (1e6, "M")):
        if number >= size:
            return f"{number / size:.3g} {word}"
    return f"{number:,d}"


def _word(value: object) -> str:
    if value is None:
        return "chosen by the tracker"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)
