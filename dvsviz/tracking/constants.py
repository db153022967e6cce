"""Every tuned constant of the tracker: its unit, its value and where the value comes from.

A user sets none of them. A change here is checked against the accuracy benchmark (`make accuracy`).
"""

from __future__ import annotations

from typing import Final

# --- windows -------------------------------------------------------------------------------------------------
# Mean image displacement a window should cover, as a share of the image's width: 3 px of 240. Below 1 px events carry
# little structure, above 4 px of 240 constant velocity no longer holds.
WINDOW_DISPLACEMENT: Final = 3.0 / 240
# Of a slow camera whose windows show so many edge pixels, a window ends after so long (s), but covers at least so much;
# of a fast one it goes on for so long, but covers at most so much (4.5 px of 240 instead of 3 take a third of shake's
# windows away, and it is at 0.18 instead of 0.20 %). Slow ones:
# a hand's speed changes within 50 ms, and few edges want every px. Median over six seeds of rotdisk's rate of roll, off
# the gyroscope's: 0.81 (planar 0.88) deg/s without, 0.68 (0.60) with; low_texture, whose edges are few, stays as it is.
WINDOW_EDGE_PIXELS: Final = 600
WINDOW_SECONDS: Final = 0.03
WINDOW_SECONDS_FAST: Final = 0.012
WINDOW_DISPLACEMENTS: Final = (2.0 / 240, 4.5 / 240)
WINDOW_EVENTS_MIN: Final = 800
# The largest window, for a sensor of so many pixels; more in proportion where there are more.
WINDOW_EVENTS_MAX: Final = 60_000
WINDOW_PIXELS: Final = 240 * 180
# Longest focal length of the tracker's own images, px: 1280x720 at f = 1000 px is tracked to 0.06 % of the distance,
# far below what is asked, at a twentieth of real time.
FOCAL_PX: Final = 400.0
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
PRIOR_ROTATION_RAD: Final = 0.01
PRIOR_POSITION: Final = 0.01
RESIDUAL_VARIANCE: Final = 0.1
# Standard deviation (rad, plane distances) of the pull to the first pose until the first refinement.
ANCHOR: Final = 0.03
# Share of what a view's edges by chance pull a camera towards the plane that is taken off where the map is written.
# Without it rotdisk's camera flies into its map within a second; 1 costs accuracy where the texture is sparse.
CHANCE_SHARE: Final = 0.5
# After the last level: distances to the lines of the map blurred by so much (map px; 1.5 is half as accurate), steps,
# Huber's limit (px), the variance of a distance (px²) and the share of the events inside the map that must lie by one.
LINE_BLUR_PX: Final = 1.0
LINE_ITERATIONS: Final = 4
LINE_HUBER_PX: Final = 1.0
LINE_VARIANCE_PX2: Final = 1.0
LINE_SHARE: Final = 0.68
# Share of a view's grid, where the map is still being written, from which on its lines are not yet believed.
LINE_YOUNG: Final = 0.2
# A step below this image displacement, px, ends a level.
ALIGN_STEP_PX: Final = 0.02

# --- noise --------------------------------------------------------------------------------------------------
# Events of the eight neighbours that an event needs, by those of its own pixel: edges have two to five times as many.
NOISE_COMPANY: Final = 0.5
# Events that must be left; where fewer have company, all are kept: what is left of noise lies in clumps, which fit
# anything. Where a wall is empty for a second the camera is 50 instead of 90 % off at most.
NOISE_HEARD: Final = 500
# Correlation of neighbouring pixels' counts below which a window shows noise alone: at most 0.02 on noise of 0.3 to 5
# events a pixel and second, hot pixels among them, and on a flash; at least 0.2 on shapes and photographs in it.
NOISE_ALIKE: Final = 0.08
# The same that the first window needs where noise came before it, as it holds all others, and windows after which it is
# no longer waited for: 0.2 to 0.5 in noise of 5 events a pixel and second, at least 0.4 in that of 1.
NOISE_START_ALIKE: Final = 0.4
NOISE_START_WINDOWS: Final = 10
# Image displacement in the longest window, as a share of the width, below which a camera that then shows noise alone
# has come to rest: 6 px of 240 in 100 ms; 4 px are left where it brakes over half a second, 9 and more where a hand
# covers the lens.
NOISE_STILL: Final = 6.0 / 240

# --- map ----------------------------------------------------------------------------------------------------
# Saturation k of M = 1 - exp(-k rate / p90). 8 s of shapes, online error: 0.7 lost its hold (1.3 %), 1.0 0.42 %,
# 1.4 0.52 %, 2 0.78 %, 4 1.5 %.
MAP_SATURATION: Final = 1.0
# Cells of the exposure grid, map px.
EXPOSURE_CELL_PX: Final = 8
# A cell seen for this much image displacement, px, is no longer written.
FREEZE_DISPLACEMENT_PX: Final = 120.0
# Margin by which the map grows, px.
MAP_MARGIN_PX: Final = 128
# Events of a window that tell how far the map must reach.
COVER_EVENTS: Final = 200
# Windows a map has, from which on its density is measured anew only every so many windows.
DENSITY_AFTER: Final = 32
DENSITY_EVERY: Final = 8
# Largest map, cells: 16 million cells are 64 MB a layer.
MAP_MAX_CELLS: Final = 16_000_000

# --- panorama -----------------------------------------------------------------------------------------------
# Turn away from the nearest face, rad, at which a new one is made: 30 degrees, with half a usual view beyond it 61.
FACE_APART_RAD: Final = 0.524
# By how much another face must be nearer, rad, before it is taken.
FACE_LEAD_RAD: Final = 0.09
# How far from its centre a face is written, in its distances: 63 degrees, where a cell shows a fifth of a pixel's area.
FACE_REACH: Final = 2.0
# The same in a refinement: 40 degrees; what lies beyond is another face's.
FACE_REFINED: Final = 0.84
# Turn away from a face's centre, rad, within which a view still shows something of it.
FACE_SEEN_RAD: Final = 1.05
# Windows that must agree on how far off a loop is, the px by which they may differ, and from which it is closed.
LOOP_WINDOWS: Final = 5
LOOP_SPREAD_PX: Final = 2.0
LOOP_PX: Final = 1.0

# --- status -------------------------------------------------------------------------------------------------
# Bad windows in a row after which the tracker says that it is lost.
LOST_WINDOWS: Final = 2
# Overlap below which a keyframe is tried (section 2.2.3).
OVERLAP_KEYFRAME: Final = 0.8
# Share of the pixel scale at which a map value counts as an edge when overlap is measured.
OVERLAP_EDGE: Final = 0.3

# --- refinement ---------------------------------------------------------------------------------------------
# Rounds of the last refinement and of the others; the gate closes over the first four.
REFINE_ROUNDS: Final = 8
REFINE_ROUNDS_LATER: Final = 6
# Windows below which a refinement is an early one: the plane is still a guess, and few windows are soon refined. So
# many times the rounds, and by how much more the result may disagree: what it is compared with was laid window by
# window on the map of the same windows. A photograph at 35 degrees: lost at 12 % with 1 and 1, 0.9 % with these; at 45
# degrees 0.42 and 0.29 %, as known then 3.0 and 1.4; low_texture 0.68 and 0.59.
REFINE_EARLY_VIEWS: Final = 60
REFINE_EARLY_ROUNDS: Final = 4
REFINE_EARLY_WORSE: Final = 1.05
# Rounds of the last one with all events: rotdisk's rate of roll is 0.80 instead of 0.91 deg/s off the gyroscope's.
REFINE_ROUNDS_WITH_ALL: Final = 2
# Iterations of conjugate gradients a round, and the residual, by that at the start, at which they end.
REFINE_ITERATIONS: Final = 40
REFINE_TOLERANCE: Final = 1e-2
# Events in a refinement, but for the last one: of 240 windows 5,000 each. With 600,000 shapes_6dof is at 0.23 instead
# of 0.20 %, shake at 0.26 instead of 0.23; with all of them at 0.20 and 0.23.
REFINE_EVENTS: Final = 1_200_000
REFINE_LAST_EVENTS: Final = 2_400_000
# Rounds over which the gate closes.
REFINE_CLOSING: Final = 4
# Gate on an event's distance to its edge, map px, first and last round.
REFINE_GATE_START_PX: Final = 5.0
REFINE_GATE_END_PX: Final = 2.0
# Gate when the result is judged on held-out events, map px.
REFINE_JUDGE_GATE_PX: Final = 3.0
REFINE_RIDGE_BLUR_PX: Final = 1.2
# Height of the blurred edge image (0 to 1) that a ridge pixel must reach.
REFINE_RIDGE_LEVEL: Final = 0.15
REFINE_LANDMARKS: Final = 3_000
# Events of a view that a landmark needs, and the number beyond which more add no weight (they are correlated).
REFINE_MIN_EVENTS: Final = 2
REFINE_MAX_EVENTS: Final = 8
# Standard deviations of the start that a refinement leaves only for good reason: pose (rad, plane distances) and normal
# (rad). They decide where the texture does not: the first second hardly tells motion along x from rotation about y.
# A plane at 45 degrees is far from the start: with 0.1 the first view is torn from the others by 1 to 3 %, with 0.3 by
# half of it, and 1 is no better.
REFINE_PRIOR_POSE: Final = 0.3
# Views from which on more do not hold the start more strongly. With 240 instead of 60 slider_close, whose straight way
# hardly tells the normal, is at 0.6 instead of 0.8 %, and the first 17 s of low_texture at 1.0 instead of 0.7 %.
REFINE_PRIOR_VIEWS: Final = 120
REFINE_PRIOR_NORMAL_RAD: Final = 0.25
# Variance of an observation, px², and how many neighbouring observations share one error.
REFINE_VARIANCE_PX2: Final = 0.25
REFINE_CORRELATED: Final = 50.0
# Largest step (rad, plane distances) below which the rounds end early.
REFINE_STEP: Final = 2e-4
# Keyframe counts at which all keyframes are refined together: each about 1.5 times the last.
REFINE_AT: Final = (5, 8, 12, 18, 27, 40, 60, 90, 130, 190, 280, 400, 600, 900)
# Image motion among the keyframes, as a share of the width, without which nothing is refined: over a smaller one the
# plane's tilt, turning and moving sideways look alike, and a refinement only wanders.
REFINE_SPREAD: Final = 0.2
# A refinement is merged so many windows after it began for each keyframe beyond these: it runs beside the tracker, and
# always lands at the same window. Over two seeds explore is at 0.18 instead of 0.13 % with 2 instead of 1 (as known
# then 0.44 and 0.52), low_texture at 0.7 instead of 0.6; it waits for half as long.
REFINE_WINDOWS: Final = 2
REFINE_AT_ONCE: Final = 8
# Rounds, with all events, where there was too little motion to refine the usual way. Two window sizes on shapes_start
# agree to 0.11 % of the distance and 0.16 degrees (0.28 and 0.11 by putting windows back on their map again and again,
# which moves the camera nearer to it each time); over 31 short stretches of nine recordings of the suite the median
# error is 0.41 % and 0.17 degrees (1.00 and 0.44).
SETTLE_ROUNDS: Final = 20
# Standard deviation of the pull to the first pose meanwhile, rad and plane distances: with 0.03 the median is 1.3 %.
SETTLE_PRIOR_POSE: Final = 0.1
# Most windows in one refinement: keyframes, then others, evenly thinned beyond.
REFINE_MAX_VIEWS: Final = 240
# Of the last refinement, after which nobody waits for the next window: with 240 shapes_6dof is at 0.16 instead of
# 0.13 %, shake at 0.26 instead of 0.20; it takes a third longer.
REFINE_LAST_VIEWS: Final = 480
# Of a live run, which shares its cores with server and page and waits for no refinement.
REFINE_LIVE_VIEWS: Final = 120
# Longest time between two poses, s, across which a motion is smooth, and by how much more freely it may accelerate than
# its windows did half of the time: with 3 instead of 30 rotdisk's rate of roll is 0.96 instead of 0.81 deg/s off
# (planar 0.80 instead of 0.71), low_texture at 1.04 instead of 0.94 %.
SMOOTH_GAP_S: Final = 0.4
SMOOTH_MARGIN: Final = 30.0

# --- keyframes ----------------------------------------------------------------------------------------------
# Image displacement since the nearest keyframe, as a share of the image's width, that makes a new one.
KEYFRAME_DISPLACEMENT: Final = 0.12
# Seconds after which the next well-tracked window becomes a keyframe in any case.
KEYFRAME_SECONDS: Final = 0.5
# Keyframes after which the two limits above hold in full; before, they grow from a fifth.
KEYFRAME_SETTLED: Final = 16
# Events of a window that are kept for the map and for refinement.
TRACE_EVENTS: Final = 3_000
# The same of a keyframe.
KEYFRAME_EVENTS: Final = 12_000

# --- relocalization -----------------------------------------------------------------------------------------
# Recording time between two searches while lost, us.
RELOCALIZE_EVERY_US: Final = 30_000
RELOCALIZE_REDUCTION: Final = 4
RELOCALIZE_TURNS: Final = 24
RELOCALIZE_CANDIDATES: Final = 8
RELOCALIZE_ITERATIONS: Final = (8, 6, 6)
RELOCALIZE_MIN_EVENTS: Final = 300
RELOCALIZE_KEYFRAMES: Final = 40
# Score a pose needs to be believed, relative to the median score while tracking well, and lead over the runner-up.
RELOCALIZE_SCORE: Final = 0.75
RELOCALIZE_LEAD: Final = 0.05
# How many times nearer to the plane, or farther, than every keyframe a pose may be found: the search compares views of
# one size, and what is found beyond lies on a few cells by chance.
RELOCALIZE_NEARER: Final = 2.0
# Keyframes, from the last one back, that a new view is compared with.
KEYFRAME_COMPARE: Final = 40
# Keyframes after which the map's texture is published anew between refinements.
REVISION_KEYFRAMES: Final = 4

# --- motion and judgement -----------------------------------------------------------------------------------
# Filter of the motion. Standard deviations at the start and after a loss: pose (rad, plane distances) and velocity; a
# camera that was lost, or put somewhere by hand in the middle of a blow, may be fast.
# Acceleration's spectral density (rad²/s³, distances²/s³) at the start and its limits: on low_texture with a true map
# the error is 9.5 degrees with a least density of 0.001, 0.7 with 0.03, 0.35 with 0.2, 0.84 with 1; 0.87 by a fixed
# gain on the velocity.
FILTER_POSE_START: Final = 0.01
FILTER_SPEED_START: Final = 0.5
FILTER_SPEED_LOST: Final = 5.0
FILTER_DENSITY_START: Final = 1.0
FILTER_DENSITY: Final = (0.2, 1e4)
# Standard deviation of what a prediction always leaves open, rad and plane distances.
FILTER_POSE_FLOOR: Final = 0.001
# Events of one window that share one error: its information is divided by it.
FILTER_CORRELATED: Final = 10.0
# Directions (0 to 3) that a window must have told for the density to follow it, and how fast it does.
FILTER_TOLD: Final = 0.3
FILTER_ADAPT: Final = 0.05
# Penalty of a window's motion by contrast alone, per squared px of displacement, in units of its contrast: it decides
# only between motions that look alike.
CONTRAST_RIDGE: Final = 1e-3
CONTRAST_BLURS_PX: Final = (4.0, 2.0, 1.0)
CONTRAST_EVALUATIONS: Final = 30
# Events used for a motion by contrast alone, and for a window's images.
CONTRAST_EVENTS: Final = 8_000
MEASURE_EVENTS: Final = 8_000
# Votes above which a pixel of a window's image holds an edge, at least.
EDGE_VOTES: Final = 1.5
# Score by the running score of good windows: below, a window is weak or bad.
WEAK_RATIO: Final = 0.7
LOST_RATIO: Final = 0.45
# The same below which the pose is looked for along the two directions that the window tells least of, and how far, in
# rad and plane distances together: before few edges turning and moving sideways look alike until the next shape comes
# into view, beside its place on the map (`low_texture`: ten degrees in half a second).
PROBE_RATIO: Final = 0.9
PROBE_DIRECTIONS: Final = 2
PROBE_STEPS: Final = (0.06, 0.12, 0.24)
# Events by which the places are compared; the best of them is then aligned with all.
PROBE_EVENTS: Final = 700
# By how much, as a share of the running score, a pose so found must be better.
PROBE_LEAD: Final = 0.05
# Share of events inside the map below which a window is bad.
LOST_INSIDE: Final = 0.4
# Condition of the pose's information above which a direction counts as not seen.
WEAK_CONDITION: Final = 3e4
# Level of the pyramid and pixels along the width at which the slopes in view are compared, and the smaller by the
# larger of their two directions below which only stripes are seen: 0.02 to 0.06 on stripes, at least 0.48 on shapes
# and posters.
STRIPES_LEVEL: Final = 1
STRIPES_COLUMNS: Final = 120
STRIPES_SHARE: Final = 0.08
# Share by which the running score follows each good window.
SCORE_GAIN: Final = 0.05
# Edge pixels in view below which there is too little texture.
TEXTURE_EDGE_PIXELS: Final = 150
# The same where a direction is not seen: a few stripes are texture, but only in one direction.
STRIPES_EDGE_PIXELS: Final = 50

# A camera is placed by hand within so many plane distances of the first one.
PLACE_MOST: Final = 1e3

# --- gyroscope ----------------------------------------------------------------------------------------------
# Standard deviation of a bias that nobody knows yet, rad/s: that of rotdisk's sensor is 0.056.
GYRO_BIAS_RAD_S: Final = 0.05
# Noise of a turn, rad² a second: 0.003 rad/s of each sample at 1 kHz is 1e-8; a MEMS sensor with vibration ten times.
GYRO_NOISE_RAD_S2: Final = 1e-7
# Walk of the bias, rad/s an sqrt(s).
GYRO_WALK: Final = 2e-4
# Time over which a tracked rotation is compared, s, and its standard deviation at either end, rad.
GYRO_LEARN_S: Final = 0.5
GYRO_TRACKED_RAD: Final = 0.004
# Standard deviation, rad, of a tracked pose that the next one is predicted from: a tighter prior would keep its error.
GYRO_POSE_RAD: Final = 0.005
# Longest gap between two samples that is bridged, us.
GYRO_GAP_US: Final = 50_000
# How fast the position grows uncertain while nothing is seen, plane distances a second, and how far.
GYRO_DRIFT: Final = 0.1
GYRO_DRIFT_MOST: Final = 0.15
# A gyroscope is believed after what it says of so long (s) was seen too, and forsaken when it says something else. It
# may be off by a bias (five times its deviation), and by a share of the rate: scale, and a few milliseconds of delay.
GYRO_CHECK_S: Final = 0.1
GYRO_OFF_RAD_S: Final = 0.3
GYRO_OFF_SHARE: Final = 0.15
# Agreements that are remembered, and those that are wanted of one that was forsaken (of 0.1 s each).
GYRO_TRUST_MOST: Final = 3
GYRO_TRUST_AGAIN: Final = 5

# --- failures -----------------------------------------------------------------------------------------------
FAILURE_EVENTS: Final = 300
# Image displacement in one window, px, beyond the reach of the alignment's coarsest blur.
FAILURE_FAST_PX: Final = 12.0
# A window whose contrast without motion is at least the first number, and so many times that with the motion it was
# given, shows edges that the motion smears: 0.06 to 0.3 and 1.7 to 3 times at a blow's end, 0.01 before a bare wall.
FAILURE_SHARP: Final = 0.03
FAILURE_SHARPER: Final = 1.5
# Difference (px in one window) between the motion that was predicted and the one that the window itself shows, beyond
# which the search could not follow.
FAILURE_JUMP_PX: Final = 6.0
# A way back found so soon (s) and so near (rad, plane distances) was there all along: a local optimum.
# Windows without texture or events in a failure from which that is its cause, whatever lost the map first: nothing was
# to be seen for a fifth of a second (two windows that time closed).
FAILURE_BLIND_WINDOWS: Final = 2
FAILURE_NEAR_S: Final = 0.25
FAILURE_NEAR: Final = 0.15
# Weak windows in a row that count as a failure; a lost one always does.
FAILURE_WEAK_WINDOWS: Final = 3

# Distance to the plane (plane distances) below which a pose is not believed as a start for a motion by contrast.
PLANE_TOO_NEAR: Final = 0.05

# --- mode contrast ------------------------------------------------------------------------------------------
# Not tuned further: shapes_6dof and slider_close decide (docs, "Mode contrast").
# Blurs (px) and evaluations of each stage of a window: alone from the last velocity, then with the map.
STAGE_BLURS_PX: Final = (2.0, 1.0)
STAGE_EVALUATIONS: Final = 12
# Penalty per squared px that a window's motion leaves its prediction, in units of its contrast.
STAGE_RIDGE: Final = 1e-3
# Strength of the map's edges in the joint image, by that of the window's own.
STAGE_TEXTURE: Final = 1.0
# Cells around a window's place on the map.
STAGE_MARGIN_PX: Final = 16
# The joint refinement of all keyframes: blurs (cells), evaluations of each, penalty per squared px of a keyframe.
JOINT_BLURS_PX: Final = (2.0, 0.8)
JOINT_EVALUATIONS: Final = 40
JOINT_RIDGE: Final = 1e-4
# Most keyframes in one joint refinement.
JOINT_MAX_VIEWS: Final = 40
# Rise of the joint contrast on held-out events beyond which it is not believed: at most 1.1 on shapes_6dof, 4e7 on
# slider_depth, which is no plane.
JOINT_RISE: Final = 1.5
# What the other keyframes explain of a new one, by what they explain of the one before, below which it is refused: at
# least 0.8 on 3 s of shapes.
JOINT_OVERLAP: Final = 0.6
