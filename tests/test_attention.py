"""Algorithm 2 with every open question as a setting, and as printed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_planners import CONFIG, CUBE, HOME, OPEN, SPHERE, TABLE, box, known, state

from caryatid.geometry import transforms
from caryatid.graph import Support, SupportGraph
from caryatid.planning.expected_visibility import surface_samples, visibility
from caryatid.planning.planners import make_planner
from caryatid.sensing.view_sphere import direction

GOLDEN = Path(__file__).parent / "golden" / "paper.json"

SCREEN = box(2, (0.2, 0.1, 0.95), (0.02, 0.5, 0.4))
ON_CUBE = box(3, (0.02, -0.01, 0.88), (0.06, 0.08, 0.06))
FLOATING = box(4, (-0.1, 0.3, 0.9), (0.1, 0.1, 0.1))
HEAP = [CUBE, SCREEN, ON_CUBE, FLOATING]
SUPPORTS = (Support("o0", "o1", occurrences=2), Support("o0", "o2"), Support("o1", "o3"))
BOTH = np.stack([HOME, direction(-1.0, 0.5)])


def run_of(name: str, views: int = 5, **settings: object) -> list[dict[str, object]]:
    """Decisions one after the other about a heap that stays as it is known."""
    visited, run = HOME[None], []
    for _ in range(views):
        situation = state(HEAP, SUPPORTS, visited=visited, **settings)
        decision = make_planner(name).plan(situation, np.random.default_rng(0))
        run.append(
            {
                "index": decision.index,
                "saliency": decision.saliency,
                "cost": decision.cost,
                "score": decision.score,
                "why": decision.why,
                "sum": float(decision.candidate_saliency.sum()),
                "sphere": float(decision.sphere_saliency.sum()),
            }
        )
        visited = np.vstack([visited, OPEN.directions[decision.index]])
    return run


def decision(name: str, objects, supports=(), **settings: object):
    return make_planner(name).plan(state(objects, supports, **settings), np.random.default_rng(0))


def saliency_at(decided, towards: np.ndarray) -> float:
    """Of the candidate nearest to a direction."""
    return float(decided.candidate_saliency[int(np.argmax(OPEN.directions @ towards))])


LITERAL = {"saliency": "paper", "edge_point": "midpoint", "path_cost": "angle"}
OTHER = {
    "saliency": "decreasing",
    "edge_point": "contact",
    "path_cost": "none",
    "occlusion": "ignore",
    "propagation": False,
}


@pytest.mark.parametrize("settings", [{}, OTHER], ids=["defaults", "other settings"])
def test_the_papers_planner_decides_as_it_always_did(settings):
    for before, now in zip(json.loads(GOLDEN.read_text()), run_of("paper", **settings), strict=True):
        assert now["index"] == before["index"]
        assert now["why"] == before["why"]
        for figure in ("saliency", "cost", "score", "sum", "sphere"):
            assert now[figure] == pytest.approx(before[figure], rel=1e-9)


def test_with_the_literal_settings_it_is_the_papers():
    assert run_of("attention", **LITERAL) == run_of("paper")
    assert run_of("attention") != run_of("paper")


@pytest.mark.parametrize(
    "setting",
    [
        {"saliency": "paper"},
        {"saliency_weight": 0.5},
        {"edge_point": "midpoint"},
        {"occlusion": "ignore"},
        {"propagation": False},
        {"spread": 10.0},
        {"inhibition": 0.0},
        {"path_cost": "none"},
        {"path_cost": "angle"},
    ],
    ids=lambda s: "-".join(f"{k}={v}" for k, v in s.items()),
)
def test_every_setting_matters(setting):
    contact = replace(SUPPORTS[0], contact_world=np.array([0.1, 0.2, 0.75]))
    seen = [decision("attention", HEAP, (contact, *SUPPORTS[1:]), visited=BOTH, **s) for s in ({}, setting)]
    figures = [(d.score, tuple(d.candidate_saliency)) for d in seen]
    assert figures[0] != figures[1]


def test_a_hidden_point_counts_as_seen_where_occlusion_is_ignored():
    held = (Support("o0", "o2", occurrences=1),)
    behind = direction(0.0, 0.4)
    wall = box(2, (0.2, 0.0, 1.0), (0.02, 0.6, 0.5))
    lone = box(1, (0.0, 0.0, 0.9), (0.1, 0.1, 0.1))
    free = saliency_at(decision("attention", [lone]), behind)
    assert free > 0.3
    assert saliency_at(decision("attention", [lone, wall], held), behind) < free - 0.2
    ignored = saliency_at(decision("attention", [lone, wall], held, occlusion="ignore"), behind)
    assert ignored == pytest.approx(free, abs=1e-6)


def test_without_propagation_one_candidate_a_point_has_saliency():
    alone = decision("attention", HEAP, SUPPORTS, propagation=False, inhibition=0.0, occlusion="ignore")
    tops = np.stack([p.direction for p in alone.points_of_interest])
    nearest = np.argmax(OPEN.directions @ tops.T, axis=0)
    assert set(np.flatnonzero(alone.candidate_saliency)) == set(nearest)
    for k in set(nearest):
        largest = max(p.saliency for p, n in zip(alone.points_of_interest, nearest, strict=True) if n == k)
        assert alone.candidate_saliency[k] == largest
    spreading = decision("attention", HEAP, SUPPORTS, inhibition=0.0, occlusion="ignore")
    assert np.count_nonzero(spreading.candidate_saliency > 0.1) > 100


def test_without_propagation_a_hidden_point_still_repels():
    held = (Support("o0", "o2", occurrences=1),)
    wall = box(2, (0.2, 0.0, 1.0), (0.02, 0.6, 0.5))
    lone = box(1, (0.0, 0.0, 0.9), (0.1, 0.1, 0.1))
    alone = decision("attention", [lone, wall], held, propagation=False, inhibition=0.0)
    assert alone.candidate_saliency.min() == -1.0


def test_a_view_no_point_reaches_is_not_said_to_be_about_one():
    """A relation found in all views is worth nothing with λ_s = ½: the robot stays where it is."""
    settings = {"saliency_weight": 0.5, "inhibition": 0.0, "path_cost": "angle"}
    alone = decision("attention", [CUBE], (Support("o0", "o1"),), propagation=False, **settings)
    assert transforms.angle_between(HOME, OPEN.directions[alone.index]) < 0.02
    assert "no point of interest" in alone.why


def test_without_inhibition_nothing_keeps_it_from_where_it_was():
    with_it, without = (
        decision("attention", [CUBE], (Support("o0", "o1"),), inhibition=depth, occlusion="ignore")
        for depth in (1.0, 0.0)
    )
    assert saliency_at(with_it, HOME) < 0.0
    assert without.candidate_saliency.min() >= -1e-9


def test_the_default_planner_sees_through_walls_where_occlusion_is_ignored():
    wall = box(2, (0.0, 0.16, 0.95), (0.5, 0.02, 0.4))
    solid = known([TABLE, CUBE, wall]).solid()
    samples = surface_samples(SupportGraph((TABLE, CUBE)), solid, CONFIG)
    beyond = SPHERE.poses(direction(np.pi / 2.0, np.deg2rad(35.0))[None])
    seen, through = (
        visibility(samples, beyond, solid, replace(CONFIG, occlusion=how))[:, 0]
        for how in ("invert", "ignore")
    )
    assert (through >= seen).all()
    towards = samples.normals_world[:, 1] > 0.9
    assert seen[towards].max() == 0.0
    assert through[towards].min() > 0.9
