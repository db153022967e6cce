"""Evaluations as text: one figure a line, or one recording a row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dvsviz.evaluate.evaluate import Evaluation

# Name for people, key of `Evaluation.to_dict`, format, unit.
ROWS: tuple[tuple[str, str, str, str], ...] = (
    ("alignment", "alignment", "", ""),
    ("poses compared", "poses", ",d", ""),
    ("coverage of the truth", "coverage", ".1%", ""),
    ("path of the truth", "path_m", ".4g", "m"),
    ("position (ATE, RMSE)", "position_rmse_m", ".4g", "m"),
    ("  of the path", "position_rmse_percent_of_path", ".3f", "%"),
    ("  of the plane distance", "position_rmse_percent_of_distance", ".3f", "%"),
    ("rotation (RMSE)", "rotation_rmse_deg", ".3f", "deg"),
    ("RPE position over 1 s", "rpe_position_m", ".4g", "m"),
    ("RPE rotation over 1 s", "rpe_rotation_deg", ".3f", "deg"),
)


def figure(value: object, spec: str, unit: str) -> str:
    """Return one figure with its unit; a dash for None."""
    if value is None:
        return "–"
    text = format(value, spec)
    return f"{text} {unit}" if unit else text


def evaluation_table(evaluation: Evaluation) -> str:
    """Return an evaluation as lines of name and figure."""
    figures = evaluation.to_dict()
    width = max(len(name) for name, *_ in ROWS)
    return "\n".join(f"{name:<{width}}  {figure(figures[key], spec, unit)}" for name, key, spec, unit in ROWS)


def table(columns: Sequence[str], rows: Sequence[Mapping[str, str]]) -> str:
    """Return rows as text columns, the first flush left, the others flush right.

    Args:
        columns: headings, in order; each row holds a text for each.
        rows: one mapping a line.
    """
    widths = [max(len(name), *(len(row[name]) for row in rows)) if rows else len(name) for name in columns]
    lines = [dict(zip(columns, columns, strict=True)), *rows]
    return "\n".join(
        "  ".join(
            f"{line[name]:<{width}}" if i == 0 else f"{line[name]:>{width}}"
            for i, (name, width) in enumerate(zip(columns, widths, strict=True))
        ).rstrip()
        for line in lines
    )
