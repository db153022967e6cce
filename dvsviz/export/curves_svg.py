"""A session's curves over its time as one inline SVG: state lane, curves with units, failures as numbered bands.

Colours are classes of the page around it, so that it follows dark and light.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dvsviz.session.records import STATUSES

Array = NDArray[np.float64]

_WIDTH, _LEFT, _RIGHT, _TOP = 1080, 122, 18, 26
_LANE, _CURVE, _GAP, _AXIS = 20, 88, 16, 40
# Above this many times the 98th percentile a peak would flatten the rest: the curve is cut there.
_CUT = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """One curve.

    Attributes:
        name: what it shows.
        unit: of its values, "" for none.
        values: a number a window (N,); NaN leaves a gap.
        style: class of its line.
        top: where its axis ends; chosen by the values unless said.
    """

    name: str
    unit: str
    values: Array
    style: str
    top: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """A numbered stretch of time that is marked.

    Attributes:
        number: shown on top of it; it links to `#failure-NUMBER`.
        start_s: where it begins.
        end_s: where it ends.
        title: what the pointer is told.
    """

    number: int
    start_s: float
    end_s: float
    title: str


def ticks(low: float, high: float, most: int) -> list[float]:
    """Return round numbers between two, at most `most`, 1, 2 or 5 times a power of ten apart."""
    if not high > low:
        return [low]
    step = 10.0 ** np.floor(np.log10((high - low) / most))
    step = next(step * factor for factor in (1, 2, 5, 10, 20) if (high - low) / (step * factor) <= most)
    first = np.ceil(low / step - 1e-9)
    return [float(round(k * step, 12)) + 0.0 for k in np.arange(first, np.floor(high / step + 1e-9) + 1)]


def number(value: float) -> str:
    """Return a number for an axis, without digits that say nothing."""
    return f"{value + 0.0:.6g}"  # no -0


def curves_svg(
    t_s: Array, end_s: float, status: NDArray[np.uint8], curves: Sequence[Curve], bands: Sequence[Band]
) -> str:
    """Return the SVG.

    Args:
        t_s: start of each window (N,), seconds.
        end_s: end of the last one.
        status: numbers of `STATUSES` (N,).
        curves: drawn under each other.
        bands: stretches that are marked through all of them.
    """
    begin = float(t_s[0])
    span = max(end_s - begin, 1e-9)
    inner = _WIDTH - _LEFT - _RIGHT
    bottom = _TOP + _LANE + len(curves) * (_CURVE + _GAP)
    height = bottom + _AXIS

    def x(t: Array) -> Array:
        return _LEFT + (np.asarray(t) - begin) / span * inner

    parts = [
        f'<svg class="chart" viewBox="0 0 {_WIDTH} {height}" role="img" '
        f'aria-label="State and {escape(", ".join(curve.name for curve in curves))} over time">'
    ]
    parts += _grid(begin, begin + span, x, bottom)
    parts += [_band(band, x, bottom) for band in bands]
    parts += _lane(x(t_s), float(x(np.array(begin + span))), status)
    for place, curve in enumerate(curves):
        top = _TOP + _LANE + _GAP + place * (_CURVE + _GAP)
        parts += _curve(curve, x(t_s), top, place)
    return "\n".join([*parts, "</svg>"])


def _grid(begin: float, end: float, x: Callable[[Array], Array], bottom: int) -> list[str]:
    parts = []
    for t in ticks(begin, end, 10):
        at = float(x(np.asarray(t)))
        parts.append(f'<path class="grid" d="M{at:.1f} {_TOP}V{bottom}"/>')
        parts.append(f'<text class="tick" x="{at:.1f}" y="{bottom + 16}" text-anchor="middle">{number(t)}</text>')
    middle = _LEFT + (_WIDTH - _LEFT - _RIGHT) / 2
    parts.append(f'<text class="axis" x="{middle}" y="{bottom + 34}" text-anchor="middle">time (s)</text>')
    return parts


def _band(band: Band, x: Callable[[Array], Array], bottom: int) -> str:
    left, right = (float(x(np.asarray(t))) for t in (band.start_s, band.end_s))
    width = max(1.5, right - left)
    return (
        f'<a href="#failure-{band.number}"><title>{escape(band.title)}</title>'
        f'<rect class="band" x="{left:.1f}" y="{_TOP}" width="{width:.1f}" height="{bottom - _TOP}"/>'
        f'<text class="mark" x="{left + width / 2:.1f}" y="{_TOP - 8}" text-anchor="middle">{band.number}</text></a>'
    )


def _lane(x: Array, end: float, status: NDArray[np.uint8]) -> list[str]:
    parts = [_label("state", "", _TOP + _LANE / 2)]
    starts = np.flatnonzero(np.concatenate([[True], status[1:] != status[:-1]]))
    edges = np.append(x[starts], end)
    for k, start in enumerate(starts):
        name = STATUSES[int(status[start])]
        width = max(0.6, edges[k + 1] - edges[k])
        parts.append(
            f'<rect class="is-{name}" x="{edges[k]:.1f}" y="{_TOP}" width="{width:.1f}" height="{_LANE}">'
            f"<title>{name}</title></rect>"
        )
    return parts


def _curve(curve: Curve, x: Array, top: float, place: int) -> list[str]:
    known = curve.values[np.isfinite(curve.values)]
    parts = [_label(curve.name, curve.unit, top + _CURVE / 2)]
    inner = _WIDTH - _LEFT - _RIGHT
    frame = f'<rect class="frame" x="{_LEFT}" y="{top}" width="{inner}" height="{_CURVE}"/>'
    if len(known) == 0:
        middle = _LEFT + inner / 2
        return [*parts, frame, f'<text class="tick" x="{middle}" y="{top + _CURVE / 2}">not known</text>']
    highest = float(known.max())
    high = curve.top or min(highest, _CUT * float(np.percentile(known, 98))) or highest
    high = 1.06 * high if high > 0 else 1.0
    low = min(0.0, float(np.percentile(known, 1)))
    for tick in ticks(low, high, 4):
        at = top + _CURVE * (1 - (tick - low) / (high - low))
        parts.append(f'<path class="grid" d="M{_LEFT} {at:.1f}h{inner}"/>')
        parts.append(f'<text class="tick" x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{number(tick)}</text>')
    y = top + _CURVE * (1 - (curve.values - low) / (high - low))
    y = np.clip(y, top, top + _CURVE)
    parts.append(f'<path class="curve {curve.style}" d="{line(x, y)}"/>')
    parts.append(frame)
    if highest > high:
        parts.append(
            f'<text class="tick" x="{_WIDTH - _RIGHT - 6}" y="{top + 14}" text-anchor="end">'
            f"cut; highest {number(float(f'{highest:.3g}'))} {escape(curve.unit)}</text>"
        )
    return parts


def _label(name: str, unit: str, y: float) -> str:
    """Return a name left of its axis, the unit on a line of its own."""
    shift = 0 if unit else 4
    text = f'<text class="name" x="0" y="{y + shift:.1f}">{escape(name)}</text>'
    return text + (f'<text class="tick" x="0" y="{y + 15:.1f}">{escape(unit)}</text>' if unit else "")


def line(x: Array, y: Array, most: int = 2400) -> str:
    """Return the path of a line through points (N,), (N,); what is not finite leaves a gap.

    Of more than `most` points the lowest and the highest of each stretch are kept, so that no peak is lost.
    """
    if len(x) > most:
        edges = np.linspace(0, len(x), most // 2 + 1).astype(int)
        kept: set[int] = {0, len(x) - 1}
        for first, last in pairwise(edges):
            part = y[first:last]
            if np.isfinite(part).any():
                kept |= {first + int(np.nanargmin(part)), first + int(np.nanargmax(part))}
            else:
                kept.add(first)
        chosen = np.array(sorted(kept))
        x, y = x[chosen], y[chosen]
    words, pen_is_down = [], False
    for px, py in zip(x.tolist(), y.tolist(), strict=True):
        if not (np.isfinite(px) and np.isfinite(py)):
            pen_is_down = False
            continue
        words.append(f"{'L' if pen_is_down else 'M'}{px:.1f} {py:.1f}")
        pen_is_down = True
    return "".join(words)
