"""Tables of a study: text for a terminal, CSV, LaTeX and JSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from dvsviz.registration.study import StudyRow

TableFormat = Literal["text", "csv", "latex", "json"]

# Heading, LaTeX heading, and the cell of a row.
_COLUMNS: tuple[tuple[str, str, Callable[[StudyRow], str]], ...] = (
    ("method", "Method", lambda r: r.method),
    ("skip", "Skip", lambda r: str(r.skip)),
    ("mode", "Mode", lambda r: r.mode),
    ("failed", "Failed", lambda r: f"{r.failures}/{r.registered}"),
    ("scale", "Scale", lambda r: r.scale),
    ("matches", "Matches", lambda r: _count(r.matches)),
    ("inliers", "Inliers", lambda r: _count(r.inliers)),
    ("rel rot rad", "Rel. rot. (rad)", lambda r: _pair(r.relative_rotation_rad, r.relative_rotation_std_rad)),
    ("rel trans m", "Rel. trans. (m)", lambda r: _pair(r.relative_translation_m, r.relative_translation_std_m)),
    ("abs rot rad", "Abs. rot. (rad)", lambda r: _pair(r.absolute_rotation_rad, r.absolute_rotation_std_rad)),
    ("abs trans m", "Abs. trans. (m)", lambda r: _pair(r.absolute_translation_m, r.absolute_translation_std_m)),
    ("features ms", "Features (ms)", lambda r: f"{r.features_s * 1e3:.1f}"),
    ("points ms", "Points (ms)", lambda r: f"{r.points_s * 1e3:.1f}"),
    ("method ms", "Method (ms)", lambda r: f"{r.method_s * 1e3:.1f}"),
    ("total ms", "Total (ms)", lambda r: f"{r.total_s * 1e3:.1f}"),
)


def format_table(rows: Sequence[StudyRow], kind: TableFormat = "text") -> str:
    """Return the rows as one table; errors are "mean ± standard deviation", times are means a registered frame."""
    if kind == "csv":
        return _csv(rows)
    if kind == "json":
        return json.dumps([row.to_dict() for row in rows], indent=1, allow_nan=False)
    return _latex(rows) if kind == "latex" else _text(rows)


def _pair(mean: float, deviation: float) -> str:
    return "-" if not np.isfinite(mean) else f"{mean:.4f} ± {deviation:.4f}"


def _count(value: float) -> str:
    return f"{value:.0f}" if np.isfinite(value) else "-"


def _text(rows: Sequence[StudyRow]) -> str:
    cells = [[heading for heading, _, _ in _COLUMNS], *([cell(row) for _, _, cell in _COLUMNS] for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(_COLUMNS))]
    words = {0, 2, 4}
    lines = [
        "  ".join(
            c.ljust(w) if k in words else c.rjust(w) for k, (c, w) in enumerate(zip(line, widths, strict=True))
        )
        for line in cells
    ]
    lines.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(line.rstrip() for line in lines)


def _csv(rows: Sequence[StudyRow]) -> str:
    out = io.StringIO()
    values = [row.to_dict() for row in rows]
    writer = csv.DictWriter(out, fieldnames=list(values[0]) if values else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(values)
    return out.getvalue().rstrip("\n")


def _latex(rows: Sequence[StudyRow]) -> str:
    lines = [r"\begin{tabular}{" + "l" + "r" * (len(_COLUMNS) - 1) + "}", r"\hline"]
    lines += [" & ".join(heading for _, heading, _ in _COLUMNS) + r" \\", r"\hline"]
    for row in rows:
        lines.append(" & ".join(cell(row).replace("±", r"$\pm$") for _, _, cell in _COLUMNS) + r" \\")
    return "\n".join([*lines, r"\hline", r"\end{tabular}"])
