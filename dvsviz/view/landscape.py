"""The landscape of a window's objective, in the units that people read, computed beside the seeks."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.iwe import sample_indices
from dvsviz.contrast.kernels import sample
from dvsviz.contrast.landscape import Grid, contrast_landscape, edge_image, map_landscape
from dvsviz.errors import DvsvizError
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import Plane, homography_map_camera
from dvsviz.session.records import MapRevision, WindowResult
from dvsviz.view.moving import true_motion
from dvsviz.view.playback import Mailbox
from dvsviz.view.shown import ShownSession

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

# 33 by 33 cells of 8,000 events take 0.4 s of one core, whatever the sensor (benchmarks/landscape.py); 17 by 17 cells,
# which are sent first, a quarter of it.
CELLS = (17, 33)
MOST_EVENTS = 8_000
# The centre's surroundings, as displacement of the image's edge in px; wider where prior or truth lie outside.
_REACH_PX = {"variance": 12.0, "gradient": 12.0, "map": 14.0}
_WIDER = 5.0
_DEG = 180 / np.pi
_NAMES = (
    "rotation about x",
    "rotation about y",
    "rotation about z",
    "motion along x",
    "motion along y",
    "motion along z",
)
_REASONS = (DvsvizError, OSError, ValueError, RuntimeError, IndexError, KeyError)


class Objective(StrEnum):
    """What the landscape is of."""

    VARIANCE = "variance"
    GRADIENT = "gradient"
    MAP = "map"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandscapeWish:
    """A landscape that is wanted.

    Attributes:
        shown: the session.
        window: number of the window.
        request: the asker's number, given back with the answer.
        objective: of the window's velocities (`variance`, `gradient`) or of its pose (`map`).
        axes: the two parameters (0 to 5): rotation about x, y, z, motion along x, y, z, camera frame.
        zoom: how much wider than usual, 0.05 to 20.
    """

    shown: ShownSession
    window: int
    request: int
    objective: Objective
    axes: tuple[int, int]
    zoom: float = 1.0


def landscape(
    wish: LandscapeWish, cells: int, cancelled: Callable[[], bool] = lambda: False
) -> dict[str, Any] | None:
    """Return a slice of the objective, ready for JSON; None where it was cancelled.

    `values` are rows from the least to the greatest value of the second axis. Places (`estimate`, `prior`, `truth`,
    `best`) are in the axes' units: `prior` is the previous window's motion carried on, `truth` is laid on the slice.

    Args:
        wish: what is wanted.
        cells: how many along each axis.
        cancelled: asked again and again.

    Raises:
        DvsvizError: the window has no events, or there is no map yet.
    """
    shown, r = wish.shown, wish.shown.result(wish.window)
    parts = shown.events_from(wish.window, 1, 0)
    if not parts or len(parts[0]) < 2:
        raise DvsvizError(shown.missing or "the window has no events")
    window, camera = parts[0], shown.session.header.camera
    started = time.perf_counter()
    centre = np.concatenate([r.omega, r.velocity])
    if not np.isfinite(centre).all() or not np.isfinite(r.T_world_camera).all():
        raise DvsvizError("this window has no estimate to look around from")
    prior, truth = (
        mark if mark is not None and np.isfinite(mark).all() else None for mark in _marks(shown, r, wish.objective)
    )
    plane = Plane(normal=r.normal_world).seen_from(r.T_world_camera)
    if not plane.distance > 1e-3:
        raise DvsvizError("the pose lies behind the plane: there is nothing to turn it about")
    rate = _px_per_unit(camera, plane.distance)
    if wish.objective is not Objective.MAP:
        rate = rate * max(1e-3, window.duration_s)
    a, b = wish.axes
    span = [_span(_REACH_PX[wish.objective] / rate[k], k, prior, truth) * wish.zoom for k in (a, b)]
    grid = Grid.around(wish.axes, (span[0], span[1]), cells)
    pick = sample_indices(window, MOST_EVENTS, 0)
    bearings, t_s = window.bearings[pick], window.t_s[pick]
    if wish.objective is Objective.MAP:
        values = _on_map(shown, r, bearings, t_s, centre, grid, camera, cancelled)
    else:
        weights = np.where(window.events.is_positive[pick], np.float32(1), np.float32(-1))
        measure = "gradient" if wish.objective is Objective.GRADIENT else "variance"
        values = contrast_landscape(
            bearings, t_s, weights, camera, centre, plane, grid, measure=measure, cancelled=cancelled
        )
    if values is None:
        return None
    base = np.zeros(6) if wish.objective is Objective.MAP else centre
    unit = np.array([_DEG] * 3 + [1.0] * 3)
    top = None if np.all(np.isnan(values)) else np.unravel_index(int(np.nanargmax(values)), values.shape)

    def place(offset: Array | None) -> list[float] | None:
        return None if offset is None else [float((base + offset)[k] * unit[k]) for k in (a, b)]

    return {
        "window": wish.window,
        "request": wish.request,
        "session": shown.name,
        "objective": str(wish.objective),
        "axes": [_axis(k, wish.objective, base, unit, span[i]) for i, k in enumerate((a, b))],
        "cells": cells,
        "values": [[float(f"{v:.6g}") if np.isfinite(v) else None for v in row] for row in values],
        "estimate": place(np.zeros(6)),
        "prior": place(prior),
        "truth": place(truth),
        "best": None if top is None else place(grid.row(int(top[0]))[int(top[1])]),
        "at_estimate": _finite(values[cells // 2, cells // 2]),
        "at_best": None if top is None else _finite(values[top]),
        "events": len(t_s),
        "of_events": len(window),
        "milliseconds": round(1000 * (time.perf_counter() - started), 1),
        "final": cells == CELLS[-1],
    }


class LandscapeWorker(threading.Thread):
    """Computes what is wanted last, coarse and then fine; a new wish, or a playhead that moved, ends the one before.

    Args:
        name: of the thread.
        tell: gets each answer.
    """

    def __init__(self, name: str, tell: Callable[[dict[str, Any]], None]) -> None:
        super().__init__(name=name, daemon=True)
        self.mailbox: Mailbox[LandscapeWish] = Mailbox()
        self._tell = tell
        self._now: LandscapeWish | None = None
        self._dropped = threading.Event()

    def want(self, wish: LandscapeWish) -> None:
        """Compute this one next."""
        self.mailbox.put(wish)

    def moved(self, shown: ShownSession, window: int) -> None:
        """Drop what is under way where it is of another window."""
        now = self._now
        if now is not None and (now.shown is not shown or now.window != window):
            self._dropped.set()

    def run(self) -> None:
        """Compute until the mailbox is closed."""
        while not self.mailbox.is_closed:
            wish = self.mailbox.take()
            if wish is None:
                continue
            self._dropped.clear()
            self._now = wish
            try:
                for cells in CELLS:
                    answer = landscape(wish, cells, self._is_over)
                    if answer is None or self._is_over():
                        break
                    self._tell(answer)
            except _REASONS as error:
                _log.info("no landscape of window %d of %s: %s", wish.window, wish.shown.name, error)
                self._tell(
                    {
                        "request": wish.request,
                        "window": wish.window,
                        "session": wish.shown.name,
                        "error": str(error),
                    }
                )
            self._now = None

    def _is_over(self) -> bool:
        return self._dropped.is_set() or not self.mailbox.is_empty or self.mailbox.is_closed


def _on_map(
    shown: ShownSession,
    r: WindowResult,
    bearings: NDArray[np.float32],
    t_s: Array,
    motion: Array,
    grid: Grid,
    camera: Camera,
    cancelled: Callable[[], bool],
) -> Array | None:
    """Return the agreement with the map of that moment around the pose of that moment."""
    revision = shown.map_at(r.window)
    if revision is None:
        raise DvsvizError("there is no map yet at this window")
    plane = Plane(normal=revision.normal_world, distance=revision.distance)
    k, (u0, v0) = revision.px_per_unit, revision.origin
    target = np.array([[k, 0.0, -k * u0], [0.0, k, -k * v0], [0.0, 0.0, 1.0]])
    edges = edge_image(revision.texture)
    chance = _chance(revision, edges, plane, target, r.T_world_camera, camera)
    return map_landscape(
        bearings, t_s, r.T_world_camera, motion, plane, edges, target, chance, grid, cancelled=cancelled
    )


def _chance(
    revision: MapRevision,
    edges: NDArray[np.float32],
    plane: Plane,
    target: Array,
    T_world_camera: Array,
    camera: Camera,
) -> float:
    """Return the mean of a map's edges where a camera looks."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 48), np.linspace(0, camera.height - 1, 36))
    q = np.column_stack([(x.ravel() - camera.cx) / camera.fx, (y.ravel() - camera.cy) / camera.fy, np.ones(x.size)])
    p = q @ (target @ homography_map_camera(T_world_camera, plane)).T
    ahead = p[:, 2] > 1e-9
    values = sample((p[ahead, :2] / p[ahead, 2:]).astype(np.float32), edges, np.float32(-1.0))
    return float(values[values >= 0].mean()) if np.any(values >= 0) else 0.0


def _marks(shown: ShownSession, r: WindowResult, objective: Objective) -> tuple[Array | None, Array | None]:
    """Return prior and truth as offsets (6,) from the estimate: of the velocities, or (`map`) of the pose."""
    before = shown.result(r.window - 1) if r.window else None
    truth = shown.errors().truth_world if shown.has_truth else None
    motion = None if truth is None else true_motion(truth, r.start_us, r.end_us)
    estimate = np.concatenate([r.omega, r.velocity])
    if objective is not Objective.MAP:
        prior = None if before is None else np.concatenate([before.omega, before.velocity]) - estimate
        return prior, None if motion is None else np.concatenate(motion[1:]) - estimate

    def apart(T: Array) -> Array:
        D = se3.inverse(r.T_world_camera) @ T
        return np.concatenate([se3.log_so3(D[:3, :3]), D[:3, 3]])

    prior = None
    if before is not None:
        dt_s = (r.start_us - before.start_us) * 1e-6
        prior = apart(se3.propagate(before.T_world_camera, before.omega, before.velocity, dt_s))
    return prior, None if motion is None else apart(motion[0])


def _px_per_unit(camera: Camera, distance: float) -> Array:
    """Return how far (px) the image's edge moves per unit of each parameter (rad, plane distances)."""
    f = 0.5 * (camera.fx + camera.fy)
    corner = 0.5 * float(np.hypot(camera.width, camera.height))
    return np.array([f, f, corner, f / distance, f / distance, corner / distance])


def _span(usual: float, axis: int, *marks: Array | None) -> float:
    """Return how far a slice reaches along an axis: as usual, or a little over the farthest mark."""
    farthest = max((abs(float(mark[axis])) for mark in marks if mark is not None), default=0.0)
    return min(max(usual, 1.2 * farthest), _WIDER * usual)


def _axis(axis: int, objective: Objective, base: Array, unit: Array, span: float) -> dict[str, Any]:
    words = ("°", "d") if objective is Objective.MAP else ("°/s", "d/s")
    middle, reach = float(base[axis] * unit[axis]), float(span * unit[axis])
    return {
        "axis": axis,
        "name": _NAMES[axis],
        "unit": words[axis // 3],
        "from": middle - reach,
        "to": middle + reach,
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
