"""The constants of a second map and of its join, as `constants` has those of the tracker."""

from __future__ import annotations

from typing import Final

# Recording time with texture and the camera not found, us, that begins a second map: kidnap's five are found in 0.1 s.
SECOND_AFTER_US: Final = 300_000
# The same for a camera that is lost on the second map too, after which that is given up.
SECOND_PATIENCE_US: Final = 1_000_000
# Recording time for which a way back that is found on the first map ends the second one, us: it is worth no more.
SECOND_TINY_US: Final = 1_000_000
# Sightings in a row after which the camera is believed to be on the first map though the second one does not fit it: on
# shapes_translation it begins before a quarter of an oval, and its first windows are off.
SECOND_IN_A_ROW: Final = 5
# Recording time between two searches for a window of one map on the other, us: while it is followed on the second map,
# while it is back on the first and a second map waits, and where the last one nearly fitted. One takes 0.07 to 0.1 s.
SECOND_EVERY_US: Final = 400_000
SECOND_LEFT_EVERY_US: Final = 2_000_000
SECOND_NEAR_EVERY_US: Final = 100_000
# Score by the wanted one from which on it nearly fitted: at most 0.35 where the maps do not meet, else 1 and more.
SECOND_NEAR: Final = 0.5
# Cosine of the angle between the expected normal and straight ahead below which a second map begins straight ahead.
SECOND_FACING: Final = 0.6
# Sightings that are remembered, and for how long, us.
SECOND_SIGHTINGS: Final = 8
SECOND_SIGHTED_US: Final = 10_000_000
# Sightings that must agree on how the maps lie to each other, and the distance of their image points, as a share of the
# image's width: 5 px of 240. Of windows that were then aligned with the first map 2 px: they are 0.1 to 1.9 px apart.
JOIN_SIGHTINGS: Final = 3
JOIN_OFF: Final = 5.0 / 240
JOIN_FIT: Final = 2.0 / 240
# Least image motion among them, as a share of the width: one view, found three times, is one sighting.
JOIN_SPREAD: Final = 0.04
# Windows of the second map that are looked at, those that are aligned with the first, and the share of a view that must
# lie in it.
JOIN_LOOKED_AT: Final = 240
JOIN_WINDOWS: Final = 16
JOIN_INSIDE: Final = 0.75
# Standard deviation (rad, plane distances) of where a join puts them.
JOIN_PRIOR: Final = 0.02
# How well they may lie on another place of the first map, so many map px away, by how well they lie where they are:
# 0.14 to 0.37 on shapes, 0.3 on a poster, 0.9 to 1 on a checkerboard and on stripes.
JOIN_RIVAL: Final = 0.6
JOIN_RIVAL_PX: Final = 16.0
# Share of them that must be no worse than weak.
JOIN_SHARE: Final = 0.8
