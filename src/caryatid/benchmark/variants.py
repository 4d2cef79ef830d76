"""A suite changed: other planners, other fusion, another camera, other settings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from caryatid.benchmark.suites import Condition, Method, Suite
from caryatid.config import FusionMethod, NoiseModel, SegmentationMethod
from caryatid.config.settings import read_settings
from caryatid.errors import InputError

OF_THE_EPISODE = {"fusion.method": "--fusion", "active.max_views": "--views"}
"""Settings every episode has of its own → the option that changes them."""


def with_planners(suite: Suite, planners: Sequence[str]) -> Suite:
    """Return the suite with these planners in place of its methods, each with the default fusion."""
    return replace(suite, methods=tuple(Method(name, name) for name in dict.fromkeys(planners)))


def with_fusions(suite: Suite, fusions: Sequence[FusionMethod]) -> Suite:
    """Return the suite with each of its planners fusing in these ways.

    Methods that differ in their fusion alone become one for each way. One that stands alone keeps its
    label; with several ways the label tells which.
    """
    alike = Counter((method.planner, method.settings) for method in suite.methods)
    methods: dict[str, Method] = {}
    for method in suite.methods:
        alone = alike[method.planner, method.settings] == 1
        name = method.label if alone else ", ".join((method.planner, *method.settings))
        for fusion in dict.fromkeys(fusions):
            label = f"{name} {fusion.upper()}" if len(set(fusions)) > 1 else name
            methods.setdefault(label, replace(method, label=label, fusion=fusion))
    return replace(suite, methods=tuple(methods.values()))


def with_conditions(
    suite: Suite, segmentations: Sequence[SegmentationMethod], noises: Sequence[NoiseModel]
) -> Suite:
    """Return the suite with these in place of its conditions, every segmentation under every noise."""
    parts = {"labels": "labels", "auto": "automatic parts"}
    cameras = {"none": "no noise", "carmine": "Carmine noise"}
    return replace(
        suite,
        conditions=tuple(
            Condition(f"{parts[segmentation]}, {cameras[noise]}", noise, segmentation)
            for segmentation in dict.fromkeys(segmentations)
            for noise in dict.fromkeys(noises)
        ),
    )


def with_settings(suite: Suite, settings: Sequence[str]) -> Suite:
    """Return the suite with settings changed in all episodes, `STAGE.NAME=VALUE`; a method's own go before.

    Raises:
        InputError: A setting does not exist, its value is not valid, or an option changes it.
    """
    for setting in settings:
        if option := OF_THE_EPISODE.get(setting.partition("=")[0].strip()):
            raise InputError(f"--set {setting}", "every episode has its own", f"use {option}")
    read_settings(None, settings)
    return replace(
        suite,
        conditions=tuple(
            replace(c, label=", ".join((c.label, *settings)), settings=(*c.settings, *settings))
            for c in suite.conditions
        ),
    )
