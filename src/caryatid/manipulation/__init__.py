"""Removal of objects: effects, and a safe order."""
