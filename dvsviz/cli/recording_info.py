"""The description of a recording in words, for `dvsviz info`."""

from __future__ import annotations

from typing import Any


def fields(found: dict[str, Any]) -> dict[str, str]:
    """Return names and texts of what `formats.info.describe` found."""
    camera, duration = found["camera"], found["duration_s"]
    rows = {
        "name": f"{found['name']}  ({found['format']})",
        "path": found["path"],
        "sensor": f"{found['width']} x {found['height']} px",
        "camera": _camera(camera) if found["calibrated"] else "not calibrated (a guess is used)",
        "duration": f"{duration:.3f} s, {found['first_us'] * 1e-6:.6f} to {found['last_us'] * 1e-6:.6f}",
        "events": f"{found['events']:,d}, {found['positive_share']:.1%} positive",
        "rate": f"{_rate(found['rate_hz'])} on average, {_rate(found['peak_rate_hz'])} at most",
        "": found["sparkline"],
        "streams": _streams(found["streams"], found["triggers"]),
        "gaps": f"{found['gaps']} of 100 ms or more; the longest pause is {found['longest_gap_s'] * 1e3:.1f} ms",
        "order": _order(found),
        "hot pixels": _hot(found),
    }
    before = found["events_before_filters"]
    if before:
        chosen = ", ".join(_filter(name, value) for name, value in found["filters"].items() if value)
        rows["events kept"] = f"{found['events'] / before:.1%} of {before:,d}  ({chosen})"
    for number, warning in enumerate(found["warnings"]):
        rows["warning" if number == 0 else f"warning {number + 1}"] = warning
    return rows


def _camera(camera: dict[str, Any]) -> str:
    text = f"fx {camera['fx']:.2f}, fy {camera['fy']:.2f}, cx {camera['cx']:.2f}, cy {camera['cy']:.2f} px"
    if any(camera["distortion"]):
        return f"{text}, distortion {' '.join(f'{value:.4g}' for value in camera['distortion'])}"
    return f"{text}, no distortion"


def _rate(hz: float) -> str:
    if hz >= 1e6:
        return f"{hz / 1e6:.2f} million/s"
    return f"{hz / 1e3:.1f} thousand/s" if hz >= 1e3 else f"{hz:.0f}/s"


def _streams(streams: dict[str, int], triggers: dict[str, int]) -> str:
    names = {"ground_truth": "true poses", "imu": "inertial measurements", "frames": "frames"}
    there = [f"{streams[key]:,d} {name}" for key, name in names.items() if streams[key]]
    if triggers:
        kinds = ", ".join(f"{count:,d} {kind}" for kind, count in triggers.items())
        there.append(f"{streams['triggers']:,d} triggers ({kinds})")
    return ", ".join(["events", *there])


def _order(found: dict[str, Any]) -> str:
    late = found["out_of_order"]
    order = f"{late:,d} events ran backwards and were dropped" if late else "in order"
    share = found["duplicates"] / max(1, found["events"])
    return f"{order}; {found['duplicates']:,d} duplicates ({share:.2%})" if found["duplicates"] else order


def _hot(found: dict[str, Any]) -> str:
    if not found["hot_pixels"]:
        return "none"
    loudest = ", ".join(f"({x}, {y}) {count:,d}" for x, y, count in found["hot_pixels_at"])
    more = ", ..." if found["hot_pixels"] > len(found["hot_pixels_at"]) else ""
    return f"{found['hot_pixels']}, with {found['hot_share']:.2%} of the events: {loudest}{more}"


def _filter(name: str, value: object) -> str:
    return {"hot_pixels": "hot pixels", "background_us": "background activity", "refractory_us": "refractory"}[
        name
    ] + ("" if value is True else f" {value} us")
