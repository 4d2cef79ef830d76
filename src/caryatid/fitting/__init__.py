"""Boxes, cylinders and spheres fitted to oriented points: search, least squares, scoring, uncertainty."""
