"""Options that several subcommands share, and how the words after an option are read."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg
from tyro.constructors import PrimitiveConstructorSpec


def read_size(word: str) -> tuple[int, int]:
    """Return width and height of `240x180`."""
    found = re.fullmatch(r"(\d+)[xX×](\d+)", word)
    if not found:
        raise ValueError(f"expected WIDTHxHEIGHT such as 240x180, got {word}")
    return int(found[1]), int(found[2])


def read_roi(word: str) -> tuple[int, int, int, int]:
    """Return the four numbers of `60,40,120,90`."""
    found = re.fullmatch(r"(\d+),(\d+),(\d+),(\d+)", word)
    if not found:
        raise ValueError(f"expected X,Y,WIDTH,HEIGHT such as 60,40,120,90, got {word}")
    return int(found[1]), int(found[2]), int(found[3]), int(found[4])


def read_number(kind: type[int] | type[float]) -> Callable[[str], Any]:
    """Return a function that reads a number of a kind."""

    def read(word: str) -> Any:
        try:
            return kind(word)
        except ValueError:
            wanted = "a whole number" if kind is int else "a number"
            raise ValueError(f"expected {wanted}, got {word}") from None

    return read


def option(metavar: str, read: Callable[[str], Any], unset: str) -> tuple[Any, Any]:
    """Return the constructor of an option that may be left away, and the words for what happens then."""
    spec = PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: read(words[0]),
        is_instance=lambda value: True,
        str_from_instance=lambda value: [str(value)],
    )
    return spec, arg(help_behavior_hint=f"(default: {unset})")


Flag = Annotated[bool, arg(help_behavior_hint="")]
Json = Annotated[bool, arg(help_behavior_hint="", help="Print one JSON object on standard output.")]
Size = Annotated[
    tuple[int, int] | None,
    *option("WxH", read_size, "what the recording says"),
    arg(help="Sensor width and height in pixels, where the recording does not say it."),
]
Calibration = Annotated[
    Path | None,
    *option("FILE", Path, "the recorded one"),
    arg(help="Calibration file that replaces the recorded one: fx fy cx cy k1 k2 p1 p2 k3."),
]
Repair = Annotated[
    bool,
    arg(
        help_behavior_hint="",
        help="Drop and count events, poses and frames that are wrong, instead of refusing the file.",
    ),
]
Folder = Annotated[
    Path | None,
    *option("DIR", Path, "$DVSVIZ_SESSIONS, else sessions"),
    arg(help="Where sessions are kept."),
]
