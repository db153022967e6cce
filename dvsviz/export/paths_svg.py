"""A session's trajectory as inline SVG: from the top, from the side, and on its map."""

from __future__ import annotations

import base64
from html import escape

import numpy as np
from numpy.typing import NDArray

from dvsviz.export.curves_svg import line, number, ticks
from dvsviz.geometry.plane import Plane, rotation_to_map
from dvsviz.session.records import STATUSES, MapRevision
from dvsviz.view.images import texture_picture

Array = NDArray[np.float64]

_WIDTH, _HEIGHT, _MARGIN = 520, 400, 46
_MOST_POINTS = 3000


def view_svg(
    title: str,
    across: tuple[str, Array, Array | None],
    down: tuple[str, Array, Array | None],
    status: NDArray[np.uint8],
    keyframes: list[int],
    metres: float | None,
    *,
    upward: bool = False,
) -> str:
    """Return one view of a trajectory, both axes with the same scale.

    Args:
        title: what is seen from where.
        across: name of the axis to the right, its coordinates of the windows (N,) and of the truth (M,) or None.
        down: the same of the axis that points down.
        status: numbers of `STATUSES` (N,).
        keyframes: their windows.
        metres: length of the unit in metres where it is known.
        upward: the second axis points up instead.
    """
    (x_name, x, x_true), (y_name, y, y_true) = across, down
    if upward:
        y, y_true = -y, None if y_true is None else -y_true
    low, size = _frame(x, y, x_true, y_true)
    inner = np.array([_WIDTH - 2 * _MARGIN, _HEIGHT - 2 * _MARGIN])
    scale = float((inner / size).min())
    origin = np.array([_WIDTH, _HEIGHT]) / 2 - scale * (low + size / 2)

    def px(values: Array, axis: int) -> Array:
        return np.clip(origin[axis] + scale * values, -4000, 4000)

    name = escape(title)
    parts = [f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{name}">']
    clip = f"clip-{title.split()[1]}"
    parts.append(
        f'<clipPath id="{clip}"><rect x="1" y="1" width="{_WIDTH - 2}" height="{_HEIGHT - 2}"/></clipPath>'
        f'<rect class="frame" x="0.5" y="0.5" width="{_WIDTH - 1}" height="{_HEIGHT - 1}" rx="6"/>'
        f'<text class="name" x="14" y="24">{name}</text><g clip-path="url(#{clip})">'
    )
    if x_true is not None and y_true is not None:
        parts.append(f'<path class="curve truth" d="{line(*_thin(px(x_true, 0), px(y_true, 1)))}"/>')
    parts += coloured(px(x, 0), px(y, 1), status)
    marks = [w for w in keyframes if w < len(x) and np.isfinite(x[w] + y[w])]
    for window in marks:
        at = px(x[window : window + 1], 0)[0], px(y[window : window + 1], 1)[0]
        parts.append(f'<rect class="keyframe" x="{at[0] - 2.5:.1f}" y="{at[1] - 2.5:.1f}" width="5" height="5"/>')
    parts.append("</g>")
    parts.append(_bar(scale, metres))
    parts.append(_arrows(x_name, y_name, upward=upward))
    return "\n".join([*parts, "</svg>"])


def map_svg(revision: MapRevision, positions: Array, status: NDArray[np.uint8], metres: float | None) -> str:
    """Return the map's texture with the camera's path over it, each position moved onto the plane along its normal.

    Args:
        revision: the map.
        positions: of the camera in the world (N, 3).
        status: numbers of `STATUSES` (N,).
        metres: length of the unit in metres where it is known.
    """
    rows, columns = revision.texture.shape
    plane = Plane(normal=revision.normal_world, distance=revision.distance)
    uv = (positions @ rotation_to_map(plane.normal).T)[:, :2]
    x, y = ((uv - revision.origin) * revision.px_per_unit + 0.5).T
    zoom = 1000 / columns
    parts = [
        f'<svg class="chart map" viewBox="0 0 {columns * zoom:.0f} {rows * zoom:.0f}" role="img" '
        f'aria-label="The map with the path of the camera over it">'
        f'<image width="{columns * zoom:.1f}" height="{rows * zoom:.1f}" preserveAspectRatio="none" '
        f'href="{data_uri(texture_picture(revision).png())}"/>'
    ]
    inside = (np.abs(x) < 10 * columns) & (np.abs(y) < 10 * rows)
    parts += coloured(np.where(inside, x * zoom, np.nan), np.where(inside, y * zoom, np.nan), status)
    length = ticks(0, 0.3 * columns / revision.px_per_unit, 2)[-1]
    wide, bottom = length * revision.px_per_unit * zoom, rows * zoom - 16
    parts.append(
        f'<path class="bar on-image" d="M16 {bottom - 5:.0f}v5h{wide:.1f}v-5"/>'
        f'<text class="bar-text" x="{16 + wide / 2:.1f}" y="{bottom - 9:.0f}">{_length(length, metres)}</text>'
    )
    return "\n".join([*parts, "</svg>"])


def coloured(x: Array, y: Array, status: NDArray[np.uint8]) -> list[str]:
    """Return a line through points (N,), (N,) in the colours of their states; a stretch reaches back to its start."""
    if len(x) > _MOST_POINTS:
        # Every change of state is kept, and an even share of the rest.
        changes = np.flatnonzero(np.diff(status.astype(int))) + 1
        even = np.linspace(0, len(x) - 1, _MOST_POINTS).astype(int)
        kept = np.unique(np.concatenate([even, changes, changes - 1]))
        x, y, status = x[kept], y[kept], status[kept]
    starts = np.flatnonzero(np.concatenate([[True], status[1:] != status[:-1]]))
    parts = []
    for first, last in zip(starts, np.append(starts[1:], len(status)), strict=True):
        begin = max(0, first - 1)
        name = STATUSES[int(status[first])]
        parts.append(f'<path class="curve path is-{name}" d="{line(x[begin:last], y[begin:last])}"/>')
    return parts


def data_uri(png: bytes) -> str:
    """Return a PNG as an address that holds it."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _frame(x: Array, y: Array, x_true: Array | None, y_true: Array | None) -> tuple[Array, Array]:
    """Return the corner (2,) and the size (2,) of what is shown: a lost pose far away does not shrink the rest."""
    points = np.stack([x, y], axis=1)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return np.array([-0.5, -0.5]), np.array([1.0, 1.0])
    low, high = np.percentile(points, [1, 99], axis=0)
    if x_true is not None and y_true is not None and len(x_true):
        truth = np.stack([x_true, y_true], axis=1)
        low, high = np.minimum(low, truth.min(axis=0)), np.maximum(high, truth.max(axis=0))
    least = max(0.02, 0.1 * float((high - low).max()))
    middle, size = (low + high) / 2, np.maximum(high - low, least)
    return middle - size / 2, size


def _thin(x: Array, y: Array) -> tuple[Array, Array]:
    kept = np.unique(np.linspace(0, len(x) - 1, min(len(x), _MOST_POINTS)).astype(int))
    return x[kept], y[kept]


def _bar(scale: float, metres: float | None) -> str:
    length = ticks(0, 150 / scale, 2)[-1]
    wide, right, bottom = length * scale, _WIDTH - 16, _HEIGHT - 16
    return (
        f'<path class="bar" d="M{right - wide:.1f} {bottom - 5}v5H{right}v-5"/>'
        f'<text class="tick" x="{right}" y="{bottom - 10}" text-anchor="end">{_length(length, metres)}</text>'
    )


def _length(length: float, metres: float | None) -> str:
    known = "" if metres is None else f" = {number(float(f'{length * metres:.3g}'))} m"
    return f"{number(length)} d{known}"


def _arrows(x_name: str, y_name: str, *, upward: bool) -> str:
    bottom = _HEIGHT - (22 if upward else 62)
    way = "v-34m-4 6l4 -6l4 6" if upward else "v34m-4 -6l4 6l4 -6"
    return (
        f'<path class="bar" d="M22 {bottom}h34m-6 -4l6 4l-6 4M22 {bottom}{way}"/>'
        f'<text class="tick" x="62" y="{bottom + 4}">{escape(x_name)}</text>'
        f'<text class="tick" x="30" y="{bottom - 28 if upward else bottom + 38}">{escape(y_name)}</text>'
    )
