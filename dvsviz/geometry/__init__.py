"""Rigid motions, the pinhole camera, planes and trajectories."""
