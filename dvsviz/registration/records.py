"""The nouns of registration: matched points of two frames, and what a method makes of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import ConfigError, DvsvizError

if TYPE_CHECKING:
    from dvsviz.registration.dense import Surface

Array = NDArray[np.float64]

# How well SIFT places a point, px; and how far a camera that is known by its maker's values alone is from its own
# calibration: single Kinects differ from the factory's by 2 to 5 px at the border.
IMAGE_SIGMA_PX = 0.7
GUESS_SIGMA_PX = 2.0

# Where the length of a translation comes from. `motion` is a step length that the caller knows (speed x time).
Scale = Literal["depth", "motion", "unit", "none"]


class RegistrationError(DvsvizError):
    """Point sets that do not determine a motion; the message says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConfig:
    """Settings shared by all methods.

    Attributes:
        threshold_px: largest distance of an inlier, px: reprojection, or point to epipolar line.
        confidence: probability that RANSAC saw at least one sample without an outlier.
        max_rounds: RANSAC rounds at most.
        min_inliers: a motion with fewer is not believed.
        seed: of the sampling.
    """

    threshold_px: float = 2.0
    confidence: float = 0.999
    max_rounds: int = 2000
    min_inliers: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.threshold_px < 100:
            raise ConfigError(f"threshold_px: expected pixels above 0, got {self.threshold_px}")
        if not 0 < self.confidence < 1:
            raise ConfigError(f"confidence: expected a value between 0 and 1, got {self.confidence}")
        if self.max_rounds < 1 or self.min_inliers < 3:
            raise ConfigError("max_rounds, min_inliers: expected at least 1 and 3")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchedPoints:
    """The same scene points seen in frames a and b.

    Attributes:
        bearings_a: undistorted bearings (M, 2) in a.
        bearings_b: the same points in b.
        depth_a: depth (M,) along a's optical axis, metres, NaN where unknown.
        depth_b: depth (M,) along b's optical axis.
        focal_px: mean focal length: what a pixel is in bearings.
        image_sigma_px: how far a matched point is from where it should be seen: what depth noise weighs against.
        surface_a: surfaces in view of a, for dense methods; None where not looked at.
        surface_b: those in view of b.
    """

    bearings_a: Array
    bearings_b: Array
    depth_a: Array
    depth_b: Array
    focal_px: float
    image_sigma_px: float = IMAGE_SIGMA_PX
    surface_a: Surface | None = None
    surface_b: Surface | None = None

    def __len__(self) -> int:
        return len(self.bearings_a)

    def __getitem__(self, key: NDArray) -> MatchedPoints:
        """Return the points that a mask or an index array selects."""
        return MatchedPoints(
            bearings_a=self.bearings_a[key],
            bearings_b=self.bearings_b[key],
            depth_a=self.depth_a[key],
            depth_b=self.depth_b[key],
            focal_px=self.focal_px,
            image_sigma_px=self.image_sigma_px,
            surface_a=self.surface_a,
            surface_b=self.surface_b,
        )

    @property
    def points_a(self) -> Array:
        """Points (M, 3) in camera a, metres; NaN where the depth is unknown."""
        return homogeneous(self.bearings_a) * self.depth_a[:, None]

    @property
    def points_b(self) -> Array:
        """Points (M, 3) in camera b."""
        return homogeneous(self.bearings_b) * self.depth_b[:, None]

    @property
    def has_depth_a(self) -> NDArray[np.bool_]:
        """Mask (M,) of the points whose depth is known in a."""
        return np.isfinite(self.depth_a)

    @property
    def has_both_depths(self) -> NDArray[np.bool_]:
        """Mask (M,) of the points whose depth is known in both frames."""
        return np.isfinite(self.depth_a) & np.isfinite(self.depth_b)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """The pose of camera b in camera a, and how well it is known.

    Attributes:
        T_a_b: pose (4, 4), `p_a = T_a_b p_b`; the identity where the method failed.
        inliers: mask (M,) of the matches that agree.
        scale: where the translation's length comes from; "none" where the method failed.
        reason: why the method failed, or "".
    """

    T_a_b: Array
    inliers: NDArray[np.bool_]
    scale: Scale
    reason: str = ""

    @property
    def is_found(self) -> bool:
        """True where the method returned a motion."""
        return not self.reason

    @property
    def inlier_count(self) -> int:
        """Number of matches that agree."""
        return int(self.inliers.sum())


def homogeneous(bearings: Array) -> Array:
    """Return (x, y, 1) (M, 3) of bearings (M, 2)."""
    return np.column_stack([bearings, np.ones(len(bearings))])


def failed(count: int, reason: str) -> Registration:
    """Return the result of a method that found no motion among `count` matches."""
    return Registration(T_a_b=np.eye(4), inliers=np.zeros(count, dtype=bool), scale="none", reason=reason)


def depth_sigma(depth: Array, focal_px: float) -> Array:
    """Return the standard deviation (M,) in metres of points measured at depths (M,) by a structured-light sensor.

    Depth from disparity has an error that grows with the square of the depth: 1.5 mm at 1 m, 6 mm at 2 m is what
    published calibrations of such sensors find. Across the ray it is half a pixel.
    """
    return np.sqrt((0.001 + 0.0015 * depth**2) ** 2 + (0.5 * depth / focal_px) ** 2)
