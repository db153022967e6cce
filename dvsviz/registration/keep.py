"""What of a study is kept: the record that sessions and exports are made of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from dvsviz.errors import DvsvizError
from dvsviz.geometry import se3
from dvsviz.registration.features import FeatureKind, depth_at, detect
from dvsviz.registration.frames import Frame, FrameSequence
from dvsviz.registration.odometry import Step
from dvsviz.registration.records import homogeneous
from dvsviz.registration.study import StudyRun
from dvsviz.session.registration import RegistrationRecord, StoredFrame, StoredRun, StoredStep

_JPEG_QUALITY = 88


def registration_record(
    sequence: FrameSequence, runs: Sequence[StudyRun], *, source: Path, features: FeatureKind = "sift"
) -> RegistrationRecord:
    """Return what is kept of a study; the run that is shown frame by frame is the one nearest to the truth.

    Without ground truth it is the one with the most inliers.

    Args:
        sequence: the frames.
        runs: of `study`, one at least.
        source: where the frames are.
        features: what was matched.
    """
    primary = _primary(runs)
    odometry = runs[primary].odometry
    images = [sequence.read(int(frame)) for frame in odometry.frames]
    number = {int(frame): k for k, frame in enumerate(odometry.frames)}
    found = [detect(image, sequence.camera, kind=features) for image in images]
    steps = []
    for k, step in enumerate(odometry.steps):
        against = number[step.against]
        pixels_a = found[against].pixels[step.pairs[:, 0]]
        pixels_b = found[k + 1].pixels[step.pairs[:, 1]]
        steps.append(_step(step, against, images[k + 1], sequence, pixels_a, pixels_b))
    depths = [float(np.nanmedian(i.depth)) for i in images if i.depth is not None and np.isfinite(i.depth).any()]
    return RegistrationRecord(
        source=source,
        camera=sequence.camera,
        features=features,
        runs=tuple(_run(run) for run in runs),
        primary=primary,
        frames=tuple(_frame(image) for image in images),
        steps=tuple(steps),
        truth=sequence.ground_truth,
        mean_depth=float(np.mean(depths)) if depths else None,
    )


def _primary(runs: Sequence[StudyRun]) -> int:
    def badness(k: int) -> tuple[bool, float]:
        row = runs[k].row
        error = row.absolute_translation_m
        return row.method == "none", error if np.isfinite(error) else -row.inliers

    return min(range(len(runs)), key=badness)


def _run(run: StudyRun) -> StoredRun:
    trajectory, row = run.odometry.trajectory, run.row
    errors = np.full((len(trajectory) - 1, 4), np.nan)
    if run.relative is not None and run.absolute is not None:
        columns = (run.relative.rotation_rad, run.relative.translation_m)
        errors = np.column_stack([*columns, run.absolute.rotation_rad, run.absolute.translation_m])
    first = se3.inverse(trajectory.Ts_world_camera[0])
    return StoredRun(
        name=row.method if row.mode == "frames" else f"{row.method} ({row.mode})",
        skip=row.skip,
        t_us=trajectory.t_us,
        Ts_world_camera=first @ trajectory.Ts_world_camera,
        errors=errors,
        row=row.to_dict(),
    )


def _step(
    step: Step, against: int, image: Frame, sequence: FrameSequence, pixels_a: np.ndarray, pixels_b: np.ndarray
) -> StoredStep:
    inliers = step.registration.inliers
    depth = depth_at(image, pixels_b[inliers])
    rays = homogeneous(sequence.camera.bearings(pixels_b[inliers]))
    points = (rays * depth[:, None])[np.isfinite(depth)]
    return StoredStep(
        against=against,
        pixels_a=pixels_a.astype(np.float32),
        pixels_b=pixels_b.astype(np.float32),
        is_inlier=inliers,
        points=points.astype(np.float32),
        reason=step.registration.reason,
    )


def _frame(image: Frame) -> StoredFrame:
    grey = _encoded(".jpg", image.grey, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    depth = None
    if image.depth is not None:
        mm = np.where(np.isfinite(image.depth), np.clip(image.depth * 1000, 0, 65535), 0)
        depth = _encoded(".png", np.round(mm).astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return StoredFrame(grey=grey, depth=depth)


def _encoded(kind: str, image: np.ndarray, options: list[int]) -> bytes:
    done, data = cv2.imencode(kind, image, options)
    if not done:
        raise DvsvizError("an image cannot be encoded")
    return data.tobytes()
