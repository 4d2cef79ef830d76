"""Choices that are made by name."""

from __future__ import annotations

from typing import Literal

FusionMethod = Literal["pc", "sg", "pc+sg"]
"""What is fused over views: points, graphs, or both; section III-B."""
SegmentationMethod = Literal["labels", "auto"]
"""Where segments come from: given labels, or local convexity."""
MaskIdentity = Literal["scene", "per-view"]
"""What the number of a mask means: an object in all views, or a segment of one view."""
Preset = Literal["default", "paper"]
"""Settings to start from: caryatid's own, or those of the paper."""
NoiseModel = Literal["none", "carmine"]
"""Noise of the simulated camera."""
ShapeKind = Literal["box", "cylinder", "sphere"]
"""The primitives."""
ExportFormat = Literal["mjcf", "urdf", "gltf", "graphml", "dot"]
"""Formats a scene model is written in."""
