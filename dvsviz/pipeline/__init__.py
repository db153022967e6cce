"""The composition root: a recording is tracked, and what comes out is appended to a session."""

from dvsviz.pipeline.branch import Branch, branch
from dvsviz.pipeline.run import CHECKPOINT_US, Progress, track
from dvsviz.pipeline.stream import track_stream
from dvsviz.pipeline.summary import evaluation_of, events_kept, summarize

__all__ = [
    "CHECKPOINT_US",
    "Branch",
    "Progress",
    "branch",
    "evaluation_of",
    "events_kept",
    "summarize",
    "track",
    "track_stream",
]
