"""The support surface, and the segments of one view that stand on it."""
