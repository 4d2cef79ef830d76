# ruff: noqa: F405
"""Every setting of caryatid, one frozen dataclass per stage (`stages`), and TOML files of them (`settings`).

Names that settings and options choose from are here, the stages are imported with pydantic when first needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from caryatid.runtime import imported_late

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
GripperKind = Literal["none", "parallel", "suction"]
"""Grippers; with none, every object can be grasped."""
ExportFormat = Literal["mjcf", "urdf", "gltf", "graphml", "dot"]
"""Export formats of a scene model."""

__all__ = [
    "ActiveVisionConfig", "ArmConfig", "CloudConfig", "CompletionConfig", "Config", "EvaluationConfig",
    "ExplanationConfig", "ExportConfig", "ExportFormat", "FitConfig", "FusionConfig", "FusionMethod",
    "GripperConfig", "GripperKind", "LiftConfig", "MaskConfig", "MaskIdentity", "NoiseConfig", "NoiseModel",
    "OracleConfig", "PhysicsConfig", "PlausibilityConfig", "Preset", "RecordingConfig", "RegistrationConfig",
    "RehearsalConfig", "ReportConfig", "RobotConfig", "SegmentationConfig", "SegmentationMethod",
    "SensorConfig", "SessionConfig", "ShapeKind", "SplitConfig", "SupportConfig", "SurfaceConfig",
    "VoxelConfig",
]  # fmt: skip

if TYPE_CHECKING:
    from caryatid.config.stages import *  # noqa: F403
else:
    __getattr__ = imported_late(__name__, {"stages": __all__})
