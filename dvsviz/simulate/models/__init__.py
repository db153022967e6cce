"""Motion and observation models: each a function that states its equation."""
