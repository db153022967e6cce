"""Events, recordings of them, and windows."""
