"""Comparison of trajectories with truth: association, alignment, ATE, RPE."""
