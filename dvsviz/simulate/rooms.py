"""Scenes with depth by name: walls at several depths, and boxes on the floor of a room."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry import se3
from dvsviz.simulate.models.cameras import R_BODY_OPTICAL
from dvsviz.simulate.models.imu import GRAVITY_DOWN_Z
from dvsviz.simulate.relief import Patch, Relief
from dvsviz.simulate.scenes import PAINTERS, Painter, natural_noise, poster
from dvsviz.simulate.texture import Texture, make_texture

Array = NDArray[np.float64]
ReliefName = Literal["planes", "boxes", "carpet"]
RELIEFS: tuple[str, ...] = get_args(ReliefName)
# The room of the flights: half its width, its height, m.
_HALF, _CEILING = 3.5, 3.0


def plain(rng: np.random.Generator, bounds: tuple[float, float, float, float], texel: float) -> Texture:
    """Return a surface with hardly any texture: linoleum, plaster."""
    size = (int(np.ceil((bounds[3] - bounds[1]) / texel)), int(np.ceil((bounds[2] - bounds[0]) / texel)))
    image = 0.5 * np.exp(0.06 * natural_noise(rng, size))
    return make_texture(image.astype(np.float32), texel=texel, left=bounds[0], top=bounds[1])


def patch(
    rng: np.random.Generator, R: Array, corner: Array, size: tuple[float, float], painter: Painter, texel: float
) -> Patch:
    """Return a painted rectangle of a size (width, height), m, its axes the columns of `R`, from its corner (3,)."""
    texture = painter(rng, (0.0, 0.0, *size), texel)
    return Patch(T_world_patch=se3.pose(R, corner), width=size[0], height=size[1], texture=texture)


def facing(normal: Array, up: Array) -> Array:
    """Return the axes (3, 3) of a patch whose visible side looks along `normal`, its rows going against `up`."""
    z = -normal / np.linalg.norm(normal)
    y = -up + (up @ z) * z
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])


def box(
    rng: np.random.Generator,
    centre: tuple[float, float],
    size: tuple[float, float, float],
    yaw: float,
    painter: Painter,
    texel: float,
    bottom: float = 0.0,
) -> list[Patch]:
    """Return the five visible faces of a box that stands on the floor, z up.

    Args:
        rng: paints it.
        centre: (x, y) of its middle, m.
        size: length, width, height, m.
        yaw: rad.
        painter: of its faces.
        texel: m.
        bottom: height of its bottom, m.
    """
    R_yaw = se3.exp_so3([0.0, 0.0, yaw])
    middle = np.array([*centre, bottom + size[2] / 2])
    up = np.array([0.0, 0.0, 1.0])
    faces = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1)):
        normal = sign * R_yaw[:, axis]
        R = facing(normal, R_yaw[:, 0] if axis == 2 else up)
        extent = np.abs(R.T @ R_yaw) @ np.array(size)
        corner = middle + R @ np.array([-extent[0] / 2, -extent[1] / 2, -size[axis] / 2])
        faces.append(patch(rng, R, corner, (float(extent[0]), float(extent[1])), painter, texel))
    return faces


def planes(rng: np.random.Generator, texel: float = 0.002, painter: Painter = PAINTERS["poster"]) -> Relief:
    """Return four walls at 0.8 to 2.5 m, two of them slanted, before a large one; x right, y down, z forward."""
    walls = [((0.0, 0.0, 2.5), (7.0, 5.0), (0.0, 0.0)), ((-0.45, 0.1, 1.3), (0.6, 0.9), (0.2, 0.0))]
    walls += [((0.45, -0.2, 1.6), (0.7, 0.6), (-0.35, 0.1)), ((0.2, 0.35, 0.8), (0.35, 0.3), (0.0, 0.25))]
    patches = []
    for centre, size, (yaw, pitch) in walls:
        R = se3.exp_so3([0.0, yaw, 0.0]) @ se3.exp_so3([pitch, 0.0, 0.0])
        corner = np.array(centre) + R @ np.array([-size[0] / 2, -size[1] / 2, 0.0])
        patches.append(patch(rng, R, corner, size, painter, texel))
    return Relief(
        patches=tuple(patches), T_world_hand=np.eye(4), gravity_world=np.array([0.0, 9.81, 0.0]), has_floor=False
    )


def _room(rng: np.random.Generator, floor: Painter, texel: float) -> list[Patch]:
    up, full = np.array([0.0, 0.0, 1.0]), 2 * _HALF
    R = facing(up, np.array([0.0, 1.0, 0.0]))
    surfaces = [patch(rng, R, np.array([-_HALF, _HALF, 0.0]), (full, full), floor, texel)]
    for k in range(4):
        normal = np.array([-np.cos(k * np.pi / 2), -np.sin(k * np.pi / 2), 0.0])
        R = facing(normal, up)
        corner = -_HALF * normal - full / 2 * R[:, 0] + _CEILING * up
        surfaces.append(patch(rng, R, corner, (full, _CEILING), plain, 3 * texel))
    return surfaces


# (x, y), (length, width, height), yaw: a pile in the middle, two smaller boxes beside it.
_FEW = (
    ((0.0, 0.0), (0.45, 0.35, 0.4), 0.3),
    ((0.35, 0.3), (0.25, 0.2, 0.25), 1.0),
    ((-0.3, -0.35), (0.3, 0.2, 0.2), -0.5),
)
_MORE = (
    ((-1.3, 0.9), (0.4, 0.3, 0.3), 0.2),
    ((1.3, -0.9), (0.35, 0.35, 0.45), 0.9),
    ((1.2, 1.0), (0.5, 0.3, 0.25), -0.4),
    ((-1.1, -1.1), (0.3, 0.3, 0.35), 0.6),
    ((2.2, 0.1), (0.4, 0.4, 0.6), 0.1),
    ((-2.3, 0.2), (0.4, 0.5, 0.5), 0.7),
)


def _boxes(rng: np.random.Generator, layout: tuple, floor: Painter, texel: float) -> Relief:
    patches = _room(rng, floor, texel)
    for centre, size, yaw in layout:
        patches += box(rng, centre, size, yaw, poster, texel)
    patches += box(rng, (0.02, -0.03), (0.25, 0.2, 0.2), 0.8, poster, texel, bottom=0.4)
    down = se3.exp_so3([0.0, np.radians(45), 0.0]) @ R_BODY_OPTICAL
    return Relief(
        patches=tuple(patches),
        T_world_hand=se3.pose(down, [-1.1, 0.0, 1.3]),
        gravity_world=GRAVITY_DOWN_Z,
        has_floor=True,
    )


def boxes(rng: np.random.Generator, texel: float = 0.002) -> Relief:
    """Return a few textured boxes in a room without much texture elsewhere: scene 1 of the flights."""
    return _boxes(rng, _FEW, plain, texel)


def carpet(rng: np.random.Generator, texel: float = 0.002) -> Relief:
    """Return more textured boxes on a textured carpet: scene 2 of the flights."""
    return _boxes(rng, _FEW + _MORE, poster, texel)


_MAKERS: dict[str, Callable[[np.random.Generator], Relief]] = {"planes": planes, "boxes": boxes, "carpet": carpet}


def make_relief(name: str, rng: np.random.Generator) -> Relief:
    """Return a scene with depth by its name.

    Raises:
        ValueError: the name is not known.
    """
    if name not in _MAKERS:
        raise ValueError(f"scene: expected {', '.join(RELIEFS)}, got {name!r}")
    return _MAKERS[name](rng)
