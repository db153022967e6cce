"""The failures of a report: what happened, why, what it cost, and what the worst window looked like."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.export.causes import EXPLANATIONS
from dvsviz.export.paths_svg import data_uri
from dvsviz.session.records import Failure
from dvsviz.view.drawing import draw
from dvsviz.view.images import ImageKind, ImageOptions
from dvsviz.view.shown import ShownSession

MOST_PICTURED = 24
"""Of more failures the longest are pictured: three images of 240x180 are about 40 kB, of 1280x720 a megabyte."""

_PICTURES = (
    (ImageKind.RAW, "raw events of the window"),
    (ImageKind.WARPED, "moved back by the estimated motion"),
    (ImageKind.MAP, "on the map, from the estimated pose"),
)
_COLOURS = (
    ("on", "brighter"),
    ("off", "darker"),
    ("explained", "edge that the map has"),
    ("unexplained", "edge that it has not"),
    ("map", "map"),
)


def failures_html(
    shown: ShownSession, plotted: dict[str, NDArray[np.float64]], end_s: float, progress: Callable[[float], None]
) -> str:
    """Return the section of the failures.

    Args:
        shown: the session.
        plotted: its curves (N,).
        end_s: end of the last window.
        progress: called with the share that is done, 0 to 1.
    """
    failures = shown.session.failures
    if not failures:
        none = "None: tracking was never lost, nor weak for three windows on end."
        return f"<section><h2>Failures</h2><p>{none}</p></section>"
    longest = sorted(range(len(failures)), key=lambda k: failures[k].start - failures[k].end)[:MOST_PICTURED]
    pictured = set(longest)
    parts = [f"<section><h2>Failures ({len(failures)})</h2>"]
    if shown.recording is None:
        # Why it is missing names a folder of this machine, which is nobody else's business.
        parts.append('<p class="warning">Without pictures: the recording was not there when this was written.</p>')
    if len(failures) > len(pictured):
        parts.append(f'<p class="dim">The {len(pictured)} longest are pictured.</p>')
    parts.append(_table(failures, plotted["t_s"], end_s))
    if shown.recording is not None:
        items = "".join(f'<li><i class="i-{style}"></i>{word}</li>' for style, word in _COLOURS)
        parts.append(f'<ul class="legend">{items}</ul>')
    for k, failure in enumerate(failures):
        parts.append(_failure(shown, failure, k + 1, plotted, end_s, pictured=k in pictured))
        progress(min(0.99, (k + 1) / len(failures)))
    return "\n".join([*parts, "</section>"])


def _table(failures: tuple[Failure, ...], t_s: NDArray[np.float64], end_s: float) -> str:
    rows = []
    for number, failure in enumerate(failures, 1):
        start, end = _times(failure, t_s, end_s)
        rows.append(
            f'<tr><td><a href="#failure-{number}">{number}</a></td><td>{EXPLANATIONS[failure.cause].name}</td>'
            f"<td>{start:.3f} to {end:.3f} s</td><td>{failure.start} to {failure.end - 1}</td>"
            f"<td>{failure.worst}</td></tr>"
        )
    head = "<tr><th></th><th>cause</th><th>time</th><th>windows</th><th>worst</th></tr>"
    return f'<div class="scroll"><table>{head}{"".join(rows)}</table></div>'


def _failure(
    shown: ShownSession,
    failure: Failure,
    number: int,
    plotted: dict[str, NDArray[np.float64]],
    end_s: float,
    *,
    pictured: bool,
) -> str:
    explanation = EXPLANATIONS[failure.cause]
    start, end = _times(failure, plotted["t_s"], end_s)
    pictures = _pictures(shown, failure.worst) if pictured and failure.worst < len(plotted["t_s"]) else ""
    return (
        f'<article class="failure" id="failure-{number}"><header><span class="number">{number}</span>'
        f'<h3>{escape(explanation.name)}</h3><span class="dim">{start:.3f} to {end:.3f} s · '
        f"{failure.end - failure.start} windows · worst {failure.worst}</span></header>"
        f"<p>{escape(failure.message[:1].upper() + failure.message[1:])}</p>{pictures}"
        f'<div class="why"><div><p><b>What it means.</b> {escape(explanation.means)}</p>'
        f"<p><b>Told from.</b> {escape(explanation.told_from)}</p>"
        f"<p><b>What to do.</b> {escape(explanation.todo)}</p></div>{_figures(shown, failure, plotted)}</div></article>"
    )


def _pictures(shown: ShownSession, window: int) -> str:
    drawn = [(draw(shown, window, kind, ImageOptions()), words) for kind, words in _PICTURES]
    figures = "".join(
        f'<figure><img alt="Window {window}: {words}" src="{data_uri(picture.png())}">'
        f"<figcaption>window {window}, {words}</figcaption></figure>"
        for picture, words in drawn
        if picture is not None
    )
    return f'<div class="pictures">{figures}</div>' if figures else ""


def _figures(shown: ShownSession, failure: Failure, plotted: dict[str, NDArray[np.float64]]) -> str:
    count = len(plotted["t_s"])
    worst = min(failure.worst, count - 1)
    values: dict[str, Any] = shown.values(worst)
    rows = [
        ("events", f"{values['events']:,d} in {values['duration_ms']:.1f} ms"),
        ("map score", _figure(values["score"], ".2f")),
        ("overlap", _figure(values["overlap"], ".0%")),
        ("confidence", _figure(values["confidence"], ".0%")),
        ("condition", _figure(values["condition"], ",.0f")),
        ("seen least", values["weak"] or "–"),
    ]
    errors = plotted["error_percent"]
    if np.isfinite(errors).any():
        inside = errors[failure.start : min(failure.end, count)]
        before = errors[failure.start - 1] if 0 < failure.start <= count else np.nan
        after = errors[failure.end] if failure.end < count else np.nan
        most = np.nanmax(inside) if np.isfinite(inside).any() else np.nan
        words = [
            f"{_figure(v, '.2f')} % {when}" for v, when in ((before, "before"), (most, "at most"), (after, "after"))
        ]
        rows.append(("position error", ", ".join(words)))
    body = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in rows)
    return f'<dl class="facts">{body}</dl>'


def _figure(value: float | None, spec: str) -> str:
    return "–" if value is None or not np.isfinite(value) else format(value, spec)


def _times(failure: Failure, t_s: NDArray[np.float64], end_s: float) -> tuple[float, float]:
    start = float(t_s[min(failure.start, len(t_s) - 1)])
    return start, float(t_s[failure.end]) if failure.end < len(t_s) else end_s
