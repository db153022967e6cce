"""Pictures of a registration of frames: matches on the frame and on the pair, depth, and the errors of all methods."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.evaluate.chart import Chart, Line, to_png
from dvsviz.session.registration import RegistrationRecord, StoredStep
from dvsviz.view.images import ImageKind
from dvsviz.view.picture import Picture
from dvsviz.view.registration_colours import INLIER_RGB, OUTLIER_RGB, method_colours

_GREYS = 200
_INLIER, _OUTLIER, _JOINT = 250, 251, 252
_NEAR_M, _FAR_M = 0.4, 5.0
_CHART_PX = (640, 240)


def registration_picture(record: RegistrationRecord, window: int, kind: ImageKind) -> Picture | None:
    """Return one picture of a registered frame, or None where there is none of this kind.

    Args:
        record: the registration.
        window: number of the frame among the registered ones.
        kind: `WARPED` for the frame with its matches, `RAW` for the pair, `MAP` for depth, `TEXTURE` for the errors.
    """
    match kind:
        case ImageKind.WARPED:
            image = _grey(record, window)
            if window:
                _draw_matches(image, record.steps[window - 1])
            return Picture(pixels=image, palette=_grey_palette())
        case ImageKind.RAW:
            return _pair(record, window)
        case ImageKind.MAP:
            return _depth(record, window)
        case ImageKind.TEXTURE:
            return _errors(record, window)
        case _:
            return None


def _grey(record: RegistrationRecord, window: int) -> NDArray[np.uint8]:
    image = cv2.imdecode(np.frombuffer(record.frames[window].grey, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"frame {window} cannot be decoded")
    return (image.astype(np.uint16) * (_GREYS - 1) // 255).astype(np.uint8)


def _grey_palette() -> NDArray[np.uint8]:
    # The image is dimmed: the matches are what is looked at.
    palette = np.zeros((256, 3), np.uint8)
    palette[:_GREYS] = np.linspace(0, 190, _GREYS).astype(np.uint8)[:, None]
    palette[_INLIER], palette[_OUTLIER], palette[_JOINT] = INLIER_RGB, OUTLIER_RGB, (90, 100, 110)
    return palette


def _draw_matches(image: NDArray[np.uint8], step: StoredStep) -> None:
    """Draw the way of each matched point from the other frame to this one; a dot is where it is now."""
    for mask, value in ((~step.is_inlier, _OUTLIER), (step.is_inlier, _INLIER)):
        for a, b in zip(step.pixels_a[mask], step.pixels_b[mask], strict=True):
            cv2.line(image, _at(a), _at(b), value, 1)
            cv2.circle(image, _at(b), 2, value, -1)


def _pair(record: RegistrationRecord, window: int) -> Picture:
    """Return the frame that was registered against beside this one, matched points joined."""
    step = record.steps[window - 1] if window else None
    left = _grey(record, step.against if step is not None else window)
    right = _grey(record, window)
    image = np.concatenate([left, np.full((left.shape[0], 4), _JOINT, np.uint8), right], axis=1)
    if step is not None:
        shift = np.array([left.shape[1] + 4, 0])
        for mask, value in ((~step.is_inlier, _OUTLIER), (step.is_inlier, _INLIER)):
            # A few dozen lines can be followed by eye; all points have their dot.
            chosen = np.flatnonzero(mask)
            for k in chosen:
                cv2.circle(image, _at(step.pixels_a[k]), 2, value, -1)
                cv2.circle(image, _at(step.pixels_b[k] + shift), 2, value, -1)
            for k in chosen[:: max(1, len(chosen) // 40)]:
                cv2.line(image, _at(step.pixels_a[k]), _at(step.pixels_b[k] + shift), value, 1)
    return Picture(pixels=image, palette=_grey_palette())


def _depth(record: RegistrationRecord, window: int) -> Picture | None:
    """Return the depth in colours from near (warm) to far (cold); black where none was measured."""
    data = record.frames[window].depth
    if data is None:
        return None
    depth = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if depth is None:
        raise ValueError(f"the depth of frame {window} cannot be decoded")
    share = np.clip((depth / 1000 - _NEAR_M) / (_FAR_M - _NEAR_M), 0, 1)
    pixels = np.where(depth > 0, 1 + (254 * (1 - share)).astype(np.uint8), 0).astype(np.uint8)
    colours = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    palette = np.array(colours, dtype=np.uint8)
    palette[0] = 0
    return Picture(pixels=pixels, palette=palette)


def _errors(record: RegistrationRecord, window: int) -> Picture | None:
    """Return the absolute errors of all methods over time, with this frame marked; None without ground truth."""
    run = record.shown_run
    colours = method_colours(record)
    t_s = (run.t_us - run.t_us[0]) * 1e-6
    charts = []
    for column, title in ((3, "position error (m)"), (2, "rotation error (rad)")):
        lines = [
            Line(name=other.name, x=t_s[1:], y=other.errors[:, column], rgb=colours[other.name])
            for other in record.runs
            if other.skip == run.skip and len(other.errors) == len(t_s) - 1 and np.isfinite(other.errors).any()
        ]
        if not lines:
            return None
        known = np.concatenate([line.y[np.isfinite(line.y) & (line.y > 0)] for line in lines])
        ends = np.array([known.min(), known.max()])
        here = Line(name="this frame", x=np.full(2, t_s[window]), y=ends, rgb=(20, 20, 20), dashed=True)
        charts.append(Chart(title=title, x_label="time (s)", y_label="", lines=(*lines, here), log_y=True))
    data = to_png(charts, width=_CHART_PX[0], height=_CHART_PX[1])
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise ValueError("the chart cannot be decoded")
    # A cube of 6 x 6 x 6 colours.
    levels = np.round(image.astype(np.float32) / 51).astype(np.uint8)
    pixels = levels[..., 0] * 36 + levels[..., 1] * 6 + levels[..., 2]
    palette = np.zeros((256, 3), np.uint8)
    number = np.arange(216)
    palette[:216] = np.stack([number // 36, number // 6 % 6, number % 6], axis=1) * 51
    return Picture(pixels=pixels.astype(np.uint8), palette=palette)


def _at(pixel: NDArray[np.float32]) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))
