"""A run on disk: what was done, what was seen, what came of it."""
