# ruff: noqa: F405
"""Every setting of caryatid, one frozen dataclass per stage (`stages`), and TOML files of them (`settings`).

Names of choices are imported at once, the stages with pydantic when they are first needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.config.choices import (
    ExportFormat,
    FusionMethod,
    GripperKind,
    GripperName,
    MaskIdentity,
    NoiseModel,
    Preset,
    SegmentationMethod,
    ShapeKind,
)
from caryatid.runtime import imported_late

__all__ = [
    "GRIPPERS", "ActiveVisionConfig", "ArmConfig", "CloudConfig", "CompletionConfig", "Config",
    "EvaluationConfig", "ExplanationConfig", "ExportConfig", "ExportFormat", "FitConfig", "FusionConfig",
    "FusionMethod", "Gripper", "GripperConfig", "GripperKind", "GripperName", "LiftConfig", "MaskConfig",
    "MaskIdentity", "NoiseConfig", "NoiseModel", "OracleConfig", "PhysicsConfig", "PlausibilityConfig",
    "Preset", "RecordingConfig", "RegistrationConfig", "RehearsalConfig", "ReportConfig", "RobotConfig",
    "SegmentationConfig", "SegmentationMethod", "SensorConfig", "SessionConfig", "ShapeKind",
    "SplitConfig", "SupportConfig", "SurfaceConfig", "VoxelConfig", "choose_gripper",
]  # fmt: skip

if TYPE_CHECKING:
    from caryatid.config.stages import *  # noqa: F403
else:
    __getattr__ = imported_late(__name__, {"stages": __all__})
