"""Copying what is whole in a session file into a new one: recovery after a kill, and edits."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.session import schema
from dvsviz.session.commits import Commit, create_commits
from dvsviz.session.reading import read_column, read_flat, read_table

# Bytes copied at a time.
_SLAB_BYTES = 16 << 20
# HDF5 1.10's layout: the first with SWMR, so that every HDF5 since 2016 can read the file.
_LIBVER = "v110"
# What a registration of frames keeps beside its windows: it belongs to the whole session and never grows.
REGISTRATION = "registration"


def create_file(
    path: Path, fill: Callable[[h5py.File], None], commit: Commit, *, chunk_rows: int = schema.CHUNK_ROWS
) -> h5py.File:
    """Return a new session file, ready for a writer: SWMR has started.

    Args:
        path: a temporary name; the file is to be renamed when it is ready, so that whoever sees its final name
            can open it.
        fill: writes the header.
        commit: the first commit.
        chunk_rows: rows of a chunk.
    """
    file = h5py.File(path, "w", libver=(_LIBVER, _LIBVER))
    fill(file)
    # Tells a reader that the file under a name has been replaced: inode numbers are used again.
    file.attrs["file_id"] = secrets.token_hex(8)
    chunk_bytes = min(schema.CHUNK_BYTES, chunk_rows * 64)
    schema.create_datasets(file, chunk_rows=chunk_rows, chunk_bytes=chunk_bytes)
    create_commits(file, commit)
    file.flush()
    file.swmr_mode = True
    return file


def partial_name(path: Path) -> Path:
    """Return the temporary name beside a session file, one a process."""
    return path.with_name(f"{path.name}.{os.getpid()}.partial")


def copy_header(source: h5py.File) -> Callable[[h5py.File], None]:
    """Return a `fill` that copies another session file's attributes."""

    def fill(file: h5py.File) -> None:
        for name in source.attrs:
            file.attrs[name] = source.attrs[name]
        camera = file.create_group("camera")
        for name in source["camera"].attrs:
            camera.attrs[name] = source["camera"].attrs[name]
        if REGISTRATION in source:
            source.copy(REGISTRATION, file)

    return fill


def cut(source: h5py.File, commit: Commit, windows: int | None) -> dict[str, int]:
    """Return the counts of rows that belong to the first `windows` windows (None: all that were committed)."""
    counts = dict(commit.counts)
    if windows is None or windows >= counts[schema.WINDOWS.name]:
        return counts
    counts[schema.WINDOWS.name] = windows
    for table in schema.TABLES:
        if any(column.name == "after" for column in table.columns):
            after = read_column(source, table, "after", 0, counts[table.name])
            counts[table.name] = int(np.searchsorted(after, windows, side="right"))
    notes = read_column(source, schema.NOTES, "window", 0, counts[schema.NOTES.name])
    counts[schema.NOTES.name] = int(np.searchsorted(notes, windows, side="left"))
    if (n := counts[schema.REFINEMENTS.name]) > 0:
        last = read_table(source, schema.REFINEMENTS, n - 1, n)
        kept = int(last["pose_first"][0] + last["pose_count"][0])
        counts[schema.REFINED_POSES.name] = min(kept, counts[schema.REFINED_POSES.name])
    else:
        counts[schema.REFINED_POSES.name] = 0
    return counts


def copy_rows(source: h5py.File, target: h5py.File, counts: dict[str, int]) -> None:
    """Copy the first rows of every table and the first bytes of every flat dataset, and flush."""
    for table in schema.TABLES:
        for column in table.columns:
            read = partial(read_column, source, table, column.name)
            _copy(read, schema.dataset(target, f"{table.name}/{column.name}"), counts[table.name])
    for name in schema.BYTES:
        _copy(partial(read_flat, source, name), schema.dataset(target, name), counts[name])
    target.flush()


def _copy(read: Callable[[int, int], NDArray], target: h5py.Dataset, rows: int) -> None:
    row_bytes = target.dtype.itemsize * int(np.prod(target.shape[1:], dtype=np.int64))
    slab = max(1, _SLAB_BYTES // row_bytes)
    for start in range(0, rows, slab):
        end = min(rows, start + slab)
        data = read(start, end)
        target.resize(end, axis=0)
        target[start:end] = data
