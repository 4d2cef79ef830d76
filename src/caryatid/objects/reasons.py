"""Reasons: what an object costs, term by term, and what other explanations of its points would cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from caryatid.config import Config
from caryatid.fitting.primitives import candidates
from caryatid.geometry.shapes import Shape
from caryatid.objects.compounds import Compound
from caryatid.objects.description_length import (
    Evidence,
    Explanation,
    best_compound,
    explained,
    free_cost,
    point_costs,
    price,
)
from caryatid.objects.model_selection import best_division, compare


@dataclass(frozen=True, slots=True)
class Option:
    """One explanation of some points; its terms add up [nats].

    Attributes:
        what: What the points would be.
        points: The distances and normals of all points.
        free: The space seen free inside the shapes.
        parameters: Of all shapes.
        border: The border between two objects, where the surface goes on without a crease.
        others: Evidence of colours and views against this explanation; negative if for it.
        note: What else speaks against it, or "".
    """

    what: str
    points: float
    free: float
    parameters: float
    border: float = 0.0
    others: float = 0.0
    note: str = ""

    @property
    def total(self) -> float:
        """Sum of the terms [nats]."""
        return self.points + self.free + self.parameters + self.border + self.others


@dataclass(frozen=True, slots=True)
class Reasons:
    """Why an object is what it is, or why two objects are two.

    Attributes:
        subject: Ids of the objects.
        options: Explanations, the one of the model first, and then the cheapest first. A solid in the graph
            may be any surface, such as a body of revolution.
    """

    subject: tuple[str, ...]
    options: tuple[Option, ...]

    def to_json(self) -> dict[str, Any]:
        """Output of `caryatid why --json`."""
        options = [asdict(option) | {"total": option.total} for option in self.options]
        return {"objects": list(self.subject), "options": options}

    def __str__(self) -> str:
        chosen, *others = self.options
        head = f"{' and '.join(self.subject)}: {chosen.what}, {chosen.total:.0f} nats"
        rest = (f"{o.what} {o.total - chosen.total:+.0f}{f' ({o.note})' if o.note else ''}" for o in others)
        return f"{head}; {', '.join(rest)}" if others else head


def explain_object(
    subject: str, explanation: Explanation, evidence: Evidence, config: Config, rng: np.random.Generator
) -> Reasons:
    """Compare the explanation of an object with other shapes, with none, and with two objects.

    Args:
        subject: Id of the object.
        explanation: Its own.
        evidence: Its points.
        config: What explanations cost, and how shapes are fitted.
        rng: Draws the samples of fits.
    """
    fits = candidates(evidence.points, evidence.normals, config=config.fit, rng=rng, whole=False)
    compound = best_compound(evidence, config, np.inf).shape
    shapes = {_name(shape): shape for shape in (None, compound, *(f.shape for f in fits), explanation.shape)}
    options = {name: _option(name, [(shape, evidence)], config) for name, shape in shapes.items()}
    own = options[_name(explanation.shape)]
    if (
        compound is not None
        and explained(explanation, evidence, config.explanation)
        and options[_name(compound)].total < own.total
    ):
        note = f"not looked for, because {own.what} explains the points within their noise"
        options[_name(compound)] = replace(options[_name(compound)], note=note)
    hints = evidence.shown(config.split.min_points)
    if (two := best_division(evidence, explanation, hints, config, rng)) is not None:
        sides = zip(two.explanations, (~two.second, two.second), strict=True)
        parts = [(e.shape, evidence.select(side)) for e, side in sides]
        name = f"{_name(parts[0][0])} and {_name(parts[1][0])}"
        options[name] = _option(name, parts, config, two.border, two.others)
    first = options.pop(_name(explanation.shape))
    return Reasons((subject,), (first, *sorted(options.values(), key=lambda option: option.total)))


def explain_pair(
    subject: tuple[str, ...],
    pair: Sequence[tuple[Evidence, Explanation]],
    distinct: bool,
    config: Config,
    rng: np.random.Generator,
) -> Reasons:
    """Compare two objects with one.

    Args:
        subject: Ids of the objects.
        pair: The points and the explanation of each.
        distinct: Whether a view showed two masks, or a seam between them.
        config: What explanations cost, and how shapes are fitted.
        rng: Draws the samples of fits.
    """
    found, both = compare(pair, config, rng), pair[0][0].joined(pair[1][0])
    note = "no shape explains both" if found.one.shape is None else ""
    note = "a view showed a border" if distinct else note
    parts = [(e.shape, own) for own, e in pair]
    return Reasons(
        subject,
        (
            _option(" and ".join(_name(e.shape) for _, e in pair), parts, config, found.border),
            _option(
                f"one: {_name(found.one.shape)}", [(found.one.shape, both)], config, 0.0, found.colours, note
            ),
        ),
    )


def _option(
    what: str,
    parts: list[tuple[Shape | Compound | None, Evidence]],
    config: Config,
    border: float = 0.0,
    others: float = 0.0,
    note: str = "",
) -> Option:
    """The terms of an explanation by some shapes, each of its own points."""
    costs = config.explanation
    points = sum(float(point_costs(s, own, costs).sum()) * own.weight for s, own in parts)
    free, parameters = (
        sum(free_cost(s, own, costs) for s, own in parts),
        sum(price(s, costs) for s, _ in parts),
    )
    return Option(what, points, free, parameters, border, others, note)


def _name(shape: Shape | Compound | None) -> str:
    """What a shape is, for a person to read."""
    if shape is None:
        return "a solid"
    return f"{'an' if shape.kind[0] == 'o' else 'a'} {shape.kind}"
