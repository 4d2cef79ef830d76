"""Named suites: which methods meet which scenes, under which conditions, how often."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

from caryatid.benchmark.episodes import ORDERS, Episode, OrderName, content_of, family, plugin_of
from caryatid.benchmark.store import Member
from caryatid.config import Config, FusionMethod, NoiseModel, SegmentationMethod
from caryatid.config.settings import read_settings
from caryatid.errors import InputError
from caryatid.planning.planners import VOLUMETRIC

DESIGNED = ("tower", "bridge", "counterweight", "leaning_plank", "hidden_stack", "shelf", "clutter")
"""Scenes with one difficulty each."""
PILES = tuple(
    f"pile-{size}-{seed}" for seed, size in enumerate((4, 5, 6, 8, 10, 12, 14, 16, 18, 20), start=1)
)
"""Primitives set down one by one, 4 to 20."""
HEAPED = tuple(f"pile-{6 + i % 7}-{401 + i}" for i in range(60))
"""Piles of 6 to 12 to be taken apart; nothing is tuned on these seeds."""
DENSE = tuple(f"dense-{10 + i % 16}-{301 + i}" for i in range(32))
"""Heaps of 10 to 25 between screens and walls; nothing is tuned on these seeds."""


@dataclass(frozen=True, slots=True)
class Method:
    """One line of a figure.

    Attributes:
        label: Its name there.
        planner: Who chooses the views.
        fusion: What is fused.
        settings: Changes of the default settings.
        order: How objects are put in order to be taken away; empty where nothing is.
    """

    label: str
    planner: str = "support"
    fusion: FusionMethod = "pc+sg"
    settings: tuple[str, ...] = ()
    order: OrderName = ""


@dataclass(frozen=True, slots=True)
class Condition:
    """What the camera gives.

    Attributes:
        label: Its name; figures are drawn for each.
        noise: Noise model of the camera.
        segmentation: Where segments come from.
        settings: Changes of the default settings.
    """

    label: str
    noise: NoiseModel = "carmine"
    segmentation: SegmentationMethod = "labels"
    settings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Suite:
    """Methods × conditions × scenes × seeds.

    Attributes:
        name: Its name on the command line.
        what: What it shows, in one sentence.
        methods: What is compared.
        scenes: Names of built-in scenes, or scene folders.
        conditions: What the camera gives.
        seeds: Seeds 0…n−1.
        views: Views an episode, including the first.
        reference: Method the others are compared with; None for the first.
        gap: Two methods, such as random choice and the oracle: how much of their gap each other one closes.
    """

    name: str
    what: str
    methods: tuple[Method, ...]
    scenes: tuple[str, ...]
    conditions: tuple[Condition, ...] = (Condition("labels, Carmine noise"),)
    seeds: int = 3
    views: int = 5
    reference: str | None = None
    gap: tuple[str, str] | None = None

    def members(self) -> list[Member]:
        """All episodes, those of a scene one after the other."""
        content = {scene: content_of(scene) for scene in self.scenes}
        plugins = {method.planner: plugin_of(method.planner) for method in self.methods}
        cross = product(self.scenes, range(self.seeds), self.conditions, self.methods)
        return [
            Member(
                Episode(
                    scene=scene,
                    content=content[scene],
                    fusion=method.fusion,
                    planner=method.planner,
                    plugin=plugins[method.planner],
                    segmentation=condition.segmentation,
                    noise=condition.noise,
                    settings=condition.settings + method.settings,
                    views=self.views,
                    seed=seed,
                    order=method.order,
                ),
                method.label,
                condition.label,
                family(scene),
            )
            for scene, seed, condition, method in cross
        ]


def change_suite(
    suite: Suite,
    *,
    planners: Sequence[str] = (),
    fusions: Sequence[FusionMethod] = (),
    segmentations: Sequence[SegmentationMethod] = (),
    noises: Sequence[NoiseModel] = (),
    settings: Sequence[str] = (),
) -> Suite:
    """Return a suite with other methods, conditions or settings; what is not given stays.

    Args:
        suite: What is changed.
        planners: Take the place of its methods, each with the default fusion.
        fusions: How each of its planners fuses; methods that differ in their fusion alone become one.
        segmentations: Take the place of its conditions, together with every noise.
        noises: Of the camera.
        settings: Changed in all episodes, `STAGE.NAME=VALUE`; a method's own go before.

    Raises:
        InputError: A setting does not exist, its value is not valid, or an option changes it.
    """
    methods, conditions = suite.methods, suite.conditions
    if planners:
        methods = tuple(Method(name, name) for name in dict.fromkeys(planners))
    if fusions:
        methods = _fused(methods, list(dict.fromkeys(fusions)))
    if segmentations or noises:
        segments = {"labels": "labels", "auto": "automatic segments"}
        cameras = {"none": "no noise", "carmine": "Carmine noise"}
        cross = product(dict.fromkeys(segmentations or ("labels",)), dict.fromkeys(noises or ("carmine",)))
        conditions = tuple(Condition(f"{segments[s]}, {cameras[n]}", n, s) for s, n in cross)
    options = {"fusion.method": "--fusion", "active.max_views": "--views"}
    for setting in settings:
        if option := options.get(setting.partition("=")[0].strip()):
            raise InputError(f"--set {setting}", "every episode has its own", f"use {option}")
    read_settings(None, settings)
    conditions = tuple(
        replace(c, label=", ".join((c.label, *settings)), settings=(*c.settings, *settings))
        for c in conditions
    )
    return replace(suite, methods=methods, conditions=conditions)


def _fused(methods: Sequence[Method], fusions: Sequence[FusionMethod]) -> tuple[Method, ...]:
    """Methods with each of their planners fusing in these ways.

    A method whose planner and settings no other has keeps its label; with several ways the label tells which.
    """
    alike = Counter((method.planner, method.settings) for method in methods)
    found: dict[str, Method] = {}
    for method in methods:
        alone = alike[method.planner, method.settings] == 1
        name = method.label if alone else ", ".join((method.planner, *method.settings))
        for fusion in fusions:
            label = f"{name} {fusion.upper()}" if len(fusions) > 1 else name
            found.setdefault(label, replace(method, label=label, fusion=fusion))
    return tuple(found.values())


def _depth_noise(factor: float) -> tuple[str, ...]:
    """Settings for axial noise so many times the sensor's."""
    constant, slope, start = Config().noise.axial
    return (f"noise.axial=[{factor * constant:.6g}, {factor * slope:.6g}, {start:g}]",)


def _registration(centimetres: float, degrees: float) -> tuple[str, ...]:
    """Settings for poses of views that are off by so much (σ)."""
    return (f"noise.translation={centimetres / 100.0:g}", f"noise.rotation={degrees:g}")


_FIG5 = (
    Method("PC+SG"),
    Method("PC", fusion="pc"),
    Method("SG", fusion="sg"),
    Method("random PC", "random", "pc"),
    Method("random SG", "random", "sg"),
)
_PLANNERS = ("support", "attention", "paper", "random", "ring", "farthest", *VOLUMETRIC, "oracle")
_FREE = "active.path_cost=none"
"""Volumetric planners that do not mind the way."""
_FUSIONS: tuple[FusionMethod, ...] = ("pc+sg", "pc", "sg")
_ATTENTION = {
    "eq. 2 with 2π": "active.saliency=paper",
    "point at midpoint": "active.edge_point=midpoint",
    "λ_s 0.5": "active.saliency_weight=0.5",
    "λ_s 0.9": "active.saliency_weight=0.9",
    "λ_s 1": "active.saliency_weight=1.0",
    "no inversion": "active.occlusion=ignore",
    "no propagation": "active.propagation=false",
    "no inhibition": "active.inhibition=0.0",
    "cost: angle": "active.path_cost=angle",
    "cost: none": "active.path_cost=none",
}
_SUPPORT = {
    "eq. 2 with 2π": "active.saliency=paper",
    "point at midpoint": "active.edge_point=midpoint",
    "no occlusion test": "active.occlusion=ignore",
    "no inhibition": "active.inhibition=0.0",
    "cost: angle": "active.path_cost=angle",
    "cost: none": "active.path_cost=none",
    "effort 0": "active.effort=0.0",
    "effort 0.15": "active.effort=0.15",
}
_TOP_DOWN = {
    f"top-down by r_s,min {ratio:g}": ("support.top_down=paper", f"support.min_area_ratio={ratio:g}")
    for ratio in (0.05, 0.1, 0.2)
}
"""Only the paper's rule asks for the ratio."""
_REGISTRATION = {
    f"registration {cm:g} cm, {deg:g}°": _registration(cm, deg)
    for cm, deg in ((0.0, 0.0), (0.5, 0.3), (1.0, 1.0), (2.0, 2.0))
}
_NOISE = tuple(
    Condition(f"depth noise ×{factor:g}", settings=_depth_noise(factor)) for factor in (0.0, 1.0, 2.0, 4.0)
) + tuple(Condition(label, settings=settings) for label, settings in _REGISTRATION.items())
_AUTO = Condition("automatic segments, Carmine noise", segmentation="auto")

_ALL = (
    Suite(
        "smoke",
        "Whether everything runs: few scenes, few views.",
        (*_FIG5, Method("attention", "attention"), Method("rear-side-voxel", "rear-side-voxel")),
        ("tower", "pile-6-3", "dense-10-1"),
        seeds=1,
        views=3,
    ),
    Suite(
        "fig5",
        "The paper's Fig. 5: fusing points, graphs or both, against random views.",
        _FIG5,
        (*DESIGNED, *PILES, *DENSE[:16]),
        views=10,
    ),
    Suite(
        "planners",
        "Who finds the support graph with the fewest views, where views differ: in dense heaps.",
        (
            *(Method(name, name) for name in _PLANNERS),
            *(Method(f"{name}, w = 0", name, settings=(_FREE,)) for name in VOLUMETRIC),
        ),
        DENSE,
        reference="random",
        gap=("random", "oracle"),
    ),
    Suite(
        "path",
        "How far one has to go in dense heaps until the support graph is good.",
        (
            *(Method(name, name) for name in ("support", "random", "ring")),
            Method("proximity-count, w = 0", "proximity-count", settings=(_FREE,)),
        ),
        DENSE,
        views=10,
        reference="random",
    ),
    Suite(
        "ablation",
        "What the paper leaves open, one setting at a time, for the default planner.",
        (
            Method("support"),
            *(Method(label, settings=(s,)) for label, s in _SUPPORT.items()),
            *(Method(label, settings=s) for label, s in _TOP_DOWN.items()),
        ),
        DENSE[:16],
    ),
    Suite(
        "ablation-attention",
        "What the paper leaves open, one setting at a time, for Algorithm 2 read with these settings.",
        (
            Method("attention", "attention"),
            *(Method(label, "attention", settings=(s,)) for label, s in _ATTENTION.items()),
        ),
        DENSE[:16],
    ),
    Suite(
        "poses",
        "What fusing points, graphs or both makes of views whose poses are taken as they come.",
        tuple(
            Method(fused.label + how, fusion=fused.fusion, settings=settings)
            for how, settings in (("", ()), (", poses as they come", ("registration.enabled=false",)))
            for fused in _FIG5[:3]
        ),
        (*DESIGNED, *PILES[2::2], *DENSE[:8]),
        seeds=1,
        views=10,
    ),
    Suite(
        "noise",
        "What depth noise, wrong poses and automatic segments cost.",
        (Method("support"), Method("random", "random")),
        (*DESIGNED, *PILES[2::2], *DENSE[:8]),
        (*_NOISE, _AUTO),
        seeds=1,
    ),
    Suite(
        "dismantle",
        "Whether piles come apart without harm by what is known of them after 1, 3, 5 and 10 views.",
        tuple(Method(order, order=order) for order in ORDERS),
        (*DESIGNED, *HEAPED),
        seeds=1,
        views=10,
        reference="highest first",
    ),
    Suite(
        "full",
        "Everything against everything: for a cluster.",
        tuple(
            Method(f"{planner} {fusion.upper()}", planner, fusion)
            for planner, fusion in product(_PLANNERS, _FUSIONS)
        ),
        (*DESIGNED, *PILES, *DENSE),
        (Condition("labels, no noise", "none"), Condition("labels, Carmine noise"), *_NOISE, _AUTO),
        views=10,
    ),
)
SUITES: Mapping[str, Suite] = {suite.name: suite for suite in _ALL}
"""All suites by name."""
