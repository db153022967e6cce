"""`dvsviz simulate` and `simulate-suite`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dvsviz.cli.console import note, share_bar
from dvsviz.cli.simulation_arguments import MOTIONS, SCENES, TURNS, Simulate, SimulateSuite
from dvsviz.errors import DvsvizError

if TYPE_CHECKING:
    from dvsviz.geometry.camera import Camera
    from dvsviz.simulate.scenes import Painter


def simulate(command: Simulate) -> int:
    """Write a simulated recording or RGB-D sequence."""
    _check_target(command)
    options: dict[str, Any] = {
        "motion": command.motion if command.motion in MOTIONS else Path(command.motion),
        "seconds": command.seconds,
        "seed": command.seed,
        "distance": command.distance,
        "tilt_deg": command.tilt_deg,
    }
    try:
        options["scene"] = _scene(command.scene)
        options["camera"] = _camera(command)
        with share_bar(f"simulating {command.out.name}") as show:
            if command.scene == "room" and command.layout == "rgbd":
                raise ValueError("scene: a room around the camera has no depth to write; --layout hdf5 or uzh")
            if command.scene == "room" and command.motion in MOTIONS and command.motion not in TURNS:
                raise ValueError(f"motion: in the room a camera only turns: expected {' or '.join(TURNS)}")
            if command.layout == "rgbd":
                from dvsviz.simulate.rgbd import simulate_rgbd

                rate = 30.0 if command.frames_hz is None else command.frames_hz
                exposure_s = command.exposure_ms * 1e-3
                simulate_rgbd(command.out, rate_hz=rate, exposure_s=exposure_s, progress=show, **options)
            elif command.exposure_ms:
                raise ValueError("exposure-ms: only images of the layout rgbd have a shutter")
            else:
                _events(command, options, show)
    except ValueError as error:
        raise DvsvizError(str(error), hint="see dvsviz simulate --help") from error
    note(f"wrote {command.out}")
    return 0


def _check_target(command: Simulate) -> None:
    """Refuse to write over what was not made by a simulation."""
    out, is_folder = command.out, command.layout != "hdf5"
    if not out.name:
        raise DvsvizError("is no name of its own", path=out, hint="name a file x.h5, or a folder for other layouts")
    if not out.exists():
        return
    if not command.force:
        raise DvsvizError("already exists", path=out, hint="replace it with --force")
    if is_folder and not out.is_dir():
        raise DvsvizError("is a file", path=out, hint=f"name a folder for the layout {command.layout}")
    if not is_folder and out.is_dir():
        raise DvsvizError("is a folder", path=out, hint="name a file x.h5")
    if is_folder:
        ours = any((out / name).is_file() for name in ("events.txt", "rgb.txt")) or not any(out.iterdir())
    else:
        from dvsviz.formats.hdf5 import is_recording

        ours = is_recording(out) or out.stat().st_size == 0
    if not ours:
        what = "folder of a simulation" if is_folder else "recording of dvsviz"
        raise DvsvizError(f"is no {what} and is not replaced", path=out, hint="choose another name with --out")


def _events(command: Simulate, options: dict[str, Any], show: Callable[[float], None]) -> None:
    """Write a recording of events in the layout that is asked for."""
    from dvsviz.simulate.simulate import simulate as run

    options |= {"frames_hz": command.frames_hz or 0.0, "panorama": command.scene == "room"}
    if command.layout == "hdf5":
        run(command.out, progress=show, **options)
        return
    from dvsviz.formats.hdf5 import read_recording
    from dvsviz.formats.uzh_writer import write_uzh

    passing = command.out.with_name(command.out.name + ".partial.h5")
    try:
        run(passing, progress=show, **options)
        write_uzh(read_recording(passing), command.out)
    finally:
        passing.unlink(missing_ok=True)


def _scene(name: str) -> str | Painter:
    """Return a scene's name, or its painter where it has none of its own."""
    if name == "room":
        from dvsviz.simulate.panorama import boxes

        return boxes
    return name if name in SCENES else _picture(Path(name))


def _picture(path: Path) -> Painter:
    """Return the painter of an image file."""
    import cv2
    import numpy as np

    from dvsviz.simulate.scenes import picture

    try:
        image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    except OSError as error:
        raise DvsvizError(f"cannot be read: {error.strerror}", path=path, hint="check the path") from error
    except cv2.error as error:
        message = "the picture is empty, damaged or too large to be read"
        raise DvsvizError(message, path=path, hint="name a PNG or JPEG file") from error
    if image is None:
        raise DvsvizError("is not a picture", path=path, hint="name a PNG or JPEG file")
    try:
        return picture(image.astype(np.uint8))
    except ValueError as error:
        raise DvsvizError(str(error), path=path, hint="name another picture") from error


def _camera(command: Simulate) -> Camera | None:
    """Return the camera that was asked for, or None for the usual one."""
    from dataclasses import replace

    if command.calibration is None and command.size is None:
        return None
    if command.layout == "rgbd":
        from dvsviz.simulate.rgbd import rgbd_camera as usual
    else:
        from dvsviz.simulate.simulate import default_camera as usual
    camera = usual()
    if command.calibration is not None:
        from dvsviz.formats.calibration import read_calibration

        found = read_calibration(command.calibration)
        return found.camera(*(command.size or found.size or (camera.width, camera.height)))
    width, height = command.size or (camera.width, camera.height)
    if not (1 <= width <= 4096 and 1 <= height <= 4096):
        raise ValueError(f"size: expected 1 to 4096 pixels, got {width}x{height}")
    f = camera.fx * width / camera.width
    return replace(camera, width=width, height=height, fx=f, fy=f, cx=(width - 1) / 2, cy=(height - 1) / 2)


def simulate_suite(command: SimulateSuite) -> int:
    """Write the suite's recordings that are not there and print where all are."""
    from dvsviz.simulate.suite import simulate_suite as run
    from dvsviz.simulate.suite import suite_entries

    try:
        entries = suite_entries(command.names or None)
    except ValueError as error:
        raise DvsvizError(str(error), hint="see dvsviz simulate-suite --help") from error
    for entry in entries:
        with share_bar(f"simulating {entry.name}") as show:
            run(command.out, [entry.name], lambda _, share, show=show: show(share))
        print(entry.path(command.out))
    return 0
