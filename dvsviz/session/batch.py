"""Records as rows: what a writer collects between two commits, and how it is appended to a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.session import schema
from dvsviz.session.packing import encode_png, pack_state
from dvsviz.session.records import (
    STATUSES,
    Keyframe,
    LogEntry,
    MapRevision,
    RefinedPoses,
    TrackerUpdates,
    WindowResult,
)

_TABLES = {table.name: table for table in schema.TABLES}


class Batch:
    """Rows and bytes to append, with the counts the file has once they are."""

    def __init__(self, counts: Mapping[str, int]) -> None:
        self.counts = dict(counts)
        self._start = dict(counts)
        self._rows: dict[str, list[tuple[Any, ...]]] = {}
        self._bytes: dict[str, list[bytes]] = {}

    def row(self, table: schema.Table, *values: Any) -> None:
        """Add one row, its values in the order of the table's columns."""
        if len(values) != len(table.columns):
            raise ValueError(f"{table.name}: expected {len(table.columns)} values, got {len(values)}")
        self._rows.setdefault(table.name, []).append(values)
        self.counts[table.name] += 1

    def bytes(self, name: str, data: bytes) -> tuple[int, int]:
        """Add bytes to a flat dataset and return where they lie: first byte and count."""
        first = self.counts[name]
        if data:
            self._bytes.setdefault(name, []).append(data)
            self.counts[name] += len(data)
        return first, len(data)

    def text(self, text: str) -> tuple[int, int]:
        """Add a text and return where it lies."""
        return self.bytes("text", text.encode("utf-8", "replace"))

    def append_to(self, file: h5py.File) -> None:
        """Append everything to a session file and flush it; a commit is for the caller."""
        for name, parts in self._bytes.items():
            _extend(schema.dataset(file, name), self._start[name], np.frombuffer(b"".join(parts), np.uint8))
        for name, rows in self._rows.items():
            for column, values in zip(_TABLES[name].columns, zip(*rows, strict=True), strict=True):
                data = np.array(values, dtype=column.dtype).reshape(len(rows), *column.shape)
                _extend(schema.dataset(file, f"{name}/{column.name}"), self._start[name], data)
        file.flush()


def _extend(dataset: h5py.Dataset, start: int, data: NDArray) -> None:
    # From `start`, not from the dataset's end: rows behind the last commit are nobody's.
    dataset.resize(start + len(data), axis=0)
    dataset[start:] = data


def add_result(batch: Batch, result: WindowResult) -> None:
    """Add one window."""
    batch.row(
        schema.WINDOWS,
        *(
            STATUSES.index(result.status) if column.name == "status" else getattr(result, column.name)
            for column in schema.WINDOWS.columns
        ),
    )
    if result.note:
        batch.row(schema.NOTES, result.window, *batch.text(result.note))


def add_updates(batch: Batch, updates: TrackerUpdates, after: int, images: dict[bytes, tuple[int, int]]) -> None:
    """Add keyframes, map revisions, failures and log lines; `add_refined` is for the refined poses.

    Args:
        batch: where they are added.
        updates: what a tracker made.
        after: windows stored before.
        images: the last map texture's bytes and their place: a texture that did not change is stored once.
    """
    for keyframe in updates.keyframes:
        _add_keyframe(batch, keyframe, after)
    for revision in updates.map_revisions:
        _add_map_revision(batch, revision, after, images)
    for failure in updates.failures:
        batch.row(
            schema.FAILURES,
            after,
            schema.CAUSES.index(failure.cause),
            failure.start,
            failure.end,
            failure.worst,
            *batch.text(failure.message),
        )
    for entry in updates.log:
        add_log(batch, entry, after)


def add_log(batch: Batch, entry: LogEntry, after: int) -> None:
    """Add one line of the log."""
    batch.row(schema.LOG, after, entry.window, schema.LEVELS.index(entry.level), *batch.text(entry.text))


def add_refined(batch: Batch, refined: RefinedPoses, after: int, poses: NDArray[np.float64]) -> None:
    """Add the poses that a refinement changed.

    Args:
        batch: where they are added.
        refined: the refinement.
        after: windows stored before.
        poses: every window's pose (N, 4, 4) as last refined; updated in place. What did not change is not stored.
    """
    windows = np.asarray(refined.windows, dtype=np.int64)
    Ts = np.asarray(refined.Ts_world_camera, dtype=np.float64)
    changed = np.any(poses[windows] != Ts, axis=(1, 2))
    poses[windows] = Ts
    first = batch.counts[schema.REFINED_POSES.name]
    for window, T in zip(windows[changed].tolist(), Ts[changed], strict=True):
        batch.row(schema.REFINED_POSES, window, T)
    batch.row(schema.REFINEMENTS, after, first, int(changed.sum()))


def add_checkpoint(batch: Batch, window: int, state: Mapping[str, NDArray], after: int) -> None:
    """Add a tracker's state."""
    data, unpacked = pack_state(state)
    batch.row(schema.CHECKPOINTS, after, window, *batch.bytes("states", data), unpacked)


def _add_keyframe(batch: Batch, keyframe: Keyframe, after: int) -> None:
    place = batch.bytes("images", encode_png(keyframe.image))
    batch.row(
        schema.KEYFRAMES, after, keyframe.keyframe, keyframe.window, keyframe.t_us, keyframe.T_world_camera, *place
    )


def _add_map_revision(
    batch: Batch, revision: MapRevision, after: int, images: dict[bytes, tuple[int, int]]
) -> None:
    png = encode_png(revision.texture)
    place = images.get(png)
    if place is None:
        place = batch.bytes("images", png)
        images.clear()
        images[png] = place
    batch.row(
        schema.MAP_REVISIONS,
        after,
        revision.revision,
        revision.window,
        *revision.texture.shape,
        revision.origin,
        revision.px_per_unit,
        revision.normal_world,
        revision.distance,
        *place,
    )
