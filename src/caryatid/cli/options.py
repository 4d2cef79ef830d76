"""Options that commands share, and how they are parsed and shown."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from operator import attrgetter
from pathlib import Path
from pkgutil import resolve_name
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
)

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from caryatid.config import (
    FusionMethod,
    GripperName,
    MaskIdentity,
    NoiseModel,
    Preset,
    SegmentationMethod,
)
from caryatid.errors import InputError

if TYPE_CHECKING:
    from caryatid.cli.output import Output
    from caryatid.config import Config
    from caryatid.io.mask_sources import MaskSource
    from caryatid.robots.reachability import ReachabilityMap


def shown(metavar: str | None = None, default: object = "") -> object:
    """An option whose help shows no default, or a given one; `metavar` replaces the name of its type."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})" if default else "")


def default_of(setting: str) -> object:
    """An option for a setting, such as `active.max_views`, that shows the default of the setting."""
    from caryatid.config import Config

    return shown(default=attrgetter(setting)(Config()))


def planner_name() -> Any:
    """The name of a planner, including those of other packages, or module:Class."""
    from caryatid.planning.planners import BUILT_IN, ORACLE, offered

    class Names(tuple[str, ...]):
        """The names that are offered; others, with a colon, are accepted too."""

        def __contains__(self, name: Any) -> bool:
            return ":" in name or super().__contains__(name)

    names: Any = (*BUILT_IN, *sorted(offered()), ORACLE)
    kind: Any = Literal[names]
    known: Any = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, set()))
    return replace(known, choices=Names(names), instance_from_str=lambda words: words[0])


def number(
    kind: Callable[[str], float], metavar: str, what: str, least: float, most: float = inf
) -> PrimitiveConstructorSpec[Any]:
    """A number within bounds; anything else is a usage error."""

    def parse(words: list[str]) -> float:
        with suppress(ValueError):
            if least <= (value := kind(words[0])) <= most:
                return value
        raise ValueError(f"{words[0]} is not {what}")

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=parse,
        is_instance=lambda value: isinstance(value, int | float),
        str_from_instance=lambda value: [str(value)],
    )


REGISTRY = ConstructorRegistry()
"""How options are parsed, in addition to tyro's own rules."""


@REGISTRY.primitive_rule
def _parse_optional(info: PrimitiveTypeInfo) -> Any:
    """Parse `kind | None` like `kind`: the option may be omitted, and None is not one of its words."""
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if info.type_origin not in (Union, UnionType) or len(kinds) != 1:
        return None
    spec: Any = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    return replace(spec, is_instance=lambda value: value is None or spec.is_instance(value))


Flag = Annotated[bool, shown()]
Count = Annotated[int, number(int, "N", "an integer of at least 1", 1)]
Natural = Annotated[int, number(int, "N", "an integer of at least 0", 0)]
Seconds = Annotated[float, number(float, "SECONDS", "a time of at least 0", 0.0)]
Probability = Annotated[float, number(float, "P", "a probability from 0 to 1", 0.0, 1.0)]
OutPath = Annotated[Path, tyro.conf.arg(metavar="RUN")]
RunPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
SourceName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
Words = tyro.conf.UseAppendAction[tuple[str, ...]]
_Value = TypeVar("_Value")
Several = Annotated[tyro.conf.UseAppendAction[tuple[_Value, ...]], shown()]


@dataclass(frozen=True, kw_only=True)
class General:
    """Output options."""

    json: Flag = False
    """Print only the result, as one JSON document on stdout."""
    quiet: Flag = False
    """Do not print progress."""
    debug: Flag = False
    """Show the full traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of the method and the simulation."""

    config: Annotated[Path | None, shown("FILE.toml")] = None
    """TOML file of settings that override the defaults; `caryatid config` prints one with all settings."""
    set: Annotated[Words, tyro.conf.arg(metavar="STAGE.NAME=VALUE")] = ()
    """Change one setting, such as `--set fit.hypotheses=200`; overrides the file; may be repeated."""

    def read(
        self,
        options: Mapping[str, object] | None = None,
        named: Mapping[str, object] | None = None,
        base: Config | None = None,
    ) -> Config:
        """The configuration: options (name of a setting → value, or None) > --set > named > file > base."""
        from caryatid.config.settings import read_settings

        first, last = (
            [f"{name}={value}" for name, value in (given or {}).items() if value is not None]
            for given in (named, options)
        )
        return read_settings(self.config, (*first, *self.set, *last), base)


@dataclass(frozen=True, kw_only=True)
class Modelling(Settings):
    """Settings of the method."""

    preset: Preset = "default"
    """Settings to start from: caryatid's defaults, or those of the paper."""
    fusion: Annotated[FusionMethod | None, default_of("fusion.method")] = None
    """What to fuse over views: points (pc), graphs (sg), or both."""
    masks: Annotated[
        str | None, tyro.conf.arg(metavar="{scene,per-view,onnx:FILE,FOLDER}"), default_of("fusion.masks")
    ] = None
    """What mask numbers identify: objects (scene) or segments of a view (per-view).
    Or where masks come from: a model or a folder."""
    seed: Natural = 0
    """Random seed; the same seed gives the same graph, byte for byte."""

    def read(
        self,
        options: Mapping[str, object] | None = None,
        named: Mapping[str, object] | None = None,
        base: Config | None = None,
        *,
        takes_views: bool = False,
    ) -> Config:
        """The configuration, as `Settings.read` returns it, with the options here.

        Raises:
            InputError: Masks come from a model or folder, and the command does not take views.
        """
        from caryatid.config.settings import preset

        if self.masks_from is not None and not takes_views:
            reason = "this command takes only scene or per-view, because it reads no views"
            raise InputError(f"--masks {self.masks}", reason, "use it with explore, extract, clear or view")
        identity = None if self.masks_from else self.masks
        given = {"fusion.method": self.fusion, "fusion.masks": identity, **(options or {})}
        return super().read(given, named, base or preset(self.preset))

    @property
    def masks_from(self) -> str | None:
        """The model or folder that gives the masks, or None."""
        return None if self.masks in (None, *get_args(MaskIdentity)) else self.masks


@dataclass_transform(frozen_default=True, kw_only_default=True)
@dataclass(frozen=True, kw_only=True)
class Command:
    """A command: a dataclass of its options. `work` names the function that runs it, as `module:function`."""

    general: General = General()
    _work: ClassVar[str]

    def __init_subclass__(cls, work: str = "") -> None:
        dataclass(frozen=True, kw_only=True)(cls)
        cls._work = work

    def __call__(self) -> int | None:
        status: int | None = resolve_name(f"caryatid.cli.{self._work}")(self)
        return status

    @cached_property
    def output(self) -> Output:
        """Progress and results of the command."""
        from caryatid.cli.output import Output

        return Output(json=self.general.json, quiet=self.general.quiet)


class ComputingCommand(Command):
    """A command that computes."""

    threads: Annotated[Count | None, shown(default="CARYATID_THREADS, or all cores")] = None
    """Number of threads."""

    def __post_init__(self) -> None:
        if self.threads is not None:
            os.environ["CARYATID_THREADS"] = str(self.threads)


class LookingCommand(ComputingCommand):
    """A command that processes views."""

    settings: Modelling = Modelling()
    segmentation: Annotated[SegmentationMethod | None, shown(default="labels if available")] = None
    """Use the given masks or labels, or segment automatically."""
    ignore: Annotated[Path | None, shown("MASK.png")] = None
    """Pixels to ignore, such as the robot's arm: a grey PNG, 0 = keep; or a folder, one NAME.png per view."""

    @property
    def looking(self) -> dict[str, Any]:
        """The options that every processing of views takes."""
        return {"segmentation": self.segmentation, "seed": self.settings.seed}

    def mask_source(self, config: Config) -> MaskSource | None:
        """The source of masks, or None.

        Raises:
            InputError: The model or folder is missing or broken, or its masks would not be used.
        """
        from caryatid.io.mask_sources import mask_source

        settings = self.settings
        if settings.masks_from is None:
            return None
        if self.segmentation == "auto":
            reason = "cannot be combined with --segmentation auto, which uses no masks"
            raise InputError(f"--masks {settings.masks}", reason, "omit one of the two options")
        return mask_source(settings.masks_from, config, settings.seed)


class PlanningCommand(LookingCommand):
    """A command that plans the next best view."""

    planner: Annotated[
        Annotated[str, planner_name()] | None, shown(default="support; paper with --preset paper")
    ] = None
    """Planner of the next best view, or your own as module:Class; oracle uses the ground truth and requires a
    simulation."""
    robot: Annotated[str, tyro.conf.arg(metavar="NAME")] = "humanoid"
    """Robot that carries the camera: humanoid, arm:FILE.npz (a reachability map), or module:callable."""

    @property
    def chosen_planner(self) -> str:
        """The planner; by default that of the preset."""
        return self.planner or ("paper" if self.settings.preset == "paper" else "support")


class ExploringCommand(PlanningCommand):
    """A command that explores a scene."""

    views: Annotated[Count | None, default_of("active.max_views")] = None
    """Maximum number of views, including the first."""
    source: SourceName
    level: Flag = False
    """Rotate the world frame of a recording so that the table is level; use it if z does not point up."""
    noise: NoiseModel = "carmine"
    """Noise of the simulated camera: depth noise and registration error of a Carmine, or none."""
    keyframe: Annotated[str | None, shown("NAME", "home, or the only one")] = None
    """Name or number of the keyframe that an MJCF scene starts from."""

    def config(
        self, options: Mapping[str, object] | None = None, named: Mapping[str, object] | None = None
    ) -> Config:
        """All settings; options and named ones as for `Settings.read`."""
        given = {"active.max_views": self.views, **(options or {})}
        return self.settings.read(given, named, takes_views=True)


@dataclass(frozen=True, kw_only=True)
class LiftingCommand:
    """A command that decides which objects to lift."""

    goal: Annotated[str | None, shown("OBJECT")] = None
    """Id or name of the object to reach; remove no more than necessary."""
    hands: Literal[1, 2] = 1
    """Number of hands; with 2, one may hold an object while the other lifts one."""
    gripper: Annotated[GripperName | None, default_of("gripper.kind")] = None
    """Offer only lifts with a grasp on a free path; a name sets the settings `gripper.*`."""
    reach: Annotated[Path | None, shown("FILE.npz")] = None
    """Offer only grasps within an arm's reach: a reachability map of the gripper, in the world frame."""
    risk: Annotated[Probability | None, default_of("rehearsal.risk")] = None
    """Maximum probability that a lift moves another object."""

    def lift_settings(self) -> tuple[dict[str, object], dict[str, object]]:
        """Settings that have an option here, or None if omitted; and those of a gripper known by name."""
        from caryatid.config import GRIPPERS

        given: dict[str, object] = {"rehearsal.risk": self.risk, "gripper.kind": self.gripper}
        if (known := GRIPPERS.get(self.gripper or "")) is None:
            return given, {}
        names = ("opening", "finger", "length", "hand", "breadth", "turn")
        named = {f"gripper.{name}": getattr(known, name) for name in names}
        return given | {"gripper.kind": known.kind}, named

    def reachable(self, config: Config) -> ReachabilityMap | None:
        """Which gripper poses the arm reaches; None = all.

        Raises:
            InputError: The file is broken, not of the gripper in the world frame, or there is no gripper.
        """
        from caryatid.robots.reachability import read_reachability

        if self.reach is None:
            return None
        if config.gripper.kind == "none":
            reason = "is of no use without a gripper"
            raise InputError(f"--reach {self.reach}", reason, "add --gripper, such as --gripper franka")
        reachability = read_reachability(self.reach)
        reachability.check_use(self.reach, "gripper", "world")
        return reachability
