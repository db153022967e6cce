"""The layout of a session file, format `dvsviz-session` version 1: the twin of `docs/session-format.md`.

A table is a group of columns (datasets) of one length; row after row is appended. Bytes of varying length (text,
images, tracker states) lie one after the other in flat `uint8` datasets, found by first byte and count: a file
that is read while it is written (HDF5's SWMR) cannot hold variable-length values.
"""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np

from dvsviz.session.records import Cause

FORMAT = "dvsviz-session"
VERSION = 1
LEVELS: tuple[str, ...] = ("info", "warning", "error")
# The order is the number stored in session files: append, never reorder.
CAUSES: tuple[Cause, ...] = tuple(Cause)

CHUNK_ROWS = 1024
CHUNK_BYTES = 1 << 16
# Poses are 128 bytes: smaller chunks, because an unfinished chunk is written again at each flush.
_POSE_CHUNK_ROWS = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One dataset of a table.

    Attributes:
        name: name in the group.
        dtype: numpy's name of its type.
        shape: shape of one row; () for a scalar.
        unit: unit of its numbers; "" where they have none; "d_w" is the plane's distance from the world origin.
    """

    name: str
    dtype: str = "int64"
    shape: tuple[int, ...] = ()
    unit: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A group of columns of one length."""

    name: str
    columns: tuple[Column, ...]


def _c(name: str, dtype: str = "int64", shape: tuple[int, ...] = (), unit: str = "") -> Column:
    return Column(name=name, dtype=dtype, shape=shape, unit=unit)


_POSE = _c("T_world_camera", "float64", (4, 4), "d_w")
# Windows that were stored when the row was added: where a resumed run cuts.
_AFTER = _c("after", unit="windows")
_TEXT = (_c("text_first", unit="bytes"), _c("text_count", unit="bytes"))
_IMAGE = (_c("image_first", unit="bytes"), _c("image_count", unit="bytes"))

WINDOWS = Table(
    name="windows",
    columns=(
        _c("start_us", unit="us"),
        _c("end_us", unit="us"),
        _c("first_event", unit="events"),
        _c("end_event", unit="events"),
        _c("status", "uint8"),
        _POSE,
        _c("omega", "float64", (3,), "rad/s"),
        _c("velocity", "float64", (3,), "d_w/s"),
        _c("normal_world", "float64", (3,)),
        _c("contrast_before", "float64"),
        _c("contrast_after", "float64"),
        _c("overlap", "float64"),
        _c("score", "float64"),
        _c("confidence", "float64"),
        _c("condition", "float64"),
        _c("weak_direction", "float64", (6,)),
        _c("iterations", "int32"),
        _c("events_used", unit="events"),
        _c("map_revision", "int32"),
        _c("keyframe", "int32"),
        _c("time_spent_s", "float64", unit="s"),
    ),
)
NOTES = Table(name="notes", columns=(_c("window"), *_TEXT))
KEYFRAMES = Table(
    name="keyframes", columns=(_AFTER, _c("keyframe"), _c("window"), _c("t_us", unit="us"), _POSE, *_IMAGE)
)
MAP_REVISIONS = Table(
    name="map_revisions",
    columns=(
        _AFTER,
        _c("revision"),
        _c("window"),
        _c("rows", "int32", unit="px"),
        _c("columns", "int32", unit="px"),
        _c("origin", "float64", (2,), "d_w"),
        _c("px_per_unit", "float64", unit="px/d_w"),
        _c("normal_world", "float64", (3,)),
        _c("distance", "float64", unit="d_w"),
        *_IMAGE,
    ),
)
REFINEMENTS = Table(
    name="refinements", columns=(_AFTER, _c("pose_first", unit="rows"), _c("pose_count", unit="rows"))
)
REFINED_POSES = Table(name="refined_poses", columns=(_c("window"), _POSE))
FAILURES = Table(
    name="failures",
    columns=(_AFTER, _c("cause", "uint8"), _c("start"), _c("end"), _c("worst"), *_TEXT),
)
LOG = Table(name="log", columns=(_AFTER, _c("window"), _c("level", "uint8"), *_TEXT))
BOOKMARKS = Table(name="bookmarks", columns=(_c("bookmark"), _c("deleted", "uint8"), _c("window"), *_TEXT))
TAGS = Table(name="tags", columns=_TEXT)
CHECKPOINTS = Table(
    name="checkpoints",
    columns=(
        _AFTER,
        _c("window"),
        _c("state_first", unit="bytes"),
        _c("state_count", unit="bytes"),
        _c("unpacked_count", unit="bytes"),
    ),
)
GROUND_TRUTH = Table(
    name="ground_truth", columns=(_c("t_us", unit="us"), _c("T_world_camera", "float64", (4, 4), "m"))
)
SUMMARIES = Table(name="summaries", columns=(_AFTER, *_TEXT))

TABLES: tuple[Table, ...] = (
    WINDOWS,
    NOTES,
    KEYFRAMES,
    MAP_REVISIONS,
    REFINEMENTS,
    REFINED_POSES,
    FAILURES,
    LOG,
    BOOKMARKS,
    TAGS,
    CHECKPOINTS,
    GROUND_TRUTH,
    SUMMARIES,
)
# Flat byte datasets: UTF-8 text, PNG images, packed tracker states.
BYTES: tuple[str, ...] = ("text", "images", "states")
# What a commit counts, in the order of its numbers.
COUNTED: tuple[str, ...] = (*(table.name for table in TABLES), *BYTES)


def dataset(file: h5py.File, place: str) -> h5py.Dataset:
    """Return a dataset that lies in this very file.

    Raises:
        ValueError: there is none; a link to another place or file is not followed.
    """
    if not isinstance(file.get(place, getlink=True), h5py.HardLink):
        raise ValueError(f"{place}: expected a dataset of this file")
    found = file[place]
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"{place}: expected a dataset")
    return found


def create_datasets(file: h5py.File, *, chunk_rows: int = CHUNK_ROWS, chunk_bytes: int = CHUNK_BYTES) -> None:
    """Create every dataset of the format, empty: once SWMR has started none can be added."""
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    for table in TABLES:
        group = file.create_group(table.name)
        for column in table.columns:
            rows = min(chunk_rows, _POSE_CHUNK_ROWS) if column.shape == (4, 4) else chunk_rows
            created = group.create_dataset(
                column.name,
                shape=(0, *column.shape),
                maxshape=(None, *column.shape),
                chunks=(rows, *column.shape),
                dtype=column.dtype,
            )
            created.attrs["unit"] = column.unit
    for name in BYTES:
        file.create_dataset(name, shape=(0,), maxshape=(None,), chunks=(chunk_bytes,), dtype=np.uint8)
