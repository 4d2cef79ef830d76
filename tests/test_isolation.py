"""A planner sees what a robot would know: what it is given does not lead to the truth, and it needs none."""

from __future__ import annotations

import gc
import types

import numpy as np
import pytest
from synthetic import FEW_VIEWS, simulated_scene

from caryatid.evaluation.oracle import OraclePlanner
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.exploration import explore
from caryatid.planning.planners import BUILT_IN, make_planner
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import ground_truth

pytestmark = pytest.mark.slow

FORBIDDEN = ("mujoco", "caryatid.simulation", "caryatid.evaluation")
"""Packages whose objects know the truth."""


def reachable(*roots: object) -> list[object]:
    """Every object that can be got at from some; not the code they are made of: modules, types, globals."""
    found: dict[int, object] = {}
    waiting = list(roots)
    while waiting:
        item = waiting.pop()
        if id(item) in found or isinstance(item, types.ModuleType | type):
            continue
        found[id(item)] = item
        if isinstance(item, types.FunctionType):
            waiting += [item.__closure__, item.__defaults__, item.__kwdefaults__]
        elif isinstance(item, np.ndarray):
            waiting.append(item.base)
            waiting += item.ravel().tolist() if item.dtype == object else []
        else:
            waiting += gc.get_referents(item)
    return list(found.values())


def forbidden(*roots: object) -> set[str]:
    """Kinds of objects within reach that know the truth."""
    kinds = {type(item) for item in reachable(*roots)}
    names = {f"{kind.__module__}.{kind.__qualname__}" for kind in kinds}
    return {n for n in names if any(n.startswith(f + ".") for f in FORBIDDEN)}


class Witness:
    """Keeps what a planner is given."""

    def __init__(self, planner):
        self.planner, self.states, self.decisions = planner, [], []

    def plan(self, state, rng):
        self.states.append(state)
        self.decisions.append(self.planner.plan(state, rng))
        return self.decisions[-1]


def witnessed(planner):
    stage = make_simulation(simulated_scene("hidden_stack"), FEW_VIEWS, noise="carmine", seed=0)
    witness = Witness(planner)
    steps = explore(stage.camera, stage.robot, planner=witness, config=FEW_VIEWS, early_stop=False)
    assert len(list(steps)) == 3
    return witness


@pytest.mark.parametrize("name", BUILT_IN)
def test_no_planner_can_reach_the_truth(name):
    witness = witnessed(make_planner(name))
    assert len(witness.states) == 2
    assert not forbidden(witness.states, witness.planner, witness.decisions)


def test_the_truth_would_be_found():
    """The oracle has it; so would have whoever is handed the camera, or a function that knows it."""
    scene = simulated_scene("hidden_stack")
    camera = make_simulation(scene, FEW_VIEWS, noise="carmine", seed=0).camera
    truth = true_scene_from_simulation(scene, ground_truth(scene))
    oracle = OraclePlanner(camera, truth, FEW_VIEWS)
    assert {"caryatid.simulation.world.SimulatedScene", "mujoco._structs.MjData"} <= forbidden(oracle)
    assert "caryatid.evaluation.scores.TrueScene" in forbidden({"hint": [lambda: truth]})
    assert "mujoco._structs.MjData" in forbidden(types.SimpleNamespace(look=camera.capture))
    view_of_truth = np.array([truth, None], dtype=object)[:1]
    assert "caryatid.evaluation.scores.TrueScene" in forbidden((view_of_truth,))
