from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import box, sphere, table_object, thing

from caryatid.config import Config, LiftConfig, RehearsalConfig, SupportConfig
from caryatid.errors import InputError
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.graph import Support, SupportGraph
from caryatid.manipulation.dismantling import bodies_of, dismantle, posed, poses_of
from caryatid.manipulation.order import TakeStep, plan_order
from caryatid.manipulation.rehearsal import Rehearsal
from caryatid.simulation.truth import ground_truth
from caryatid.simulation.world import TABLE_HEIGHT, Solid, build_spec, scene_from_spec
from caryatid.support.relations import infer, predict_removal

CONFIG = replace(Config(), rehearsal=RehearsalConfig(draws=2), lift=LiftConfig(watch=1.0))
TOP = TABLE_HEIGHT
FIRM = Uncertainty(np.full(3, 0.001), np.full(3, 0.005), np.full(3, 0.001), np.full(6, 0.001))


def graph_of(*shapes, uncertainty=FIRM) -> SupportGraph:
    objects = [thing(k, shape, uncertainty=uncertainty) for k, shape in enumerate(shapes, start=1)]
    return infer([table_object(TOP), *objects], SupportConfig())


def tower() -> SupportGraph:
    """o2 on o1, o3 on o2, and o4 beside them."""
    return graph_of(
        box((0.0, 0.0, TOP + 0.03), (0.12, 0.12, 0.06)),
        box((0.0, 0.0, TOP + 0.09), (0.1, 0.1, 0.06)),
        box((0.0, 0.0, TOP + 0.15), (0.08, 0.08, 0.06)),
        box((0.0, 0.3, TOP + 0.03), (0.06, 0.06, 0.06)),
    )


def counterweight() -> SupportGraph:
    """A plank o2 that juts out from the block o1, and what keeps it there: o3 on its other end."""
    return graph_of(
        box((0.0, 0.0, TOP + 0.05), (0.1, 0.12, 0.1)),
        box((0.1, 0.0, TOP + 0.11), (0.36, 0.08, 0.02)),
        box((-0.04, 0.0, TOP + 0.18), (0.08, 0.08, 0.12)),
    )


def ids(effects) -> dict[str, bool]:
    return {e.object_id: e.certain for e in effects}


class TestPredictRemoval:
    def test_all_that_stands_on_it_falls_for_certain(self):
        assert ids(predict_removal(tower(), "o1", SupportConfig())) == {"o2": True, "o3": True}
        assert ids(predict_removal(tower(), "o2", SupportConfig())) == {"o3": True}

    @pytest.mark.parametrize("nothing", ["o3", "o4"])
    def test_what_carries_nothing_moves_nothing(self, nothing):
        assert predict_removal(tower(), nothing, SupportConfig()) == ()

    def test_the_reason_names_what_is_lost(self):
        (effect,) = predict_removal(tower(), "o2", SupportConfig())
        assert "o2" in effect.why

    def test_a_bridge_falls_with_one_pillar_but_a_slab_on_four_legs_stays(self):
        pillars = [box((x, 0.0, TOP + 0.05), (0.05, 0.08, 0.1)) for x in (-0.1, 0.1)]
        bridge = graph_of(*pillars, box((0.0, 0.0, TOP + 0.11), (0.3, 0.08, 0.02)))
        assert ids(predict_removal(bridge, "o1", SupportConfig())) == {"o3": True}
        legs = [box((x, y, TOP + 0.05), (0.05, 0.05, 0.1)) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
        middle = box((0.0, 0.0, TOP + 0.05), (0.08, 0.08, 0.1))
        table = graph_of(*legs, middle, box((0.0, 0.0, TOP + 0.11), (0.3, 0.3, 0.02)))
        assert predict_removal(table, "o5", SupportConfig()) == ()

    def test_a_loss_that_is_uncertain_makes_an_effect_that_is(self):
        graph = counterweight()
        assert graph.support("o3", "o2") is not None
        assert not graph.support("o3", "o2").certain
        assert ids(predict_removal(graph, "o3", SupportConfig())) == {"o2": False}

    def test_what_only_may_fall_makes_others_possible_too(self):
        graph = counterweight()
        rider = thing(4, sphere((0.24, 0.0, TOP + 0.14), 0.02), uncertainty=FIRM)
        loaded = infer([*graph.objects, rider], SupportConfig())
        found = ids(predict_removal(loaded, "o3", SupportConfig()))
        assert found.get("o4") is False

    def test_unknown_objects_and_the_table_are_refused(self):
        with pytest.raises(InputError, match="no such object"):
            predict_removal(tower(), "o9", SupportConfig())
        with pytest.raises(InputError, match="support surface"):
            predict_removal(tower(), "o0", SupportConfig())


class TestOrder:
    def test_a_tower_is_taken_from_the_top(self):
        order = plan_order(tower(), CONFIG)
        assert order.safe
        taken = [s.object_id for s in order.steps]
        assert [i for i in taken if i != "o4"] == ["o3", "o2", "o1"]
        assert all(s.safe and s.risk == 0.0 and s.hold == () and s.why for s in order.steps)

    def test_to_get_at_one_object_only_what_is_in_the_way_is_taken(self):
        assert [s.object_id for s in plan_order(tower(), CONFIG, goal="o2").steps] == ["o3", "o2"]
        assert [s.object_id for s in plan_order(tower(), CONFIG, goal="o4").steps] == ["o4"]

    def test_one_hand_refuses_what_two_can_do_and_says_which_cycle(self):
        refused = plan_order(counterweight(), CONFIG, hands=1)
        assert not refused.safe
        assert "o3 disturbs o2" in refused.refusal
        assert "o2 disturbs o3" in refused.refusal
        assert not refused.steps[0].safe
        held = plan_order(counterweight(), CONFIG, hands=2)
        assert held.safe
        assert (held.steps[0].object_id, held.steps[0].hold) == ("o3", ("o2",))

    def test_threads_and_repetition_change_nothing(self):
        first = plan_order(tower(), CONFIG, seed=3)
        assert plan_order(tower(), CONFIG, seed=3) == first
        assert plan_order(tower(), CONFIG, seed=3, threads=2) == first

    def test_nothing_to_take_and_unknown_goals_are_refused(self):
        with pytest.raises(InputError, match="no objects"):
            plan_order(SupportGraph((table_object(TOP),)), CONFIG)
        with pytest.raises(InputError, match="no object of the graph"):
            plan_order(tower(), CONFIG, goal="o9")
        with pytest.raises(InputError, match="no support surface"):
            plan_order(SupportGraph(tower().objects[1:]), CONFIG)


class TestRehearsal:
    def test_what_would_fall_by_itself_is_held_and_goes_by_the_graph(self):
        """o2 floats: what carries it has not been seen. The graph says that o1 does."""
        floating = graph_of(
            box((0.0, 0.0, TOP + 0.03), (0.1, 0.1, 0.06)), box((0.1, 0.0, TOP + 0.2), (0.08, 0.08, 0.06))
        )
        told = replace(floating, supports=(*floating.supports, Support("o1", "o2", certain=False)))
        rehearsal = Rehearsal(told, CONFIG, np.random.default_rng(0))
        assert rehearsal.restless == {"o2": 1.0}
        assert rehearsal.try_lift("o1").harmed == {"o2": 1.0}
        assert rehearsal.try_lift("o1", ["o2"]).risk == 0.0
        assert rehearsal.try_lift("o2").risk == 0.0

    def test_trying_changes_nothing_and_taking_takes(self):
        rehearsal = Rehearsal(tower(), CONFIG, np.random.default_rng(0))
        assert rehearsal.try_lift("o1").harmed == {"o2": 1.0, "o3": 1.0}
        assert rehearsal.left() == ["o1", "o2", "o3", "o4"]
        rehearsal.take("o3", rehearsal.try_lift("o3"))
        assert rehearsal.left() == ["o1", "o2", "o4"]
        assert set(rehearsal.try_lift("o1").harmed) == {"o2"}

    def test_draws_differ_by_uncertainty_and_the_first_is_what_was_extracted(self):
        unsure = Uncertainty(np.full(3, 0.01), np.full(3, 0.05), np.full(3, 0.01), np.full(6, 0.01))
        graph = graph_of(box((0.0, 0.0, TOP + 0.03), (0.1, 0.1, 0.06)), uncertainty=unsure)
        rehearsal = Rehearsal(graph, CONFIG, np.random.default_rng(0))
        first, second = (s.lifting.start[0, :3] for s in rehearsal._scenes)
        np.testing.assert_allclose(first, (0.0, 0.0, TOP + 0.03), atol=1e-9)
        assert 1e-4 < np.linalg.norm(second - first) < 0.05


@pytest.fixture(scope="module")
def scene():
    """The tower in physics."""
    solids = [Solid(o.shape) for o in tower().objects if o.role == "object"]
    return scene_from_spec(build_spec(solids, "tower"), "tower", "tower")


BODIES = {f"o{k}": f"object{k - 1}" for k in range(1, 5)}


class TestDismantling:
    def test_a_safe_order_comes_true(self, scene):
        order = plan_order(tower(), CONFIG)
        taken = list(dismantle(scene, order.steps, BODIES, CONFIG))
        assert [t.body for t in taken] == [BODIES[s.object_id] for s in order.steps]
        assert all(t.ok for t in taken)

    def test_a_wrong_one_does_harm_and_names_it(self, scene):
        (taken,) = dismantle(scene, [TakeStep("o1", (), True, 0.0, "")], BODIES, CONFIG)
        assert not taken.ok
        assert taken.disturbed == ("object1", "object2")

    def test_what_is_not_there_cannot_be_taken(self, scene):
        (taken,) = dismantle(scene, [TakeStep("o7", ("o8",), True, 0.0, "")], BODIES, CONFIG)
        assert taken.body is None
        assert taken.ok
        assert taken.held == ()

    def test_the_scene_stays_as_it_is_and_can_be_shown_otherwise(self, scene):
        before = poses_of(scene)
        (taken,) = dismantle(scene, [TakeStep("o3", (), True, 0.0, "")], BODIES, CONFIG)
        np.testing.assert_array_equal(poses_of(scene), before)
        shown = posed(scene, taken.film[2])
        assert poses_of(shown)[2, 2] > before[2, 2] + 0.02
        np.testing.assert_array_equal(poses_of(scene), before)

    def test_objects_stand_for_the_bodies_they_overlap_most(self, scene):
        truth = true_scene_from_simulation(scene, ground_truth(scene))
        assert bodies_of(tower(), truth) == BODIES
