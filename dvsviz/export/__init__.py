"""What leaves a session: rerun recordings, TUM trajectories."""
