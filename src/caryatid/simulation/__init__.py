"""Simulated tables: scenes in physics, a depth camera without GL, and the truth about what holds up what."""
