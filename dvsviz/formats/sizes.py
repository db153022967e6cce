"""Sensor sizes: what is assumed where a format does not record the sensor's size."""

from __future__ import annotations

from pathlib import Path

from dvsviz.errors import FormatError

# Sensors of public recordings: DVS128, DAVIS240, DAVIS346, ATIS, DVS-Gen2, Gen3 VGA, DSEC's and Gen4 HD.
KNOWN_SIZES = ((128, 128), (240, 180), (304, 240), (346, 260), (480, 360), (640, 480), (1280, 720))
# A recording of some thousand events reaches the outer 3 % of its sensor.
_REACHED = 0.97


def assumed_size(max_x: int, max_y: int) -> tuple[int, int] | None:
    """Return the known sensor whose last column and row events reach, or None."""
    for width, height in KNOWN_SIZES:
        if max_x < width and max_y < height:
            reached = max_x + 1 >= _REACHED * width and max_y + 1 >= _REACHED * height
            return (width, height) if reached else None
    return None


def require_size(max_x: int, max_y: int, path: Path) -> tuple[int, int]:
    """Return the sensor's size that events suggest by their largest pixel.

    Raises:
        FormatError: they fill no known sensor.
    """
    size = assumed_size(max_x, max_y)
    if size is None:
        raise FormatError(
            "the sensor's size is not recorded",
            path=path,
            hint=f"give it with --size WxH (the largest pixel is {max_x}, {max_y})",
        )
    return size


def assumption(size: tuple[int, int]) -> str:
    """Return the warning about an assumed size."""
    return (
        f"the sensor's size is not recorded: {size[0]}x{size[1]} assumed from the largest pixel; "
        "give it with --size"
    )
