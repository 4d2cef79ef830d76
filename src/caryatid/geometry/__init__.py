"""Rigid transforms, shapes and their distances, polygons, sampling, rays; nothing about scenes."""
