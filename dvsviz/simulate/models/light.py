"""What cameras make of light: intensity images, depth images, and events."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def intensity_image(
    light: NDArray[np.floating],
    rng: np.random.Generator,
    *,
    full_well: float = 10_000.0,
    read_sigma: float = 0.003,
    exposure: float = 1.0,
) -> NDArray[np.uint8]:
    """Return an 8-bit image: `z = round(255 clip(e I + sqrt(e I / N) n_1 + s n_2))`.

    Photon noise grows with the root of the light (`N` photons fill a pixel), read noise is constant.

    Args:
        light: intensity I (height, width), 1 being white.
        rng: gives the noise.
        full_well: N; infinite for no photon noise.
        read_sigma: s, as a share of white.
        exposure: e.
    """
    mean = exposure * np.asarray(light, dtype=np.float64)
    sigma = np.sqrt(np.maximum(mean, 0) / full_well + read_sigma**2)
    return np.round(255 * np.clip(mean + sigma * rng.standard_normal(mean.shape), 0, 1)).astype(np.uint8)


def depth_image(
    depth: NDArray[np.floating],
    rng: np.random.Generator,
    *,
    sigma_at_1m: float = 0.0015,
    hole_share: float = 0.01,
    edge_step: float = 0.05,
    near: float = 0.4,
    far: float = 8.0,
    scale: float = 5000.0,
) -> NDArray[np.uint16]:
    """Return a 16-bit depth image: `z = round(scale (Z + sigma_1 Z² n))`, 0 where nothing was measured.

    A triangulating sensor errs by a constant disparity, hence by the square of the depth. Holes: out of range, no
    surface, at random, and beside depth steps, where projector and camera see different surfaces.

    Args:
        depth: Z along the optical axis (height, width), m, NaN where there is no surface.
        rng: gives noise and holes.
        sigma_at_1m: standard deviation at 1 m, m.
        hole_share: of pixels that fail at random.
        edge_step: steps between neighbours above this share of the depth make holes; infinite for none.
        near: smallest depth that is measured, m.
        far: largest one, m.
        scale: units a metre; depths beyond 65535 units are not measured.
    """
    z = np.asarray(depth, dtype=np.float64)
    fails = ~((z >= near) & (z <= far)) | (rng.uniform(size=z.shape) < hole_share)
    for axis in (0, 1):
        step = np.abs(np.diff(z, axis=axis)) > edge_step * np.minimum(*_pairs(z, axis))
        grown = np.zeros_like(fails)
        for part in _pairs(grown, axis):
            part |= step
        fails |= grown
    units = np.round(scale * (z + sigma_at_1m * z * z * rng.standard_normal(z.shape)))
    fails |= ~((units >= 1) & (units <= 65_534))
    return np.where(fails, 0, units).astype(np.uint16)


def _pairs(image: NDArray, axis: int) -> tuple[NDArray, NDArray]:
    """Return views of all but the last and all but the first entries along an axis."""
    return (image[:-1], image[1:]) if axis == 0 else (image[:, :-1], image[:, 1:])


def pixel_events(
    log_intensity: ArrayLike,
    t_s: ArrayLike,
    *,
    threshold_on: float = 0.25,
    threshold_off: float = 0.25,
    refractory_s: float = 0.0,
) -> tuple[Array, NDArray[np.int8]]:
    """Return times (K,) and signs (K,) of one ideal pixel's events, its log intensity straight between samples.

    An event is sent when `L(t) - L(t_last) = +C_on` or `-C_off`, and `L(t_last)` is what was memorised after the last
    event. After the refractory time the pixel memorises what it then sees.

    Args:
        log_intensity: L at the samples (N,).
        t_s: times of the samples (N,), increasing, s.
        threshold_on: C_on.
        threshold_off: C_off.
        refractory_s: blind time after an event, s.
    """
    L, t = np.asarray(log_intensity, dtype=np.float64), np.asarray(t_s, dtype=np.float64)
    if L.shape != t.shape or np.any(np.diff(t) <= 0) or min(threshold_on, threshold_off) <= 0:
        raise ValueError("pixel_events: expected increasing times, a level for each, thresholds above 0")
    times: list[float] = []
    signs: list[int] = []
    held, free = float(L[0]) if len(L) else 0.0, -np.inf
    for k in range(len(t) - 1):
        slope = (L[k + 1] - L[k]) / (t[k + 1] - t[k])
        if free > t[k]:
            if free >= t[k + 1]:
                continue
            held = L[k] + slope * (free - t[k])
        while slope:
            sign = 1 if slope > 0 else -1
            target = held + (threshold_on if sign > 0 else -threshold_off)
            at = t[k] + (target - L[k]) / slope
            if at > t[k + 1]:
                break
            times.append(float(at))
            signs.append(sign)
            held, free = target, at + refractory_s
            if refractory_s > 0:
                if free >= t[k + 1]:
                    break
                held = L[k] + slope * (free - t[k])
    return np.array(times), np.array(signs, dtype=np.int8)


def brightness_increment(gradient: ArrayLike, flow: ArrayLike, tau: ArrayLike) -> Array:
    """Return `dL = -grad L · v tau` (...): what brightness constancy says that events of `tau` seconds add up to.

    Args:
        gradient: of the log intensity (..., 2), 1/px.
        flow: image velocity v (..., 2), px/s.
        tau: duration (...), s.
    """
    return -np.sum(np.asarray(gradient) * np.asarray(flow), axis=-1) * np.asarray(tau, dtype=np.float64)


def brightness_increment_jacobians(gradient: ArrayLike, flow: ArrayLike, tau: ArrayLike) -> tuple[Array, Array]:
    """Return `-v tau` and `-grad L tau` (..., 2): the derivatives by gradient and by flow."""
    tau = np.asarray(tau, dtype=np.float64)[..., None]
    return -np.asarray(flow) * tau, -np.asarray(gradient) * tau
