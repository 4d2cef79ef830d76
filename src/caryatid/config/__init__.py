"""Every tunable number of caryatid, one frozen dataclass a stage; the paper's values where it gives them."""

from __future__ import annotations

from dataclasses import dataclass, field

from caryatid.config.choices import (
    FusionMethod,
    NoiseModel,
    SegmentationMethod,
)
from caryatid.config.modelling import (
    CompletionConfig,
    ExplanationConfig,
    FitConfig,
    FusionConfig,
    PlausibilityConfig,
    SplitConfig,
    SupportConfig,
)
from caryatid.config.perception import (
    CloudConfig,
    MaskConfig,
    RegistrationConfig,
    SegmentationConfig,
    SurfaceConfig,
)
from caryatid.config.planning import (
    ActiveVisionConfig,
    ArmConfig,
    RobotConfig,
    VoxelConfig,
)
from caryatid.config.reporting import (
    EvaluationConfig,
    ExportConfig,
    LiftConfig,
    OracleConfig,
    RecordingConfig,
    RehearsalConfig,
    ReportConfig,
    SessionConfig,
    StatisticsConfig,
)
from caryatid.config.simulation import (
    NoiseConfig,
    PhysicsConfig,
    SensorConfig,
)


@dataclass(frozen=True, slots=True)
class Config:
    """All stages.

    Attributes:
        cloud: From depth image to oriented points.
        surface: The support surface.
        registration: Refining the reported poses of views.
        segmentation: Automatic parts by local convexity.
        fit: Primitive fitting.
        split: Parting what was taken for one object.
        explanation: What it costs to explain points by shapes.
        completion: How far shapes reach where nobody looked.
        plausibility: Shapes that neither overlap nor float.
        support: Support relations, section III-A.
        fusion: Fusing graphs over views, section III-B.
        voxels: The voxel map.
        active: The choice of the next view, section IV.
        robot: The simulated humanoid.
        arm: An arm with a camera in its hand.
        noise: Noise of the simulated camera.
        sensor: The simulated camera's image.
        physics: Settling a simulated scene, and its truth.
        lift: One object lifted straight up.
        rehearsal: Lifts tried before they are done.
        recording: Which frames of a recording become views.
        export: What other programs want to know.
        report: The pictures of the report.
        evaluation: Scores against a truth.
        oracle: The planner that knows the truth.
        session: What a session refuses.
    """

    cloud: CloudConfig = field(default_factory=CloudConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    split: SplitConfig = field(default_factory=SplitConfig)
    explanation: ExplanationConfig = field(default_factory=ExplanationConfig)
    completion: CompletionConfig = field(default_factory=CompletionConfig)
    plausibility: PlausibilityConfig = field(default_factory=PlausibilityConfig)
    support: SupportConfig = field(default_factory=SupportConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    voxels: VoxelConfig = field(default_factory=VoxelConfig)
    active: ActiveVisionConfig = field(default_factory=ActiveVisionConfig)
    robot: RobotConfig = field(default_factory=RobotConfig)
    arm: ArmConfig = field(default_factory=ArmConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    rehearsal: RehearsalConfig = field(default_factory=RehearsalConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    report: ReportConfig = field(default_factory=ReportConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    oracle: OracleConfig = field(default_factory=OracleConfig)
    session: SessionConfig = field(default_factory=SessionConfig)


__all__ = [
    "ActiveVisionConfig",
    "ArmConfig",
    "CloudConfig",
    "CompletionConfig",
    "Config",
    "EvaluationConfig",
    "ExplanationConfig",
    "ExportConfig",
    "FitConfig",
    "FusionConfig",
    "FusionMethod",
    "LiftConfig",
    "MaskConfig",
    "NoiseConfig",
    "NoiseModel",
    "OracleConfig",
    "PhysicsConfig",
    "PlausibilityConfig",
    "RecordingConfig",
    "RegistrationConfig",
    "RehearsalConfig",
    "ReportConfig",
    "RobotConfig",
    "SegmentationConfig",
    "SegmentationMethod",
    "SensorConfig",
    "SessionConfig",
    "SplitConfig",
    "StatisticsConfig",
    "SupportConfig",
    "SurfaceConfig",
    "VoxelConfig",
]
