"""Choices that are made by name."""

from __future__ import annotations

from typing import Literal

FusionMethod = Literal["pc", "sg", "pc+sg"]
SegmentationMethod = Literal["labels", "auto"]
NoiseModel = Literal["none", "carmine"]
ShapeKind = Literal["box", "cylinder", "sphere"]
ExportFormat = Literal["mjcf", "urdf", "gltf", "graphml", "dot"]
