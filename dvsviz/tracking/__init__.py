"""The tracker: alignment, planar map, keyframes, refinement, relocalization."""
