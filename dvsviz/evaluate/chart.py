"""Line charts, drawn twice from one description: as SVG text and as pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal
from xml.sax.saxutils import escape

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rgb = tuple[int, int, int]

# Okabe-Ito and four more that keep apart from them on white; black is the truth.
PALETTE: tuple[Rgb, ...] = (
    (0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (120, 94, 40),
    (128, 0, 128), (60, 60, 160), (150, 150, 0), (200, 30, 80), (0, 90, 90), (110, 110, 110),
)  # fmt: skip
TRUTH: Rgb = (20, 20, 20)
_INK, _FAINT, _GRID = (45, 45, 45), (110, 110, 110), (228, 228, 228)
_LEFT, _RIGHT, _TOP, _BOTTOM, _LEGEND = 66, 14, 34, 46, 190
_PNG_SCALE = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line:
    """A curve.

    Attributes:
        name: in the legend.
        x: (N,).
        y: (N,); a curve is broken where it is not finite.
        rgb: colour.
        marks: True for a dot at each point.
        dashed: True for a broken line.
    """

    name: str
    x: Array
    y: Array
    rgb: Rgb
    marks: bool = False
    dashed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chart:
    """A chart of lines.

    Attributes:
        title: above it.
        x_label: with the unit.
        y_label: with the unit.
        lines: the curves; later ones lie on top.
        log_y: True for a logarithmic vertical axis.
        equal: True for one scale of both axes.
    """

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...] = field(default=())
    log_y: bool = False
    equal: bool = False


Shape = tuple[Literal["line", "text", "dot"], dict[str, Any]]


def to_svg(charts: Sequence[Chart], *, width: int = 800, height: int = 300) -> str:
    """Return charts one below the other as an SVG document."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height * len(charts)}" '
        f'viewBox="0 0 {width} {height * len(charts)}" font-family="Helvetica, Arial, sans-serif">',
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for k, chart in enumerate(charts):
        for kind, s in _shapes(chart, width, height):
            colour = f"rgb{s['rgb']}".replace(" ", "")
            if kind == "line":
                points = " ".join(f"{x:.1f},{y + k * height:.1f}" for x, y in s["points"])
                dash = ' stroke-dasharray="5 4"' if s["dashed"] else ""
                parts.append(
                    f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{s["width"]}"'
                    f' stroke-linejoin="round"{dash}/>'
                )
            elif kind == "dot":
                parts.append(f'<circle cx="{s["x"]:.1f}" cy="{s["y"] + k * height:.1f}" r="2.6" fill="{colour}"/>')
            else:
                x, y = s["x"], s["y"] + k * height
                turn = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if s["up"] else ""
                weight = ' font-weight="600"' if s["bold"] else ""
                parts.append(
                    f'<text x="{x:.1f}" y="{y:.1f}" font-size="{s["size"]}" text-anchor="{s["anchor"]}" '
                    f'fill="{colour}"{weight}{turn}>{escape(s["text"])}</text>'
                )
    return "\n".join([*parts, "</svg>", ""])


def to_png(charts: Sequence[Chart], *, width: int = 800, height: int = 300) -> bytes:
    """Return charts one below the other as a PNG of twice the size, for sharp screens."""
    image = np.full((height * len(charts) * _PNG_SCALE, width * _PNG_SCALE, 3), 255, np.uint8)
    for k, chart in enumerate(charts):
        part = image[k * height * _PNG_SCALE : (k + 1) * height * _PNG_SCALE]
        for kind, s in _shapes(chart, width, height):
            rgb = s["rgb"]
            if kind == "line":
                _draw_line(part, np.asarray(s["points"]) * _PNG_SCALE, rgb, s["width"] * _PNG_SCALE, s["dashed"])
            elif kind == "dot":
                at = (round(s["x"] * _PNG_SCALE * 16), round(s["y"] * _PNG_SCALE * 16))
                cv2.circle(part, at, round(2.6 * _PNG_SCALE * 16), rgb, -1, cv2.LINE_AA, 4)
            else:
                _draw_text(part, s)
    done, data = cv2.imencode(".png", image[..., ::-1])
    if not done:
        raise ValueError("charts: expected something that can be encoded")
    return data.tobytes()


def _draw_line(image: NDArray[np.uint8], points: Array, rgb: Rgb, thickness: float, dashed: bool) -> None:
    pieces = [points]
    if dashed:
        length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        starts = np.arange(0, length[-1], 9 * _PNG_SCALE)
        pieces = [
            np.stack([np.interp(at, length, points[:, axis]) for axis in range(2)], axis=1)
            for at in (np.linspace(start, start + 5 * _PNG_SCALE, 4) for start in starts)
        ]
    for piece in pieces:
        fixed = np.round(piece * 16).astype(np.int32)
        cv2.polylines(image, [fixed], False, rgb, max(1, round(thickness)), cv2.LINE_AA, 4)


def _draw_text(image: NDArray[np.uint8], s: dict[str, Any]) -> None:
    """Draw a text; on its side by way of a turned copy."""
    size = round(s["size"] * _PNG_SCALE)
    wide = _text_width(s["text"], size, s["bold"])
    canvas = np.full((2 * size, wide + 8, 3), 255, np.uint8)
    _put_text(canvas, s["text"], (4, round(1.4 * size)), s["rgb"], size, s["bold"])
    shift = {"start": 0, "middle": wide / 2, "end": wide}[s["anchor"]]
    x, y = s["x"] * _PNG_SCALE, s["y"] * _PNG_SCALE
    if s["up"]:
        canvas = np.ascontiguousarray(np.rot90(canvas))
        left, top = round(x - 1.4 * size), round(y + shift - canvas.shape[0] + 4)
    else:
        left, top = round(x - shift) - 4, round(y - 1.4 * size)
    top0, left0 = max(0, top), max(0, left)
    target = image[top0 : top + canvas.shape[0], left0 : left + canvas.shape[1]]
    source = canvas[top0 - top : top0 - top + target.shape[0], left0 - left : left0 - left + target.shape[1]]
    np.minimum(target, source, out=target)


def _text_width(text: str, size: int, bold: bool) -> int:
    if hasattr(cv2, "FontFace"):
        box = cv2.getTextSize((0, 0), text, (0, 0), cv2.FontFace("sans"), size, 600 if bold else 400)
        return int(1.15 * box[2]) if bold else int(box[2])
    return cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size / 30, 1)[0][0]


def _put_text(image: NDArray[np.uint8], text: str, at: tuple[int, int], rgb: Rgb, size: int, bold: bool) -> None:
    # OpenCV before 5 has stroked letters only.
    if hasattr(cv2, "FontFace"):
        cv2.putText(image, text, at, rgb, cv2.FontFace("sans"), size, 600 if bold else 400)
    else:
        plain = text.replace("·", "-").replace("±", "+-").replace("×", "x")
        cv2.putText(image, plain, at, cv2.FONT_HERSHEY_SIMPLEX, size / 30, rgb, 2 if bold else 1, cv2.LINE_AA)


def _shapes(chart: Chart, width: int, height: int) -> list[Shape]:
    """Return what is drawn, in pixels from the upper left corner."""
    right, bottom = width - _RIGHT - _LEGEND, height - _BOTTOM
    x_range, y_range = _ranges(chart, right - _LEFT, bottom - _TOP)
    shapes: list[Shape] = [_text(chart.title, _LEFT, 20, 13, bold=True)]

    def place(x: Array, y: Array) -> Array:
        if chart.log_y:
            y = np.log10(np.maximum(y, 1e-300))
        across = _LEFT + (x - x_range[0]) / (x_range[1] - x_range[0]) * (right - _LEFT)
        return np.column_stack([across, bottom - (y - y_range[0]) / (y_range[1] - y_range[0]) * (bottom - _TOP)])

    for value in _ticks(*x_range):
        at = float(_LEFT + (value - x_range[0]) / (x_range[1] - x_range[0]) * (right - _LEFT))
        shapes += [
            _line([[at, _TOP], [at, bottom]], _GRID, 1),
            _text(_number(value), at, bottom + 16, 11, "middle"),
        ]
    for value, text in _y_ticks(chart, y_range):
        at = float(bottom - (value - y_range[0]) / (y_range[1] - y_range[0]) * (bottom - _TOP))
        shapes += [_line([[_LEFT, at], [right, at]], _GRID, 1), _text(text, _LEFT - 6, at + 4, 11, "end")]
    shapes.append(_line([[_LEFT, _TOP], [_LEFT, bottom], [right, bottom]], _FAINT, 1))
    shapes.append(_text(chart.x_label, (_LEFT + right) / 2, height - 10, 11, "middle"))
    shapes.append(_text(chart.y_label, 14, (_TOP + bottom) / 2, 11, "middle", up=True))
    for k, line in enumerate(chart.lines):
        points = place(np.asarray(line.x, np.float64), np.asarray(line.y, np.float64))
        # What leaves the chart (a method that was lost) leaves it at its border.
        points[:, 1] = np.clip(points[:, 1], _TOP, bottom)
        points[:, 0] = np.clip(points[:, 0], _LEFT, right)
        known = np.isfinite(points).all(axis=1) & np.isfinite(line.y)
        for start, end in _stretches(known):
            shapes.append(_line(points[start:end].tolist(), line.rgb, 1.6, line.dashed))
        if line.marks:
            shapes += [_dot(x, y, line.rgb) for x, y in points[known].tolist()]
        y = _TOP + 8 + 17 * k
        shapes.append(_line([[right + 14, y - 4], [right + 34, y - 4]], line.rgb, 2.4, line.dashed))
        shapes.append(_text(line.name, right + 40, y, 11))
    return shapes


def _line(points: Any, rgb: Rgb, width: float, dashed: bool = False) -> Shape:
    return "line", {"points": points, "rgb": rgb, "width": width, "dashed": dashed}


def _dot(x: float, y: float, rgb: Rgb) -> Shape:
    return "dot", {"x": x, "y": y, "rgb": rgb}


def _text(
    text: str, x: float, y: float, size: int, anchor: str = "start", *, bold: bool = False, up: bool = False
) -> Shape:
    return "text", {
        "text": text, "x": x, "y": y, "size": size, "anchor": anchor, "bold": bold, "up": up, "rgb": _INK
    }  # fmt: skip


def _stretches(known: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return starts and ends of the runs of two and more that are known."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a > 1]


def _ranges(chart: Chart, wide: int, tall: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits of both axes (of the logarithm where it is one), with some room."""
    xs = np.concatenate([np.asarray(line.x, np.float64) for line in chart.lines] or [np.zeros(1)])
    ys = np.concatenate([np.asarray(line.y, np.float64) for line in chart.lines] or [np.zeros(1)])
    xs, ys = xs[np.isfinite(xs)], ys[np.isfinite(ys)]
    if chart.log_y:
        ys = np.log10(ys[ys > 0])
    if len(xs) == 0 or len(ys) == 0:
        return (0.0, 1.0), (0.0, 1.0)
    x0, x1, y0, y1 = float(xs.min()), float(xs.max()), float(ys.min()), float(ys.max())
    if chart.equal:
        # The first line is the reference: what flew far away does not make the rest invisible.
        first = chart.lines[0]
        x0, x1, y0, y1 = (float(v) for v in (first.x.min(), first.x.max(), first.y.min(), first.y.max()))
        size = 1.3 * max((x1 - x0) / wide, (y1 - y0) / tall, 1e-6)
        mx, my = (x0 + x1) / 2, (y0 + y1) / 2
        return (mx - size * wide / 2, mx + size * wide / 2), (my - size * tall / 2, my + size * tall / 2)
    if not chart.log_y:
        y0 = min(y0, 0.0)
    pad_x, pad_y = 0.02 * max(x1 - x0, 1e-9), 0.06 * max(y1 - y0, 1e-9)
    low = y0 if not chart.log_y and y0 == 0 else y0 - pad_y
    return (x0 - pad_x, x1 + pad_x), (low, y1 + pad_y)


def _ticks(low: float, high: float) -> list[float]:
    """Return five to ten round numbers between two."""
    step = 10 ** np.floor(np.log10((high - low) / 5))
    step *= next(k for k in (1, 2, 5, 10) if (high - low) / (step * k) <= 8)
    return [float(v) for v in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step]


def _y_ticks(chart: Chart, y_range: tuple[float, float]) -> list[tuple[float, str]]:
    if not chart.log_y:
        return [(v, _number(v)) for v in _ticks(*y_range)]
    found = []
    for power in range(int(np.floor(y_range[0])), int(np.ceil(y_range[1])) + 1):
        for digit in (1, 2, 5) if y_range[1] - y_range[0] < 2.5 else (1,):
            at = power + float(np.log10(digit))
            if y_range[0] <= at <= y_range[1]:
                found.append((at, _number(digit * 10.0**power)))
    return found


def _number(value: float) -> str:
    return "0" if abs(value) < 1e-12 else f"{value:.6g}"
