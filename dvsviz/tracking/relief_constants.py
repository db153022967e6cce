"""Constants of tracking before a relief, as `constants` holds those of tracking before a plane."""

from __future__ import annotations

from typing import Final

# --- translation before a relief ----------------------------------------------------------------------------
# Direction of travel on slider_depth: 0.5 degrees off with one blur of 2 px, 3.5 with 2 and 1 px.
RELIEF_BLURS_START_PX: Final = (4.0, 2.0)
RELIEF_BLURS_PX: Final = (2.0,)
RELIEF_EVENTS: Final = 6_000
RELIEF_EVALUATIONS: Final = 14
# Windows with enough motion after which a scene can be called uneven, and after which it is called a plane. Largest
# unevenness within 12 windows: 0.04 on planes, 0.05 with a wide lens, 0.07 before a camera that only turns, 0.09 on
# slider_depth.
RELIEF_WINDOWS_MIN: Final = 8
RELIEF_WINDOWS: Final = 14
RELIEF_UNEVEN: Final = 0.08
# The same in planar mode, where windows are smaller (0.042 on slider_depth). In `planar` and `auto` a relief map is
# tried where the running score is below the second number: 0.30 to 0.45 before scenes with depth, 0.45 to 0.83 before
# planes.
RELIEF_UNEVEN_TOLD: Final = 0.04
RELIEF_TOLD_SCORE: Final = 0.6
# In `planar` and `auto` windows must also be sharper on the relief than on the plane: mean logarithm of the ratio of
# their contrasts, 0.014 and 0.028 on slider_depth, 0.03 to 0.04 before simulated walls at several depths; at most 0.005
# before photographs tilted by 35 and 45 degrees, whose plane is not found yet, most of them far below nothing.
RELIEF_SHARPER: Final = 0.01
# A larger step from one window to the next is events drawn together, not depth.
RELIEF_JUMP: Final = 0.04
# Windows after which nothing is decided any more: too little motion.
RELIEF_PATIENCE: Final = 60
# Longest time between two windows that a velocity is carried across, s.
RELIEF_GAP_S: Final = 0.2
# Image displacement a window should cover, px, where there is no map to align with.
RELIEF_DISPLACEMENT_PX: Final = 5.0
# Contrast by contrast without motion below which a window says nothing.
RELIEF_GAIN: Final = 1.03

# --- relief map ---------------------------------------------------------------------------------------------
# Where it does not say otherwise: chosen on slider_depth and simulated slides and hands before `planes`, `boxes` and
# `carpet` (docs/decisions/relief-map.md), coarsely; the figures there move by less than the seeds differ.
# Events of a window, at most, and those of them that it is aligned by.
RELIEF_MAP_EVENTS: Final = 8_000
RELIEF_ALIGN_EVENTS: Final = 4_000
# Slices of a window in each of which a landmark moves evenly.
RELIEF_SLICES: Final = 5
# Distances across a line within which an event may belong to it, px, closing; and that along it.
RELIEF_GATES_PX: Final = (6.0, 3.0, 2.0)
RELIEF_REACH_PX: Final = 2.5
# Gauss-Newton steps a gate, and the step, px, at which they end. With 2 instead of 5 a pose lags behind its events
# where texture is dense: a hand before `planes` is 9 % of its way off instead of 0.3.
RELIEF_ITERATIONS: Final = 5
RELIEF_STEP_PX: Final = 0.02
# Shares of the last speed from which an alignment may start, and the cost by the best so far that a later one needs.
# From the last speed alone slider_depth runs on for 0.3 s where the slider stops.
RELIEF_SPEEDS: Final = (1.0, 0.5, 0.0)
RELIEF_LEAD: Final = 0.95
# Motion across a line within a window, px, above which its events have one polarity.
RELIEF_SIGNED_PX: Final = 1.5
# Residual, px, at which an observation counts half; variance of one event's distance, px²; events of a landmark in a
# window beyond which more add nothing (they are correlated), and those that a new one counts for.
RELIEF_ROBUST_PX: Final = 1.0
RELIEF_VARIANCE_PX2: Final = 1.0
RELIEF_MOST_EVENTS: Final = 8
RELIEF_FRESH_EVENTS: Final = 4
# Standard deviation of a predicted pose: px, and a share of the displacement.
RELIEF_PREDICTED_PX: Final = 1.0
RELIEF_PREDICTED_SHARE: Final = 0.3
# Views that are solved together, and rounds of Gauss-Newton a window.
RELIEF_LAG: Final = 12
RELIEF_ROUNDS: Final = 3
# Side of a cell of inverse depth, px; one new landmark a block of the second, none within half of the third of a known
# one (with 3 instead of 7 slider_depth begins 15 degrees off its direction instead of 9, and is 3.3 off at its end).
RELIEF_CELL_PX: Final = 6
RELIEF_SPACING_PX: Final = 3
RELIEF_CLEAR_PX: Final = 7
# Standard deviations of a new landmark: offset, px, and inverse depth, by its value.
RELIEF_OFFSET_PX: Final = 5.0
RELIEF_DEPTH_SHARE: Final = 0.5
# Plane sweep: blur, px, and neighbourhood, cells, of its score; least score; inverse depths tried, from the middle one
# by this factor down and up. Without it slider_depth's far layer keeps the depth it began with: speed 25 % off, not 2.
RELIEF_SWEEP_BLUR_PX: Final = 1.0
RELIEF_SWEEP_CELLS: Final = 1.5
RELIEF_SWEEP_LEAST: Final = 0.05
RELIEF_SWEEP_RANGE: Final = 4.0
RELIEF_SWEEP_STEPS: Final = 24
# Landmarks so far outside the image, px, are not asked; within so far of its border one may be missed.
RELIEF_NEAR_PX: Final = 20.0
RELIEF_BORDER_PX: Final = 6.0
# Motion across a line within a window, px, above which it should be seen; windows in a row in which it may be missed,
# and a new one; windows that must have seen it until it is none.
RELIEF_TOLD_PX: Final = 2.0
RELIEF_MISSED: Final = 5
RELIEF_MISSED_FRESH: Final = 2
RELIEF_SEEN: Final = 3
# Median deviation of the landmarks' motion from a plane's by the mean, from which the scene is none; and where it is
# known that the camera does not turn. The first: 0.003 to 0.055 on the suite's planes and on posters and shapes before
# a hand, 0.09 on `distorted` (score 0.64, so that it is not asked); 0.10 on slider_depth, 0.09 to 0.16 on `planes` and
# `carpet`. The second: 0.005 to 0.019 on planes, 0.039 to 0.15 on scenes with depth.
RELIEF_OFF_PLANE: Final = 0.08
RELIEF_OFF_PLANE_STRAIGHT: Final = 0.03
# Standard deviation of an inverse depth, by the mean, below which landmarks count alike; deviation that counts half;
# and landmarks without which nothing is said.
RELIEF_KNOWN: Final = 0.05
RELIEF_OFF_ROBUST: Final = 0.1
RELIEF_LEAST: Final = 100
# Motion of the first window of a relief map, px; motion, px, below which a camera stands still.
RELIEF_MOVED_PX: Final = 2.5
RELIEF_STILL_PX: Final = 1.0
