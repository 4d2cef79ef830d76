"""Boxes, cylinders and spheres fitted to oriented points: search, least squares, scoring, uncertainty.

Kernels take a shape as a code and an array (5, 3): axes, columns = x, y, z, centre and half extents [m].
"""
