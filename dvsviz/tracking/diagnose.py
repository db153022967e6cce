"""What a window's numbers say: agreement with the map beyond chance, overlap, weak directions in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.camera import Camera
from dvsviz.geometry.plane import homography_map_camera, rotation_to_map
from dvsviz.tracking import constants as c
from dvsviz.tracking.align import Agreement, Alignment
from dvsviz.tracking.kernels import explained_share, footprint_mean, slope_tensor
from dvsviz.tracking.measure import WindowImages
from dvsviz.tracking.planar_map import PlanarMap

Array = NDArray[np.float64]

_FOOTPRINT_COLUMNS = 48
_OVERLAP_PIXELS = 20

_AXES = (
    "rotation about x (pitch)",
    "rotation about y (yaw)",
    "rotation about z (roll)",
    "motion along x",
    "motion along y",
    "motion along z",
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judgement:
    """What the tracker thinks of a window.

    Attributes:
        score: chance-normalised agreement with the map.
        confidence: 0 to 1.
        condition: condition number of the pose.
        weak_direction: (6,).
        note: a sentence, or "".
        is_trusted: True where the window may write to the map.
    """

    score: float
    confidence: float
    condition: float
    weak_direction: Array
    note: str
    is_trusted: bool = False

    @classmethod
    def unknown(cls) -> Judgement:
        """Return the judgement of a window that was not aligned with a map."""
        nan = float("nan")
        return cls(score=nan, confidence=0.0, condition=nan, weak_direction=np.zeros(6), note="")


def confidence(ratio: float, condition: float, inside: float) -> float:
    """Return a confidence (0 to 1) from the score's ratio to good scores, the condition and the share inside."""
    by_score = 1.0 / (1.0 + np.exp(np.clip(-12.0 * (ratio - c.WEAK_RATIO), -50.0, 50.0)))
    by_condition = 1.0 / (1.0 + condition / c.WEAK_CONDITION)
    return float(np.clip(by_score * by_condition * min(1.0, inside / 0.8), 0.0, 1.0))


def agreement(planar_map: PlanarMap, alignment: Alignment, camera: Camera) -> Agreement:
    """Return the chance-normalised agreement of an aligned window.

    Args:
        planar_map: the map that it was aligned with.
        alignment: of the window.
        camera: gives the footprint.
    """
    if alignment.agreed is not None:
        return alignment.agreed
    chance, inside = seen_by_chance(planar_map, alignment.T_world_camera, camera, _FOOTPRINT_COLUMNS)
    return Agreement(score=(alignment.value - chance) / max(1e-3, 1.0 - chance), chance=chance, inside=inside)


def seen_by_chance(
    planar_map: PlanarMap, T_world_camera: Array, camera: Camera, columns: int
) -> tuple[float, float]:
    """Return the mean of the finest edge image over what a view sees of the map, and how much of it is seen.

    Args:
        planar_map: the map.
        T_world_camera: pose (4, 4).
        camera: gives the view.
        columns: pixels sampled along the width.
    """
    H = planar_map.projection @ homography_map_camera(T_world_camera, planar_map.plane)
    return footprint_mean(
        planar_map.level(-1),
        planar_map.exposure,
        c.EXPOSURE_CELL_PX,
        H,
        camera.matrix,
        camera.width,
        camera.height,
        columns,
    )


def footprint(
    planar_map: PlanarMap, T_world_camera: Array, camera: Camera, columns: int = 48
) -> NDArray[np.float32]:
    """Return the cells (M, 2) float32 of a grid of sensor pixels; NaN behind the plane."""
    rows = max(2, round(columns * camera.height / camera.width))
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows))
    q = np.column_stack([(x.ravel() - camera.cx) / camera.fx, (y.ravel() - camera.cy) / camera.fy, np.ones(x.size)])
    p = q @ (planar_map.projection @ homography_map_camera(T_world_camera, planar_map.plane)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        cells = p[:, :2] / p[:, 2:]
    cells[p[:, 2] <= 1e-9] = np.nan
    return cells.astype(np.float32)


def overlap(planar_map: PlanarMap, images: WindowImages, T_world_camera: Array, camera: Camera) -> float:
    """Return the share of a window's edge pixels that the map explains (section 2.2.3); NaN where there are few.

    Args:
        planar_map: the map.
        images: the window's, at the time of the pose.
        T_world_camera: pose (4, 4).
        camera: of the images.
    """
    H = planar_map.projection @ homography_map_camera(T_world_camera, planar_map.plane)
    share, count = explained_share(
        images.warped, images.edge_level, planar_map.level(-1), H, camera.matrix, c.OVERLAP_EDGE
    )
    return share if count >= _OVERLAP_PIXELS else float("nan")


def weakest(information: Array, free: NDArray[np.bool_]) -> tuple[float, Array]:
    """Return the condition number and the weakest unit direction (6,) of a pose's information (6, 6).

    Rotation in rad and position in plane distances move the image alike, so that the two compare.
    """
    index = np.flatnonzero(free)
    values, vectors = np.linalg.eigh(information[np.ix_(index, index)])
    direction = np.zeros(6)
    direction[index] = vectors[:, 0]
    condition = float(values[-1] / max(values[0], 1e-9 * max(values[-1], 1e-9)))
    return condition, direction


def stripes(planar_map: PlanarMap, T_world_camera: Array, camera: Camera) -> tuple[float, Array]:
    """Return how two-dimensional the edges in view are, and the direction that they do not show.

    The information of a pose counts every slope, and noise slopes in all directions: along stripes it claims to see.
    The slopes of the blurred map do not.

    Args:
        planar_map: the map.
        T_world_camera: pose (4, 4).
        camera: what is in view.

    Returns:
        Smaller by larger eigenvalue of the slopes' tensor (0: stripes, 1: evenly in all directions), and the unit
        direction (6,): motion along the edges with the rotation that looks like it.
    """
    H = planar_map.projection @ homography_map_camera(T_world_camera, planar_map.plane)
    level = planar_map.level(c.STRIPES_LEVEL)
    xx, xy, yy = slope_tensor(level, H, camera.matrix, camera.width, camera.height, c.STRIPES_COLUMNS)
    values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    along_map = np.array([*vectors[:, 0], 0.0])
    along = T_world_camera[:3, :3].T @ rotation_to_map(planar_map.plane.normal).T @ along_map
    x, y = along[:2] / max(float(np.linalg.norm(along[:2])), 1e-9)
    share = float(values[0] / values[1]) if values[1] > 0 else 1.0
    return share, np.array([-y, x, 0.0, x, y, 0.0]) / np.sqrt(2.0)


def is_on_a_line(planar_map: PlanarMap, alignment: Alignment, camera: Camera, free: NDArray[np.bool_]) -> bool:
    """Return whether a pose was found on one line, or one point, of the map: there anything fits."""
    if weakest(alignment.information, free)[0] > c.WEAK_CONDITION:
        return True
    return bool(free[3:5].any()) and stripes(planar_map, alignment.T_world_camera, camera)[0] < c.STRIPES_SHARE


def in_words(direction: Array) -> str:
    """Return a weak direction (6,) as words: "motion along x and rotation about y (yaw)"."""
    size = np.abs(direction)
    if not np.isfinite(size).all() or size.max() == 0:
        return ""
    strong = [i for i in np.argsort(-size) if size[i] > 0.35][:2]
    return " and ".join(_AXES[i] for i in strong)
