"""Which events, motion, pose and map make each picture of a window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dvsviz.events.windows import EventWindow
from dvsviz.geometry.plane import Plane
from dvsviz.view import images
from dvsviz.view.images import ImageKind, ImageOptions
from dvsviz.view.moving import MovingWindow, true_motion
from dvsviz.view.picture import Picture
from dvsviz.view.registration import registration_picture
from dvsviz.view.shown import ShownSession


def draw(shown: ShownSession, window: int, kind: ImageKind, options: ImageOptions) -> Picture | None:
    """Return one picture of a window, or None where it cannot be drawn.

    `warped` and `residual` show the window as the tracker had it: the pose and the map of that moment. `map` and
    `aligned` show it on the newest map, from the refined and from the true pose; `truth` is `warped` with the true
    motion.

    Args:
        shown: the session.
        window: number of the window.
        kind: what is drawn.
        options: how it is drawn; several windows are laid on each other by their poses.
    """
    if shown.registration is not None:
        return registration_picture(shown.registration, window, kind)
    if kind is ImageKind.TEXTURE:
        revision = shown.map_at(window)
        return None if revision is None else images.texture_picture(revision)
    events = shown.events_from(window, options.windows, options.ms)
    if not events:
        return _stored(shown, window) if kind is ImageKind.WARPED else None
    camera = shown.session.header.camera
    match kind:
        case ImageKind.RAW:
            return images.raw_picture(events, camera, options)
        case ImageKind.WARPED | ImageKind.RESIDUAL:
            moving = as_tracked(shown, events)
            T = shown.result(window).T_world_camera
            if kind is ImageKind.WARPED:
                plane = Plane(normal=shown.result(window).normal_world)
                return images.warped_picture(moving, T, plane, camera, options)
            return images.overlay_picture(moving, T, shown.map_at(window), camera, options, with_map=False)
        case ImageKind.MAP:
            # An older map lies on an older plane, and lacks what was seen since.
            poses = shown.poses()
            moving = as_tracked(shown, events, poses)
            return images.overlay_picture(moving, poses[window], shown.newest_map(poses[window]), camera, options)
        case ImageKind.TRUTH | ImageKind.ALIGNED:
            return _true_picture(shown, window, kind, events, options)


def as_tracked(
    shown: ShownSession, events: Sequence[EventWindow], poses: np.ndarray | None = None
) -> tuple[MovingWindow, ...]:
    """Return windows with the motion that the tracker found, at poses (N, 4, 4) of all windows or as it had them."""
    results = (shown.result(part.index) for part in events)
    return tuple(
        MovingWindow(
            window=part,
            T_world_camera=r.T_world_camera if poses is None else poses[part.index],
            omega=r.omega,
            velocity=r.velocity,
        )
        for part, r in zip(events, results, strict=True)
    )


def _true_picture(
    shown: ShownSession, window: int, kind: ImageKind, events: Sequence[EventWindow], options: ImageOptions
) -> Picture | None:
    truth = shown.errors().truth_world if shown.has_truth else None
    if truth is None:
        return None
    moving: list[MovingWindow] = []
    for part in events:
        # Of a stretch that ends inside a window the motion of the whole window is meant.
        result = shown.result(part.index)
        if (motion := true_motion(truth, result.start_us, result.end_us)) is not None:
            T, omega, velocity = motion
            moving.append(MovingWindow(window=part, T_world_camera=T, omega=omega, velocity=velocity))
    if not moving or moving[0].window.index != window:
        return None
    T, camera, revision = (
        moving[0].T_world_camera,
        shown.session.header.camera,
        shown.newest_map(moving[0].T_world_camera),
    )
    if kind is ImageKind.ALIGNED:
        return images.overlay_picture(moving, T, revision, camera, options)
    plane = Plane(normal=shown.result(window).normal_world)
    if revision is not None:
        plane = Plane(normal=revision.normal_world, distance=revision.distance)
    return images.warped_picture(moving, T, plane, camera, options)


def _stored(shown: ShownSession, window: int) -> Picture | None:
    """Return the image of a keyframe, of which the session keeps a small one."""
    image = next((k.image for k in shown.keyframes if k.window == window), None)
    return None if image is None else images.keyframe_picture(image)
