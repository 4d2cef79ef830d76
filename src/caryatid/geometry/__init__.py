"""Rigid transforms, shapes and their distances, polygons, sampling, rays; nothing about scenes."""

SPHERE, CYLINDER, BOX = 0, 1, 2
"""Codes of the kinds of shape that compiled kernels know."""
