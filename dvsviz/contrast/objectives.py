"""What "sharp" means: objectives of an image of warped events, each with its exact adjoint image.

An objective takes an image (rows, columns) and returns its value, to be *maximised*, and d value / d image. The
gradient by any motion parameter follows from the adjoint image alone (`contrast.kernels.gather`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Objective = Callable[[Image], tuple[float, Image]]
ObjectiveName = Literal["variance", "gradient", "highpass", "michelson"]

_HIGHPASS = np.array([[-1, -1, -1], [-1, 8, -1], [-1, -1, -1]], dtype=np.float32)


def variance(image: Image) -> tuple[float, Image]:
    """Return the variance of the image (eq. 2.3) and its adjoint 2 (I - mean) / |Ω| (A.2)."""
    mean = float(image.mean(dtype=np.float64))
    rho = image - np.float32(mean)
    value = float(np.vdot(rho, rho)) / rho.size
    return value, rho * np.float32(2.0 / rho.size)


def gradient_magnitude(image: Image) -> tuple[float, Image]:
    """Return the mean squared gradient (central differences, zero border) and its adjoint."""
    gx, gy = np.zeros_like(image), np.zeros_like(image)
    gx[:, 1:-1] = 0.5 * (image[:, 2:] - image[:, :-2])
    gy[1:-1] = 0.5 * (image[2:] - image[:-2])
    value = float(np.vdot(gx, gx) + np.vdot(gy, gy)) / image.size
    adjoint = np.zeros_like(image)
    adjoint[:, 2:] += gx[:, 1:-1]
    adjoint[:, :-2] -= gx[:, 1:-1]
    adjoint[2:] += gy[1:-1]
    adjoint[:-2] -= gy[1:-1]
    return value, adjoint * np.float32(1.0 / image.size)


def local_highpass(image: Image) -> tuple[float, Image]:
    """Return the mean square of the high-pass filtered image (eq. 2.2) and its adjoint.

    Rejected by the source, kept for study: scattered events score as well as sharp edges.
    """
    filtered = cv2.filter2D(image, -1, _HIGHPASS, borderType=cv2.BORDER_CONSTANT)
    # The kernel is symmetric, so that its own transpose is the same filter.
    adjoint = cv2.filter2D(filtered, -1, _HIGHPASS, borderType=cv2.BORDER_CONSTANT)
    return float(np.vdot(filtered, filtered)) / image.size, adjoint * np.float32(2.0 / image.size)


def michelson(image: Image) -> tuple[float, Image]:
    """Return the Michelson contrast (max - min) / (max + min) of |image| and its adjoint.

    Rejected by the source, kept for study: it sees two pixels only.
    """
    magnitude = np.abs(image)
    high, low = int(magnitude.argmax()), int(magnitude.argmin())
    a, b = float(magnitude.flat[high]), float(magnitude.flat[low])
    adjoint = np.zeros_like(image)
    if a + b <= 0:
        return 0.0, adjoint
    adjoint.flat[high] += np.sign(image.flat[high]) * 2 * b / (a + b) ** 2
    adjoint.flat[low] -= np.sign(image.flat[low]) * 2 * a / (a + b) ** 2
    return (a - b) / (a + b), adjoint


_BY_NAME: dict[str, Objective] = {
    "variance": variance,
    "gradient": gradient_magnitude,
    "highpass": local_highpass,
    "michelson": michelson,
}


def objective(name: ObjectiveName, blur_px: float = 0.0) -> Objective:
    """Return the objective of that name, of the image blurred by a Gaussian of `blur_px`.

    Raises:
        ValueError: the name is not known.
    """
    if name not in _BY_NAME:
        raise ValueError(f"name: expected one of {', '.join(get_args(ObjectiveName))}, got {name!r}")
    inner = _BY_NAME[name]
    if blur_px <= 0:
        return inner

    def blurred(image: Image) -> tuple[float, Image]:
        value, adjoint = inner(_blur(image, blur_px))
        return value, _blur(adjoint, blur_px)

    return blurred


def _blur(image: Image, sigma_px: float) -> Image:
    # A zero border makes the blur its own transpose, which the adjoint needs.
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)
