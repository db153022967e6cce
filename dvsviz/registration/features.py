"""Features of a frame and their matches between two frames.

SIFT descriptors are vectors of floats: they are compared by their Euclidean distance, with Lowe's ratio test. ORB's are
bit strings and compared by the Hamming distance. Both keep mutual best matches only. `sift-fast` leaves out SIFT's
first octave, that of the image at twice its size: three tenths of the time for two thirds of the features.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from dvsviz.geometry.camera import Camera
from dvsviz.registration.frames import Frame

Array = NDArray[np.float64]
FeatureKind = Literal["sift", "sift-fast", "orb"]

# Lowe's 0.8 lets through one wrong match in ten on indoor frames; 0.75 is the usual choice since.
RATIO: dict[FeatureKind, float] = {"sift": 0.75, "sift-fast": 0.75, "orb": 0.8}
MAX_FEATURES = 2000
# A keypoint at a depth step has the depth of either side: none is better than the wrong one.
_MAX_DEPTH_STEP = 0.03


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """Keypoints of one frame.

    Attributes:
        kind: what the descriptors are.
        pixels: sensor pixels (N, 2).
        bearings: undistorted bearings (N, 2).
        descriptors: (N, 128) float32 of SIFT or (N, 32) uint8 of ORB.
    """

    kind: FeatureKind
    pixels: Array
    bearings: Array
    descriptors: NDArray

    def __len__(self) -> int:
        return len(self.pixels)


def detect(frame: Frame, camera: Camera, *, kind: FeatureKind = "sift", limit: int = MAX_FEATURES) -> Features:
    """Return at most `limit` features of a frame, the strongest first."""
    image = frame.grey
    if kind == "orb":
        detector = cv2.ORB.create(nfeatures=limit)
        width, dtype = 32, np.uint8
    else:
        detector = cv2.SIFT.create(nfeatures=limit, enable_precise_upscale=True)
        # Without the precise upscale OpenCV places every point a quarter of a pixel too far right and down.
        width, dtype = 128, np.float32
        if kind == "sift-fast":
            # OpenCV's first octave is the doubled image: the doubled half image is the image itself.
            image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = detector.detectAndCompute(image, None)
    pixels = np.array([point.pt for point in keypoints], dtype=np.float64).reshape(-1, 2)
    if kind == "sift-fast":
        # A pixel of the half image is the mean of two by two: its centre lies between theirs.
        pixels = 2 * pixels + 0.5
    if descriptors is None:
        descriptors = np.zeros((0, width), dtype)
    return Features(
        kind=kind, pixels=pixels, bearings=camera.bearings(pixels), descriptors=np.asarray(descriptors, dtype=dtype)
    )


def match(a: Features, b: Features, *, ratio: float | None = None) -> NDArray[np.int64]:
    """Return pairs (M, 2) of feature numbers in `a` and `b` that are each other's best and pass the ratio test.

    Raises:
        ValueError: the features are of different kinds.
    """
    if a.kind != b.kind:
        raise ValueError(f"features: expected one kind, got {a.kind} and {b.kind}")
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    limit = RATIO[a.kind] if ratio is None else ratio
    if a.kind == "orb":
        # One matrix product counts the differing bits: |x| + |y| - 2 x·y over bits.
        x = np.unpackbits(a.descriptors, axis=1).astype(np.float32)
        y = np.unpackbits(b.descriptors, axis=1).astype(np.float32)
        return _mutual_best(x @ y.T, x.sum(1), y.sum(1), np.float32(limit))
    # Squared distances |x|² + |y|² - 2 x·y, and the ratio squared: no root of four million numbers.
    x, y = a.descriptors, b.descriptors
    return _mutual_best(x @ y.T, (x * x).sum(1), (y * y).sum(1), np.float32(limit * limit))


@njit(cache=True, nogil=True, error_model="numpy")
def _mutual_best(products, size_a, size_b, ratio):
    """Return pairs (M, 2) that are each other's nearest and nearer than `ratio` times a's second nearest.

    The distance of i and j is `size_a[i] + size_b[j] - 2 products[i, j]`; of equal ones the first counts. One pass over
    the products (N, M): looking for the smallest, the second and the column's smallest one by one takes four times as
    long as the matrix product itself.
    """
    rows, columns = products.shape
    nearest, best, second = np.empty(rows, np.int64), np.empty(rows, np.float32), np.empty(rows, np.float32)
    back, back_best = np.zeros(columns, np.int64), np.full(columns, np.float32(np.inf))
    for i in range(rows):
        first, after, at = np.float32(np.inf), np.float32(np.inf), 0
        for j in range(columns):
            d = max(size_a[i] + size_b[j] - np.float32(2.0) * products[i, j], np.float32(0.0))
            if d < after:
                if d < first:
                    first, after, at = d, first, j
                else:
                    after = d
            if d < back_best[j]:
                back_best[j], back[j] = d, i
        nearest[i], best[i], second[i] = at, first, after
    pairs, count = np.empty((rows, 2), np.int64), 0
    for i in range(rows):
        if back[nearest[i]] == i and best[i] < ratio * second[i]:
            pairs[count, 0], pairs[count, 1] = i, nearest[i]
            count += 1
    return pairs[:count]


def depth_at(frame: Frame, pixels: Array) -> Array:
    """Return depths (N,) in metres at pixels (N, 2): the median of 3 x 3, NaN where unknown or at a depth step."""
    if frame.depth is None or len(pixels) == 0:
        return np.full(len(pixels), np.nan)
    height, width = frame.depth.shape
    column = np.clip(np.rint(pixels[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.rint(pixels[:, 1]).astype(int), 0, height - 1)
    step = np.arange(-1, 2)
    rows = np.clip(row[:, None, None] + step[None, :, None], 0, height - 1)
    columns = np.clip(column[:, None, None] + step[None, None, :], 0, width - 1)
    patch = frame.depth[rows, columns].reshape(len(pixels), 9).astype(np.float64)
    known = np.isfinite(patch)
    enough = known.sum(axis=1) >= 5
    depth = np.full(len(pixels), np.nan)
    if np.any(enough):
        depth[enough] = np.nanmedian(patch[enough], axis=1)
        spread = np.nanmax(patch[enough], axis=1) - np.nanmin(patch[enough], axis=1)
        depth[enough] = np.where(spread > _MAX_DEPTH_STEP * depth[enough], np.nan, depth[enough])
    return depth
