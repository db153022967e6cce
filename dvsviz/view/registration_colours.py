"""Colours of a registration, the same in pictures and in the scene."""

from __future__ import annotations

from dvsviz.evaluate.chart import PALETTE
from dvsviz.session.registration import RegistrationRecord

Rgb = tuple[int, int, int]

# Okabe-Ito: told apart by all kinds of sight.
INLIER_RGB: Rgb = (86, 220, 160)
OUTLIER_RGB: Rgb = (240, 120, 30)


def method_colours(record: RegistrationRecord) -> dict[str, Rgb]:
    """Return a colour for each run's name."""
    names = list(dict.fromkeys(run.name for run in record.runs))
    return {name: PALETTE[k % len(PALETTE)] for k, name in enumerate(names)}
