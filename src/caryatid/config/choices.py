"""Names that settings and options choose from."""

from __future__ import annotations

from typing import Literal

FusionMethod = Literal["pc", "sg", "pc+sg"]
"""What to fuse over views: points, graphs, or both; section III-B."""
SegmentationMethod = Literal["labels", "auto"]
"""Source of segments: given labels, or automatic by local convexity."""
MaskIdentity = Literal["scene", "per-view"]
"""What a mask's number identifies: an object in all views, or a segment of one view."""
Preset = Literal["default", "paper"]
"""Settings to start from: caryatid's defaults, or those of the paper."""
NoiseModel = Literal["none", "carmine"]
"""Noise of the simulated camera."""
ShapeKind = Literal["box", "cylinder", "sphere"]
"""The primitives."""
CameraAxes = Literal["optical", "opengl", "body"]
"""Conventions of the axes of a camera frame."""
DepthKind = Literal["axis", "ray"]
"""What readings of depth are."""
GripperKind = Literal["none", "parallel", "suction"]
"""Grippers; with none, every object can be grasped."""
GripperName = Literal["none", "parallel", "suction", "franka", "robotiq-85", "robotiq-140", "so-101"]
"""Kinds of grippers, and those whose dimensions are known (`GRIPPERS`)."""
ExportFormat = Literal[
    "mjcf", "urdf", "usd", "gltf", "moveit", "dot",
]  # fmt: skip
"""Export formats of a scene model."""
