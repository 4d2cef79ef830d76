"""Named suites: methods, scenes, conditions and repetitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

from caryatid.benchmark.episodes import ORDERS, Episode, content_of, family, find_scenes, plugin_of
from caryatid.benchmark.store import Member
from caryatid.config import Config, FusionMethod, NoiseModel, Preset, SegmentationMethod
from caryatid.config.settings import read_settings
from caryatid.errors import InputError
from caryatid.planning.planners import VOLUMETRIC


def _generated(kind: str, smallest: int, largest: int, seed: int, count: int) -> tuple[str, ...]:
    """Names of generated scenes with rising seeds, and sizes that cycle from the smallest to the largest."""
    return tuple(f"{kind}-{smallest + i % (largest - smallest + 1)}-{seed + i}" for i in range(count))


DESIGNED = ("tower", "bridge", "counterweight", "leaning_plank", "hidden_stack", "shelf", "clutter")
"""Scenes with one difficulty each."""
PILES = tuple(
    f"pile-{size}-{seed}" for seed, size in enumerate((4, 5, 6, 8, 10, 12, 14, 16, 18, 20), start=1)
)
"""Primitives set down one by one, 4 to 20."""
HEAPED = _generated("pile", 6, 12, 401, 60)
"""Piles of 6 to 12 to be taken apart; nothing is tuned on these seeds."""
DENSE = _generated("dense", 10, 25, 301, 32)
"""Heaps of 10 to 25 between screens and walls; nothing is tuned on these seeds."""
MIXED = (*DESIGNED, *PILES[2::2], *DENSE[:8])
"""Some of each."""
LABELS = "labels, Carmine noise"
"""The default condition."""

Changes = Mapping[str, Mapping[str, Any]]
"""Label of a method or condition → fields of its episodes that differ from the defaults."""


@dataclass(frozen=True, slots=True)
class Suite:
    """Methods × conditions × scenes × seeds.

    Attributes:
        what: Its purpose, in one sentence.
        methods: The methods, each a line of a figure.
        scenes: Names of built-in scenes, or scene folders.
        conditions: Conditions of the camera and segments; figures are drawn for each.
        seeds: Seeds 0…n−1.
        views: Views per episode, including the first.
        reference: Method with which the others are compared; None for the first.
        gap: Two methods, such as random choice and the oracle, whose gap the others close in part.
    """

    what: str
    methods: Changes
    scenes: tuple[str, ...]
    conditions: Changes = field(default_factory=lambda: {LABELS: {}})
    seeds: int = 3
    views: int = 5
    reference: str | None = None
    gap: tuple[str, str] | None = None

    def members(self) -> list[Member]:
        """All episodes, those of a scene one after the other."""
        content = {scene: content_of(scene) for scene in self.scenes}
        members = []
        for scene, seed, (condition, given), (method, own) in product(
            self.scenes, range(self.seeds), self.conditions.items(), self.methods.items()
        ):
            settings = (*given.get("settings", ()), *own.get("settings", ()))
            changes = {**given, **own, "settings": settings}
            episode = Episode(scene, content[scene], views=self.views, seed=seed, **changes)
            episode = replace(episode, plugin=plugin_of(episode.planner))
            members.append(Member(episode, method, condition, family(scene)))
        return members


def change_suite(
    suite: Suite,
    *,
    planners: Sequence[str] = (),
    fusions: Sequence[FusionMethod] = (),
    segmentations: Sequence[SegmentationMethod] = (),
    noises: Sequence[NoiseModel] = (),
    preset: Preset | None = None,
    settings: Sequence[str] = (),
    scenes: Sequence[str] = (),
    seeds: int | None = None,
    views: int | None = None,
) -> Suite:
    """Return a suite with other methods, conditions, settings or scenes; the rest stays.

    Planners replace the methods, each with the default fusion. With fusions, methods that differ only in
    their fusion become one, with each of these. A method's own settings go before those given here.

    Raises:
        InputError: A setting does not exist, its value is not valid, or an option changes it; or a scene
            does not exist.
    """
    methods, conditions = suite.methods, suite.conditions
    if planners:
        methods = {name: {"planner": name} for name in planners}
    if fusions:
        methods = {
            f"{_name(own)} {fusion.upper()}" if len({*fusions}) > 1 else _name(own): {**own, "fusion": fusion}
            for own in methods.values()
            for fusion in fusions
        }
    if segmentations or noises:
        segments = {"labels": "labels", "auto": "automatic segments"}
        cameras = {"none": "no noise", "carmine": "Carmine noise"}
        conditions = {
            f"{segments[s]}, {cameras[n]}": {"segmentation": s, "noise": n}
            for s, n in product(segmentations or ("labels",), noises or ("carmine",))
        }
    if preset is not None:
        methods = {label: {**own, "preset": preset} for label, own in methods.items()}
    options = {"fusion.method": "--fusion", "active.max_views": "--views"}
    for setting in settings:
        if option := options.get(setting.partition("=")[0].strip()):
            raise InputError(f"--set {setting}", "is set for each episode", f"use {option}")
    read_settings(None, settings)
    conditions = {
        ", ".join((label, *settings)): {**given, "settings": (*given.get("settings", ()), *settings)}
        for label, given in conditions.items()
    }
    return replace(
        suite,
        methods=methods,
        conditions=conditions,
        scenes=tuple(find_scenes(scenes)) or suite.scenes,
        seeds=seeds or suite.seeds,
        views=views or suite.views,
    )


def _name(method: Mapping[str, Any]) -> str:
    """A method without its fusion."""
    order = (method["order"],) if "order" in method else ()
    return ", ".join((method.get("planner", "support"), *method.get("settings", ()), *order))


_AUTO: Changes = {"automatic segments, Carmine noise": {"segmentation": "auto"}}
_FUSED: Changes = {"PC+SG": {}, "PC": {"fusion": "pc"}, "SG": {"fusion": "sg"}}
_FIG5: Changes = {
    **_FUSED,
    "random PC": {"planner": "random", "fusion": "pc"},
    "random SG": {"planner": "random", "fusion": "sg"},
}
_PLANNERS = ("support", "attention", "paper", "random", "ring", "farthest", *VOLUMETRIC, "oracle")
_FREE: dict[str, Any] = {"label": "{}, w = 0", "settings": ("active.path_cost=none",)}
"""Volumetric planners without a path cost."""
_GIVEN = {"settings": ("registration.enabled=false",)}
"""Views with poses as reported."""
_BOTH = {
    "eq. 2 with 2π": "active.saliency=paper",
    "point at midpoint": "active.edge_point=midpoint",
    "no inhibition": "active.inhibition=0.0",
    "cost: angle": "active.path_cost=angle",
    "cost: none": "active.path_cost=none",
}
_ATTENTION = _BOTH | {
    "λ_s 0.5": "active.saliency_weight=0.5",
    "λ_s 0.9": "active.saliency_weight=0.9",
    "λ_s 1": "active.saliency_weight=1.0",
    "no inversion": "active.occlusion=ignore",
    "no propagation": "active.propagation=false",
}
_SUPPORT = _BOTH | {
    "no occlusion test": "active.occlusion=ignore",
    "effort 0": "active.effort=0.0",
    "effort 0.15": "active.effort=0.15",
}
_PAPER: dict[str, Any] = {"planner": "paper", "preset": "paper"}
_DEPARTURES = {
    "with registration": ("registration.enabled=true",),
    "with completion": ("completion.enabled=true",),
    "with plausibility": ("plausibility.rounds=3",),
    "with balance": ("support.stability=balance",),
    "matched by points": ("fusion.matching=points",),
    "edges kept by share": ("fusion.keep_share=0.5",),
}
"""The departures of the default settings from the paper, one at a time."""
_TOP_DOWN: Changes = {  # only the paper's rule uses the ratio
    f"top-down by r_s,min {ratio:g}": {
        "settings": ("support.stability=area", f"support.min_area_ratio={ratio:g}")
    }
    for ratio in (0.05, 0.1, 0.2)
}
_CONSTANT, _SLOPE, _START = Config().noise.axial
_NOISE: Changes = {
    f"depth noise ×{factor:g}": {
        "settings": (f"noise.axial=[{factor * _CONSTANT:.6g}, {factor * _SLOPE:.6g}, {_START:g}]",)
    }
    for factor in (0.0, 1.0, 2.0, 4.0)
} | {  # poses of views with these errors (σ)
    f"registration {cm:g} cm, {degrees:g}°": {
        "settings": (f"noise.translation={cm / 100.0:g}", f"noise.rotation={degrees:g}")
    }
    for cm, degrees in ((0.0, 0.0), (0.5, 0.3), (1.0, 1.0), (2.0, 2.0))
}


def _planners(*names: str, label: str = "{}", **changes: Any) -> Changes:
    return {label.format(name): {"planner": name, **changes} for name in names}


def _ablation(planner: str, settings: Mapping[str, str]) -> Changes:
    """A planner, and the same with one setting changed at a time."""
    changed = {label: {"planner": planner, "settings": (setting,)} for label, setting in settings.items()}
    return {**_planners(planner), **changed}


SUITES: Mapping[str, Suite] = {
    "smoke": Suite(
        "Whether everything runs: few scenes, few views.",
        {**_FIG5, **_planners("attention", "rear-side-voxel")}, ("tower", "pile-6-3", "dense-10-1"),
        seeds=1, views=3,
    ),
    "fig5": Suite(
        "The paper's Fig. 5: fusing points, graphs or both, against random views.",
        _FIG5, (*DESIGNED, *PILES, *DENSE[:16]), views=10,
    ),
    "fig5-paper": Suite(
        "The paper's Fig. 5 by the paper's own system: its preset and planner, against random views.",
        {label: {**_PAPER, **own} for label, own in _FIG5.items()}, MIXED, seeds=1, views=10,
    ),
    "presets": Suite(
        "What the departures from the paper change, over the same scenes.",
        {
            "default": {},
            "paper": _PAPER,
            **{f"paper, {label}": {**_PAPER, "settings": own} for label, own in _DEPARTURES.items()},
        },
        MIXED, seeds=1, reference="paper",
    ),
    "planners": Suite(
        "Which planner finds the support graph with the fewest views, in dense heaps.",
        {**_planners(*_PLANNERS), **_planners(*VOLUMETRIC, **_FREE)}, DENSE, reference="random",
        gap=("random", "oracle"),
    ),
    "path": Suite(
        "How long the path is until the support graph is good, in dense heaps.",
        {**_planners("support", "random", "ring"), **_planners("proximity-count", **_FREE)}, DENSE,
        views=10, reference="random",
    ),
    "ablation": Suite(
        "What the paper leaves open, one setting at a time, for the default planner.",
        {**_ablation("support", _SUPPORT), **_TOP_DOWN}, DENSE[:16],
    ),
    "ablation-attention": Suite(
        "What the paper leaves open, one setting at a time, for the planner `attention`.",
        _ablation("attention", _ATTENTION), DENSE[:16],
    ),
    "poses": Suite(
        "Fusing points, graphs or both, with poses as reported and with registration.",
        {**_FUSED, **{f"{label}, poses as reported": {**own, **_GIVEN} for label, own in _FUSED.items()}},
        MIXED, seeds=1, views=10,
    ),
    "noise": Suite(
        "What depth noise, wrong poses and automatic segments cost.",
        _planners("support", "random"), MIXED, {**_NOISE, **_AUTO}, seeds=1,
    ),
    "house": Suite(
        "Household objects such as trays, bowls, mugs and bottles, with labels and without.",
        _planners("support"), _generated("house", 4, 12, 501, 30), {LABELS: {}, **_AUTO}, seeds=1,
    ),
    "easy": Suite(
        "Automatic segments of piles of 4 to 20, and of equal boxes in rows, walls and pyramids.",
        _planners("support"), _generated("pile", 4, 20, 800, 60) + _generated("blocks", 2, 10, 800, 40),
        _AUTO, seeds=1,
    ),
    "heaps": Suite(
        "Automatic segments of dense heaps, over ten views.",
        _planners("support"), _generated("dense", 10, 25, 700, 32), _AUTO, seeds=1, views=10,
    ),
    "dismantle": Suite(
        "Whether piles can be taken apart without harm after 1, 3, 5 and 10 views.",
        {order: {"order": order} for order in ORDERS}, (*DESIGNED, *HEAPED), seeds=1, views=10,
        reference="highest first",
    ),
}  # fmt: skip
"""All suites by name."""
