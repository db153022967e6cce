"""Simulate a second of a wall with shapes, seen by a hand-held event camera: the other examples read `example.h5`."""

from pathlib import Path

from dvsviz.geometry.camera import Camera
from dvsviz.simulate.simulate import simulate

camera = Camera(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
simulate(Path("example.h5"), scene="shapes", motion="handheld", seconds=1.0, seed=1, camera=camera)
print("wrote example.h5")
