"""A study: methods times frame skips on one sequence, each with its errors, counts and times."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from dvsviz.errors import EvaluationError
from dvsviz.registration.errors import StepErrors, absolute_errors, relative_errors
from dvsviz.registration.features import FeatureKind
from dvsviz.registration.frames import FrameSequence
from dvsviz.registration.methods import WITHOUT_DEPTH
from dvsviz.registration.odometry import FeatureTable, Odometry, run_odometry
from dvsviz.registration.records import RegistrationConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyRow:
    """One method at one frame skip: one line of the table.

    Attributes:
        method: name of the method.
        skip: frames from one registered frame to the next.
        mode: `frames`, `keyframes`, `frames+loops` or `keyframes+loops`.
        registered: steps that were registered.
        failures: steps for which the method found no motion (counted as no motion in the errors).
        scale: where the lengths come from: depth, motion or unit; mixed where steps differ.
        matches: mean matches a step.
        inliers: mean inliers a step.
        loops: loop closures used.
        relative_rotation_rad: mean relative rotation error.
        relative_rotation_std_rad: its standard deviation.
        relative_translation_m: mean relative translation error.
        relative_translation_std_m: its standard deviation.
        absolute_rotation_rad: mean absolute rotation error.
        absolute_rotation_std_rad: its standard deviation.
        absolute_translation_m: mean absolute translation error.
        absolute_translation_std_m: its standard deviation.
        features_s: seconds of detection and matching, mean a registered frame.
        points_s: seconds of finding 3-D points.
        method_s: seconds of the method.
    """

    method: str
    skip: int
    mode: str
    registered: int
    failures: int
    scale: str
    matches: float
    inliers: float
    loops: int
    relative_rotation_rad: float
    relative_rotation_std_rad: float
    relative_translation_m: float
    relative_translation_std_m: float
    absolute_rotation_rad: float
    absolute_rotation_std_rad: float
    absolute_translation_m: float
    absolute_translation_std_m: float
    features_s: float
    points_s: float
    method_s: float

    @property
    def total_s(self) -> float:
        """Seconds a registered frame."""
        return self.features_s + self.points_s + self.method_s

    def to_dict(self) -> dict[str, str | int | float | None]:
        """Return the row with `total_s`; numbers that are not known are None."""
        values = asdict(self) | {"total_s": self.total_s}
        return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in values.items()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyRun:
    """A row with what it was made of, for plots and sessions.

    Attributes:
        row: the line of the table.
        odometry: the trajectory and its steps.
        relative: relative errors of each step; None without ground truth.
        absolute: absolute errors of each step; None without ground truth.
    """

    row: StudyRow
    odometry: Odometry
    relative: StepErrors | None
    absolute: StepErrors | None


def study(
    sequence: FrameSequence,
    methods: Sequence[str],
    skips: Sequence[int] = (1,),
    *,
    features: FeatureKind = "sift",
    keyframes: bool = False,
    loop_closure: bool = False,
    speed: float | None = None,
    config: RegistrationConfig | None = None,
    clock: Callable[[], float] = time.perf_counter,
    progress: Callable[[float], None] | None = None,
) -> list[StudyRun]:
    """Return one run for each method at each skip, and with keyframes or loops a second one beside the plain one.

    Args:
        sequence: the frames; with depth for methods that need it.
        methods: keys of `methods.METHODS`.
        skips: frames from one registered frame to the next.
        features: what is matched.
        keyframes: also run keyframe-based registration.
        loop_closure: also run with loop closure.
        speed: metres a second: the scale of methods that nothing else gives.
        config: thresholds.
        clock: what times are measured by; `time.process_time` on a machine that does other things meanwhile.
        progress: told the share that is done, 0 to 1.

    Raises:
        EvaluationError: ground truth covers fewer than two of the frames.
    """
    truth = sequence.ground_truth
    first, end = 0, len(sequence.t_us)
    if truth is not None:
        covered = np.flatnonzero(truth.covers(sequence.t_us))
        if len(covered) < 2:
            raise EvaluationError("the ground truth covers fewer than two frames", hint="check both clocks")
        first, end = int(covered[0]), int(covered[-1]) + 1
    modes = [(False, False)]
    if keyframes or loop_closure:
        modes.append((keyframes, loop_closure))
    table = FeatureTable(sequence, features, clock)
    jobs = [(m, s, mode) for s in skips for m in methods for mode in (modes if m != "none" else modes[:1])]
    runs = []
    for done, (method, skip, (with_keyframes, with_loops)) in enumerate(jobs):
        odometry = run_odometry(
            table,
            method,
            skip=skip,
            first=first,
            end=end,
            keyframes=with_keyframes,
            loop_closure=with_loops,
            speed=speed if method in WITHOUT_DEPTH else None,
            config=config,
        )
        mode = ("keyframes" if with_keyframes else "frames") + ("+loops" if with_loops else "")
        runs.append(_run(sequence, odometry, skip, mode))
        if progress is not None:
            progress((done + 1) / len(jobs))
    return runs


def _run(sequence: FrameSequence, odometry: Odometry, skip: int, mode: str) -> StudyRun:
    relative = absolute = None
    if sequence.ground_truth is not None:
        true = sequence.ground_truth.at(odometry.trajectory.t_us).Ts_world_camera
        relative = relative_errors(odometry.trajectory.Ts_world_camera, true)
        absolute = absolute_errors(odometry.trajectory.Ts_world_camera, true)
    steps = odometry.steps
    scales = {step.registration.scale for step in steps if step.registration.is_found}
    missing = dict.fromkeys(
        ("rotation_rad", "rotation_std_rad", "translation_m", "translation_std_m"), float("nan")
    )
    row = StudyRow(
        method=odometry.method,
        skip=skip,
        mode=mode,
        registered=len(steps),
        failures=sum(not step.registration.is_found for step in steps),
        scale="none" if not scales else scales.pop() if len(scales) == 1 else "mixed",
        matches=float(np.mean([len(step.pairs) for step in steps])),
        inliers=float(np.mean([step.registration.inlier_count for step in steps])),
        loops=odometry.loops,
        **{f"relative_{k}": v for k, v in (relative.summary() if relative else missing).items()},
        **{f"absolute_{k}": v for k, v in (absolute.summary() if absolute else missing).items()},
        features_s=float(np.mean([step.timing.features_s for step in steps])),
        points_s=float(np.mean([step.timing.points_s for step in steps])),
        method_s=float(np.mean([step.timing.method_s for step in steps])),
    )
    return StudyRun(row=row, odometry=odometry, relative=relative, absolute=absolute)
