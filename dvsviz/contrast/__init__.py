"""Contrast maximization: warps, images of warped events, objectives, solvers."""
