"""Commits: how many rows of each table are whole. What lies behind a commit's counts is as if it were not there.

The dataset `commit` has two slots that are written in turn, each with a checksum: whenever the writer is killed,
one of them is whole. A commit is written after the rows it counts have been flushed.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.session import schema
from dvsviz.session.schema import COUNTED


@dataclass(frozen=True, slots=True, kw_only=True)
class Commit:
    """A state of the file that is whole.

    Attributes:
        sequence: number of the commit, from 0.
        complete: whether the run ended and the session was closed.
        counts: rows of each table, bytes of each flat dataset.
    """

    sequence: int = 0
    complete: bool = False
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTED, 0))


def create_commits(file: h5py.File, commit: Commit) -> None:
    """Create the dataset `commit` with a first commit in both slots."""
    dataset = file.create_dataset("commit", data=np.stack([_encode(commit)] * 2))
    dataset.attrs["names"] = ["sequence", "complete", *COUNTED, "crc32"]


def write_commit(file: h5py.File, commit: Commit) -> None:
    """Write a commit into the slot that is not the last one's, and flush it."""
    dataset = schema.dataset(file, "commit")
    dataset[commit.sequence % 2] = _encode(commit)
    dataset.flush()


def read_commit(file: h5py.File) -> Commit | None:
    """Return the latest whole commit of an open session file, or None where no slot is whole.

    Raises:
        KeyError, TypeError, ValueError: the dataset is missing or of another layout.
    """
    dataset = schema.dataset(file, "commit")
    names = [str(name) for name in np.atleast_1d(np.asarray(dataset.attrs["names"]))]
    if (
        dataset.dtype != np.int64
        or dataset.shape != (2, len(names))
        or names[:2] + names[-1:]
        != [
            "sequence",
            "complete",
            "crc32",
        ]
    ):
        raise ValueError(f"commit: expected (2, {len(names)}) int64, got {dataset.shape} {dataset.dtype}")
    whole = [slot for slot in dataset[()] if int(slot[-1]) == _checksum(slot[:-1])]
    if not whole:
        return None
    last = max(whole, key=lambda slot: int(slot[0])).tolist()
    counts = dict.fromkeys(COUNTED, 0) | dict(zip(names[2:-1], last[2:-1], strict=True))
    if min(counts.values()) < 0:
        raise ValueError("commit: expected counts of at least 0")
    return Commit(sequence=last[0], complete=bool(last[1]), counts=counts)


def _encode(commit: Commit) -> NDArray[np.int64]:
    body = np.array([commit.sequence, commit.complete, *(commit.counts[name] for name in COUNTED)], dtype="<i8")
    return np.append(body, _checksum(body))


def _checksum(body: NDArray[np.int64]) -> int:
    return zlib.crc32(body.astype("<i8").tobytes())
