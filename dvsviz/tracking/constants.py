"""Every tuned constant of the tracker: its unit, its value and where the value comes from.

A user sets none of them. A change here is checked against the accuracy benchmark (`make accuracy`).
"""

from __future__ import annotations

from typing import Final

# --- windows -------------------------------------------------------------------------------------------------
# Mean image displacement a window should cover, px: below 1 px events carry little structure, above 4 px constant
# velocity and the map's blur no longer hold.
WINDOW_DISPLACEMENT_PX: Final = 3.0
WINDOW_EVENTS_MIN: Final = 800
WINDOW_EVENTS_MAX: Final = 60_000
WINDOW_EVENTS_START: Final = 4_000
# Largest change of the window size from one window to the next.
WINDOW_GROWTH: Final = 1.5

# --- alignment with the map ---------------------------------------------------------------------------------
# Gaussian blurs (map px) of the pyramid and Gauss-Newton iterations at each.
ALIGN_BLURS_PX: Final = (4.0, 2.0, 0.8)
ALIGN_ITERATIONS: Final = (3, 3, 4)
# Events sampled a window: sparse shapes need 1,000 to 2,000.
ALIGN_EVENTS: Final = 2_000
# Scale of the robust residual weight; residuals lie in [0, 1].
ALIGN_ROBUST: Final = 0.7
# Standard deviations of the constant-velocity prediction that damp weak directions: rad and plane distances, and the
# residual's variance that turns them into information.
PRIOR_ROTATION_RAD: Final = 0.02
PRIOR_POSITION: Final = 0.02
RESIDUAL_VARIANCE: Final = 0.1
# A step below this image displacement, px, ends a level.
ALIGN_STEP_PX: Final = 0.02

# --- map ----------------------------------------------------------------------------------------------------
# Saturation k of M = 1 - exp(-k rate / p90).
MAP_SATURATION: Final = 2.0
# Cells of the exposure grid, map px.
EXPOSURE_CELL_PX: Final = 8
# A cell seen for this much image displacement, px, is no longer written.
FREEZE_DISPLACEMENT_PX: Final = 120.0
# Margin by which the map grows, px.
MAP_MARGIN_PX: Final = 128
# Largest map, cells: 16 million cells are 64 MB a layer.
MAP_MAX_CELLS: Final = 16_000_000

# --- status -------------------------------------------------------------------------------------------------
SCORE_WEAK: Final = 0.25
SCORE_LOST: Final = 0.12
# Windows in a row below SCORE_LOST after which the tracker says that it is lost.
LOST_WINDOWS: Final = 2
# Overlap below which a keyframe is tried (section 2.2.3).
OVERLAP_KEYFRAME: Final = 0.8
# Share of the pixel scale at which a map value counts as an edge when overlap is measured.
OVERLAP_EDGE: Final = 0.3
