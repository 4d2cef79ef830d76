"""Safe orders, rehearsals, lifts and scenes taken apart, in Python and as commands."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import SMALL, refusal, run_command
from synthetic import box, shelf_graph, shelf_objects, sphere, table_object, thing

from caryatid.config import Config, GripperConfig, LiftConfig, RehearsalConfig, SupportConfig
from caryatid.errors import InputError
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.exploration import Explorer
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Uncertainty
from caryatid.geometry.solids import Polytope, Solid
from caryatid.graph import Grasp, Support, SupportGraph, TakeStep
from caryatid.manipulation.clearing import SimulatedHands, bodies_of, clear
from caryatid.manipulation.grasps import Blocked, find_grasp, gripper_boxes
from caryatid.manipulation.order import plan_order
from caryatid.robots.reachability import ReachabilityMap, write_reachability
from caryatid.scene import Scene
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.simulation.lifting import ASIDE, Lifting
from caryatid.simulation.truth import ground_truth
from caryatid.simulation.world import (
    TABLE_HEIGHT,
    Body,
    build_spec,
    poses_of,
    quaternion,
    scene_from_spec,
)
from caryatid.sources import simulate
from caryatid.steps import read_run, read_steps
from caryatid.support.relations import infer

CONFIG = replace(Config(), rehearsal=RehearsalConfig(draws=2, risk=0.2), lift=LiftConfig(watch=1.0))
TOP = TABLE_HEIGHT


def with_risk(risk):
    return replace(CONFIG, rehearsal=replace(CONFIG.rehearsal, risk=risk))


FIRM = Uncertainty(np.full(3, 0.001), np.full(3, 0.005), np.full(3, 0.001), np.full(6, 0.001))


def graph_of(*shapes, uncertainty=FIRM):
    objects = [thing(k, shape, uncertainty=uncertainty) for k, shape in enumerate(shapes, start=1)]
    return infer([table_object(TOP), *objects], SupportConfig())


def tower():
    """o2 on o1, o3 on o2, and o4 beside them."""
    return graph_of(
        box((0.0, 0.0, TOP + 0.03), (0.12, 0.12, 0.06)),
        box((0.0, 0.0, TOP + 0.09), (0.1, 0.1, 0.06)),
        box((0.0, 0.0, TOP + 0.15), (0.08, 0.08, 0.06)),
        box((0.0, 0.3, TOP + 0.03), (0.06, 0.06, 0.06)),
    )


def counterweight():
    """A plank o2 that juts out from the block o1, and what keeps it there: o3 on its other end."""
    return graph_of(
        box((0.0, 0.0, TOP + 0.05), (0.1, 0.12, 0.1)),
        box((0.1, 0.0, TOP + 0.11), (0.36, 0.08, 0.02)),
        box((-0.04, 0.0, TOP + 0.18), (0.08, 0.08, 0.12)),
    )


def test_what_rests_on_a_slope_does_not_creep():
    """MuJoCo's soft contacts alone let it creep by 0.9 mm."""
    spec = build_spec([Body(box((0.0, 0.0, TOP + 0.05), (0.1, 0.1, 0.1)), friction=0.6)], "slope")
    spec.option.gravity = [9.81 * np.sin(np.radians(20.0)), 0.0, -9.81 * np.cos(np.radians(20.0))]
    lifting = Lifting(spec, ["object0"])
    settled = lifting.rest(lifting.start, (), 1.0)
    np.testing.assert_allclose(lifting.rest(settled, (), 10.0), settled, atol=1e-4)


class TestOrder:
    def test_only_objects_that_stand_together_are_rehearsed_together(self):
        """The limit is on each group: the tower has three objects, and the box beside it is apart."""
        for most, allowed in ((3, True), (2, False)):
            config = replace(CONFIG, rehearsal=replace(CONFIG.rehearsal, max_objects=most))
            if allowed:
                assert plan_order(tower(), config, seed=3) == plan_order(tower(), CONFIG, seed=3)
            else:
                with pytest.raises(InputError, match="3 objects close together"):
                    plan_order(tower(), config)

    def test_a_tower_is_taken_from_the_top(self):
        order = plan_order(tower(), CONFIG, seed=3)
        assert order.safe
        assert [s.object_id for s in order.steps if s.object_id != "o4"] == ["o3", "o2", "o1"]
        assert all(s.safe and s.risk == pytest.approx(1 / 6) and s.hold == () and s.why for s in order.steps)
        assert plan_order(tower(), CONFIG, seed=3, threads=2) == order
        assert order.steps[-1].why == "disturbed nothing in 2 rehearsals"
        assert order.risk == pytest.approx(1 / 6), "the same two scenes show all lifts"

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
        risk = refused.steps[0].risk
        for accepted, safe in ((risk, True), (risk - 0.01, False)):
            bold = plan_order(counterweight(), with_risk(accepted), hands=1)
            assert bold.steps[0].safe == safe

    @pytest.mark.parametrize("denser", [1.2, 3.0, 6.0])
    def test_a_board_over_the_edge_of_the_table_keeps_its_weight(self, denser):
        """The weight has to be denser than the board by this factor. The block at the edge stands anyway."""
        side = (0.4 * 0.1 * 0.025 * 0.07 / (0.1 * denser)) ** (1 / 3)
        graph = graph_of(
            box((0.42, 0.0, TOP + 0.0125), (0.4, 0.1, 0.025)),
            box((0.25, 0.0, TOP + 0.025 + side / 2.0), (side, side, side)),
            box((0.33, 0.3, TOP + 0.04), (0.08, 0.06, 0.08)),
        )
        config = replace(CONFIG, rehearsal=RehearsalConfig())
        alone = plan_order(graph, config)
        assert [(s.object_id, s.safe) for s in alone.steps] == [("o3", True), ("o2", False), ("o1", True)]
        assert "by the graph, it moves o1 with probability" in alone.steps[1].why
        assert alone.risk >= alone.steps[1].risk > 0.3
        held = plan_order(graph, config, hands=2)
        assert [(s.object_id, s.hold) for s in held.steps] == [("o3", ()), ("o2", ("o1",)), ("o1", ())]
        assert held.safe

    def test_the_graph_is_not_contradicted_without_a_word(self):
        """o1 stands without either; but o3 is near it, and o4 is not."""
        for supporter, safe, said in (
            ("o3", False, "by the graph, it moves o1 with probability 0.97"),
            ("o4", True, "supports o1 with probability 0.97, but it stays in place"),
        ):
            supports = (*tower().supports, Support(supporter, "o1", probability=0.97))
            order = plan_order(replace(tower(), supports=supports), CONFIG, goal=supporter)
            (step,) = (s for s in order.steps if s.object_id == supporter)
            assert step.safe == safe
            assert said in step.why

    def test_what_would_fall_by_itself_is_held_and_goes_by_the_graph(self):
        """o2 floats: what carries it has not been seen. The graph may say that o1 does."""
        floating = graph_of(
            box((0.0, 0.0, TOP + 0.03), (0.1, 0.1, 0.06)), box((0.1, 0.0, TOP + 0.2), (0.08, 0.08, 0.06))
        )
        told = replace(floating, supports=(*floating.supports, Support("o1", "o2", certain=False)))
        for graph, taken in ((floating, ["o1"]), (told, ["o2", "o1"])):
            order = plan_order(graph, CONFIG, goal="o1")
            assert order.safe
            assert [s.object_id for s in order.steps] == taken
        (bold,) = plan_order(told, with_risk(0.5), goal="o1", hands=1).steps
        assert (bold.object_id, bold.safe, bold.risk) == ("o1", True, 0.5)
        assert "o2 with probability 0.50" in bold.why
        doubtful = replace(told, supports=(*floating.supports, Support("o1", "o2", probability=0.25)))
        assert plan_order(doubtful, with_risk(0.5), goal="o1", hands=1).steps[0].risk == pytest.approx(1 / 3)

    def test_what_is_under_a_board_or_a_table_is_taken_out_from_under_it(self):
        """Straight up, o5 would hit the board and the ball on it, and o6 the table and the stack on it."""
        for goal, taken in (("o4", ["o4"]), ("o5", ["o5"]), ("o6", ["o6"]), ("o1", ["o2", "o1"])):
            order = plan_order(shelf_graph(), CONFIG, goal=goal)
            assert order.safe
            assert [s.object_id for s in order.steps] == taken

    def test_rehearsals_have_all_support_surfaces(self):
        """Of these stacks, one on each surface, the graph knows nothing; what falls would be held."""
        firm = shelf_objects()[3:5]
        stacks = [(0.0, -0.3, 0.45), (0.6, 0.4, 0.0), (0.0, 0.3, 0.85)]
        halves = [box((x, y, z + h), (0.08, 0.08, 0.1)) for x, y, z in stacks for h in (0.05, 0.15)]
        things = [replace(firm[0], id=f"o{k}", label=k, shape=s) for k, s in enumerate(halves, start=1)]
        graph = SupportGraph((*shelf_objects()[:3], *things))
        for lower, upper in (("o1", "o2"), ("o3", "o4"), ("o5", "o6")):
            order = plan_order(graph, CONFIG, goal=lower)
            assert [s.object_id for s in order.steps] == [upper, lower]

    def test_solids_that_overlap_in_many_parts_disturb_each_other_and_cost_no_time(self):
        """MuJoCo has no room for the forces of their contacts, and took minutes for a third of them."""

        def wall(x):
            slabs = [box((x, 0.01 * k, TOP + 0.1), (0.1, 0.01, 0.2)) for k in range(40)]
            return Solid.of([Polytope.around(slab.outline()) for slab in slabs])

        apart = box((0.3, 0.0, TOP + 0.03), (0.06, 0.06, 0.06))
        order = plan_order(graph_of(wall(0.0), wall(0.04), apart), CONFIG)
        assert "lifting o1 disturbs o2, lifting o2 disturbs o1" in order.refusal
        assert [s.safe for s in order.steps if s.object_id == "o3"] == [True]

    def test_a_goal_may_be_a_name_that_one_object_has(self):
        graph, names = tower(), {"o2": "red mug", "o3": "box", "o4": "box"}
        graph = replace(graph, objects=tuple(replace(o, name=names.get(o.id)) for o in graph.objects))
        assert [s.object_id for s in plan_order(graph, CONFIG, goal="red mug").steps] == ["o3", "o2"]
        with refusal("box", "is the name of several objects; give the id: o3, o4"):
            plan_order(graph, CONFIG, goal="box")
        with refusal("teapot", "not an object"):
            plan_order(graph, CONFIG, goal="teapot")

    def test_nothing_to_take_and_unknown_goals_are_refused(self):
        with pytest.raises(InputError, match="no objects"):
            plan_order(SupportGraph((table_object(TOP),)), CONFIG)
        with pytest.raises(InputError, match="not an object of the graph"):
            plan_order(tower(), CONFIG, goal="o9")
        with pytest.raises(InputError, match="no support surface"):
            plan_order(SupportGraph(tower().objects[1:]), CONFIG)
        with refusal("hands", "3 is neither 1 nor 2"):
            plan_order(tower(), CONFIG, hands=3)
        with refusal("threads", "0 is less than 1"):
            plan_order(tower(), CONFIG, threads=0)
        table, one, *_ = tower().objects
        crowd = SupportGraph((table, *(replace(one, id=f"o{number}") for number in range(301))))
        with pytest.raises(InputError, match=r"301 objects.* 0\.6 GB per thread; raise"):
            plan_order(crowd, CONFIG)


JAW = GripperConfig(kind="parallel", opening=0.08)
DISC = GripperConfig(kind="suction")
TOO_WIDE = "and the gripper takes 80 mm less 2 × 5 mm"


def with_gripper(gripper):
    return replace(CONFIG, gripper=gripper)


def touched(grasp, gripper, shapes):
    """Indices of the shapes that MuJoCo finds in contact with a gripper on its way to a grasp, and up."""
    spec = build_spec([Body(shape) for shape in shapes], "grasps")
    hand = spec.worldbody.add_body(name="hand", mocap=True)
    for low, high in gripper_boxes(gripper, grasp.width):
        hand.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=(low + high) / 2, size=(high - low) / 2)
    model = spec.compile()
    data, found = mujoco.MjData(model), set()
    R, at = grasp.T_world_gripper[:3, :3], grasp.T_world_gripper[:3, 3]
    ways = [at - s * grasp.travel * R[:, 2] for s in np.linspace(0, 1, 21)]
    ways += [at + [0.0, 0.0, s * grasp.travel] for s in np.linspace(0, 1, 21)]
    for place in ways:
        data.mocap_pos[0], data.mocap_quat[0] = place, quaternion(R)
        mujoco.mj_forward(model, data)
        for pair in data.contact.geom[: data.ncon]:
            names = {model.body(model.geom_bodyid[g]).name for g in pair}
            found |= names - {"hand"} if "hand" in names else set()
    return found


class TestGrasps:
    @pytest.mark.parametrize("gripper", [JAW, DISC])
    def test_nothing_touches_a_gripper_on_its_way(self, gripper):
        """On random tables, as MuJoCo sees it; many objects can be grasped, and some cannot."""
        rng, offered, asked = np.random.default_rng(5), 0, 0
        for _ in range(6):
            shapes = [
                box((*rng.uniform(-0.1, 0.1, 2), TOP + size[2] / 2), size, rng.uniform(0, 180))
                for size in rng.uniform((0.02, 0.03, 0.03), (0.07, 0.12, 0.12), (5, 3))
            ]
            others = {str(k): shape for k, shape in enumerate(shapes)} | {"t": table_object(TOP).shape}
            for k, shape in enumerate(shapes):
                around = {i: other for i, other in others.items() if i != str(k)}
                grasp = find_grasp(shape, around, gripper, 0.3)
                asked += 1
                if isinstance(grasp, Grasp):
                    offered += 1
                    assert touched(grasp, gripper, shapes) <= ({f"object{k}"} if gripper is DISC else set())
        assert 0.4 * asked < offered < asked

    def test_it_says_what_is_in_the_way(self):
        block = box((0.0, 0.0, TOP + 0.04), (0.06, 0.06, 0.08))
        walls = {
            f"o{k}": box((*at, TOP + 0.06), size)
            for k, (at, size) in enumerate(
                [((0.042, 0.0), (0.02, 0.2, 0.12)), ((0.0, 0.042), (0.06, 0.02, 0.12))], start=2
            )
        }
        tight = find_grasp(block, walls, JAW, 0.3)
        assert tight.by in (("o2",), ("o3",))
        assert re.fullmatch(rf"{tight.by[0]} is in the way by 1\d mm", tight.why)
        assert isinstance(find_grasp(block, {"o2": walls["o2"]}, JAW, 0.3), Grasp)
        assert isinstance(find_grasp(block, walls, DISC, 0.3), Grasp)  # its tube is narrow
        wide = box((0.0, 0.0, TOP + 0.04), (0.1, 0.1, 0.08))
        assert find_grasp(wide, {}, JAW, 0.3) == Blocked(
            (), f"no grip on it is narrower than 100 mm, {TOO_WIDE}"
        )
        assert find_grasp(sphere((0.0, 0.0, TOP + 0.03), 0.03), {}, DISC, 0.3).why == "no side is flat enough"

    def test_unseen_space_and_the_arm_forbid_grasps(self):
        block = box((0.0, 0.0, TOP + 0.03), (0.06, 0.06, 0.06))
        unseen = VoxelMap.around((0.0, 0.0, TOP), CONFIG.voxels)
        assert find_grasp(block, {}, JAW, 0.3, voxels=unseen).why.startswith(
            "at most 0% of the gripper's way was seen"
        )
        seen = replace(unseen, passes=np.ones_like(unseen.passes))
        assert find_grasp(block, {}, JAW, 0.3, voxels=seen).seen_free == 1.0
        tilted = find_grasp(block, {}, JAW, 0.3, reachable=lambda T: T[:, 2, 2] > -0.9)
        assert tilted.T_world_gripper[2, 2] > -0.9
        low = find_grasp(block, {}, JAW, 0.3, reachable=lambda T: T[:, 2, 3] < TOP + JAW.travel)
        assert low.why == "every grasp is out of reach", "the hand has to move there and up again"
        nowhere = find_grasp(block, {}, JAW, 0.3, reachable=lambda T: np.zeros(len(T), dtype=bool))
        assert nowhere == Blocked((), "every grasp is out of reach")

    def test_an_order_offers_only_lifts_that_a_gripper_can_do(self):
        assert [s.grasp for s in plan_order(tower(), CONFIG).steps] == [None] * 4
        order = plan_order(tower(), with_gripper(DISC), goal="o1", hands=1)
        assert [s.object_id for s in order.steps] == ["o3", "o2", "o1"]
        tops = [s.grasp.T_world_gripper[2, 3] for s in order.steps]
        assert tops == pytest.approx([TOP + 0.18, TOP + 0.12, TOP + 0.06])
        assert order.steps[0].why.endswith("; the gripper grasps it, 0° from straight down")
        narrow = plan_order(tower(), with_gripper(JAW), hands=1)
        assert [s.object_id for s in narrow.steps] == ["o4"]
        assert not narrow.safe
        assert narrow.refusal == (
            "1 of 4 objects can be removed; "
            f"o3 cannot be grasped: no grip on it is narrower than 80 mm, {TOO_WIDE}; "
            f"o2 cannot be grasped: no grip on it is narrower than 100 mm, {TOO_WIDE}; "
            f"o1 cannot be grasped: no grip on it is narrower than 120 mm, {TOO_WIDE}"
        )
        below = plan_order(tower(), with_gripper(JAW), goal="o1")
        assert below.refusal == f"o1 cannot be grasped: no grip on it is narrower than 120 mm, {TOO_WIDE}"

    def test_an_order_says_that_what_lies_on_an_unsafe_lift_cannot_be_grasped(self):
        table = graph_of(
            box((0.0, 0.0, TOP + 0.15), (0.06, 0.06, 0.3)), box((0.0, 0.0, TOP + 0.32), (0.1, 0.1, 0.04))
        )
        order = plan_order(table, with_gripper(JAW))
        assert [(s.object_id, s.safe) for s in order.steps] == [("o1", False)]
        assert order.refusal == (
            "no safe order: lifting o1 disturbs o2; "
            f"o2 cannot be grasped: no grip on it is narrower than 100 mm, {TOO_WIDE}"
        )

    def test_a_scene_plans_an_order_for_a_gripper_by_name(self):
        scene = Scene()
        scene.graph = graph_of(box((0.0, 0.0, TOP + 0.03), (0.06, 0.1, 0.06)))
        (plain,) = scene.order().steps
        (known,) = scene.order(gripper="franka", threads=1).steps
        assert (plain.grasp, known.safe) == (None, True)
        closing = known.grasp.T_world_gripper[:3, 1]
        assert abs(closing[0]) == pytest.approx(1.0), "panda_hand_tcp closes along y, here on 6 cm"
        scene.config = with_gripper(replace(JAW, opening=0.03))
        assert "gripper takes 30 mm" in scene.order(gripper="parallel").refusal, "a kind keeps the settings"
        with pytest.raises(InputError, match="'hand' is unknown; choose one of franka, none"):
            scene.order(gripper="hand")
        with pytest.raises(InputError, match="risk: 2 is not a probability"):
            scene.order(risk=2.0)

    def test_a_map_of_the_camera_is_none_of_the_gripper(self):
        reach = ReachabilityMap(np.full((8, 8, 8, 1), 255, np.uint8), -4.0 * np.ones(3), 1.0, 0.0, "camera")
        with pytest.raises(InputError, match=r"is a map of the camera .* needed is one of the gripper"):
            plan_order(tower(), with_gripper(JAW), reachable=reach)


def in_physics(*shapes):
    return scene_from_spec(build_spec([Body(shape) for shape in shapes], "test"), "test", "test")


def take(object_id, *hold):
    return TakeStep(object_id, hold, True, 0.0, "")


def dismantle(scene, steps):
    """Results of removing objects one after the other."""
    hands = SimulatedHands(scene, CONFIG)
    return [hands.take(step, BODIES) for step in steps]


@pytest.fixture(scope="module")
def scene():
    """The tower in physics."""
    return in_physics(*(o.shape for o in tower().objects if o.role == "object"))


BODIES = {f"o{k}": f"object{k - 1}" for k in range(1, 5)}


class TestDismantling:
    def test_a_safe_order_comes_true_and_a_wrong_one_names_its_harm(self, scene):
        assert bodies_of(tower(), true_scene_from_simulation(scene, ground_truth(scene))) == BODIES
        order = plan_order(tower(), CONFIG)
        taken = dismantle(scene, order.steps)
        assert [t.body for t in taken] == [BODIES[s.object_id] for s in order.steps]
        assert all(t.ok for t in taken)
        (harm,) = dismantle(scene, [take("o1")])
        assert not harm.ok
        assert harm.disturbed == ("object1", "object2")
        (nothing,) = dismantle(scene, [take("o7", "o8")])
        assert (nothing.body, nothing.ok, nothing.held) == (None, True, ())

    def test_what_is_held_stays_and_what_is_gone_stays_away(self, scene):
        top, bottom = dismantle(scene, [take("o3"), take("o1", "o2")])
        assert [top.ok, bottom.ok] == [True, True]
        assert bottom.held == ("object1",)
        assert np.abs(bottom.film[:, 1] - poses_of(scene)[1]).max() < 0.01
        assert (bottom.film[:, 2, 2] > ASIDE / 2.0).all()
        np.testing.assert_array_equal(bottom.film[-1, :, 2] > ASIDE / 2.0, [True, False, True, False])


QUICK = ["--set=rehearsal.draws=2", "--risk=0.2", "--set=lift.watch=1.0"]


@pytest.mark.slow
class TestCommands:
    def test_an_order_is_a_document_or_a_table(self, kept_run, capsys):
        assert run_command("order", kept_run, "--json", *QUICK) == 0
        out = capsys.readouterr()
        document = json.loads(out.out)
        assert (out.err, document["safe"], document["refusal"]) == ("", True, None)
        assert [step["object"] for step in document["steps"]] == ["o2", "o1"]
        for step in document["steps"]:
            assert step.keys() == {"object", "hold", "safe", "risk", "probability", "why"}
            assert (step["safe"], step["hold"], step["probability"]) == (True, [], 1.0 - step["risk"])
        assert run_command("order", kept_run, "--goal", "o2", *QUICK) == 0
        assert capsys.readouterr().out.split("\n") == [
            "Safe order (nothing else moves: 83%): o2.",
            "Not checked: whether a gripper can grasp the objects, because none is given.",
            "",
        ]
        blind = "--set", "gripper.seen=0"
        assert run_command("order", kept_run, "--gripper", "parallel", *blind, *QUICK) == 3
        table = capsys.readouterr().out
        assert "Safe as far as it goes (nothing else moves: 83%): o2.\n" in table
        assert "1 of 2 objects can be removed; o1 cannot be" in table
        assert "gripper, opening 140 mm" in table
        assert re.search(r"│ 1 +│ o2 +│ 0.83 ", table)
        assert max(len(line) for line in table.splitlines() if line[0] in "┏┃│") <= 80

    def test_a_gripper_moves_only_where_the_run_saw_free_space(self, kept_run, tmp_path, capsys):
        assert run_command("order", kept_run, "--gripper", "parallel", *QUICK) == 3
        assert "o2 cannot be grasped: at most" in capsys.readouterr().out
        blind = run_command("order", kept_run / "graph.json", "--gripper", "parallel", *QUICK)
        assert (blind, "Not checked: whether the gripper's path" in capsys.readouterr().out) == (3, True)

    @pytest.mark.parametrize(
        ("words", "status", "said"),
        [
            ("--gripper claw", 2, "parallel"),
            ("--risk 1.5", 2, "1.5 is not a probability from 0 to 1"),
            ("--hands 3", 2, "3"),
            ("--goal o9", 4, "o9: is not an object of the graph; known objects: o1, o2"),
            ("--gripper none --reach missing.npz", 1, "add --gripper"),
            ("--gripper parallel --reach missing.npz", 1, "missing.npz"),
        ],
    )
    def test_orders_that_cannot_be_are_errors(self, words, status, said, kept_run, tmp_path, capsys):
        assert run_command("order", kept_run, *QUICK, *words.split()) == status
        assert said in capsys.readouterr().err
        assert run_command("order", tmp_path, *QUICK) == 1
        assert "not a run or session" in capsys.readouterr().err

    def test_grasps_must_lie_within_the_arms_reach(self, kept_run, tmp_path, capsys):
        everything, orders = np.full((8, 8, 8, 1), 255, dtype=np.uint8), []
        for x in (None, -4.0, 4.0):
            T_world_base = transforms.rigid(np.eye(3), (x or 0.0, 0.0, 0.0))
            known = np.array([0.0, -4.0, -4.0]), 1.0, 0.0, "gripper", T_world_base
            write_reachability(tmp_path / "reach.npz", ReachabilityMap(everything, *known))
            reach = () if x is None else ("--reach", tmp_path / "reach.npz")
            words = ("--json", "--gripper", "parallel", "--set", "gripper.seen=0", *reach)
            assert run_command("order", kept_run, *words, *QUICK) == 3, "o1 is too wide"
            orders.append(json.loads(capsys.readouterr().out))
        anywhere, around, beside = orders
        assert anywhere == around
        assert [np.shape(step["grasp"]["T_world_gripper"]) for step in around["steps"]] == [(4, 4)]
        assert beside["steps"] == []
        assert "0 of 2 objects can be removed; o2 cannot be grasped: every grasp is" in beside["refusal"]

    def test_a_scene_is_cleared_and_what_is_gone_is_not_missed(self, scene_file, tmp_path, capsys):
        out = tmp_path / "run"
        assert run_command("clear", scene_file, "--goal", "o1", "--out", out, *SMALL, *QUICK) == 0
        said, run = capsys.readouterr().err.splitlines(), read_run(out)
        lifts = [step.lift and step.lift.object_id for step in read_steps(run)]
        assert [i for i in lifts if i] == ["o2", "o1"]
        assert [o.role for o in run.graph.objects] == ["support_surface"]
        first, last = (said.index(f"  removed {i}: disturbed nothing in 2 rehearsals") for i in ("o2", "o1"))
        assert not any("o2" in line for line in said[first + 1 : last])
        assert not any("gone" in line or "reported" in line for line in said)
        assert said[last - 1].split(":")[0] == f"view {len(run.views)}, after its lift"
        assert "was removed" not in (out / "report.html").read_text()
        assert run_command("evaluate", out, "--json") == 0
        *_, before, cleared = json.loads(capsys.readouterr().out)["views"]
        assert before["recall"] == cleared["recall"] == 1.0
        assert cleared["brier"] is cleared["average_precision"] is cleared["mean_iou"] is None

    def test_a_goal_that_was_not_in_place_is_not_removed(self, scene_file):
        table = simulate(scene_file)
        explorer = Explorer(table.camera, table.robot, config=CONFIG)
        tried = []

        def take(step):
            tried.append(step.object_id)
            return False

        *_, last = clear(explorer, take, goal="o2")
        assert set(tried) == {"o2"}
        assert len(tried) > 1
        assert last.stop.endswith("lifts in a row found no object in place")

    @pytest.mark.parametrize(("seen", "taken"), [(0.99, []), (0.0, [("o2", "can"), ("o1", "crate")])])
    def test_a_gripper_waits_until_its_path_is_seen(self, seen, taken, scene_file, tmp_path, capsys):
        """Above the table there is nothing to read a depth from, so that space stays unknown."""
        command = ["clear", scene_file, "--gripper", "suction", "--out", tmp_path / "run", "--json"]
        command += ["--goal", "o1", "--no-report", f"--set=gripper.seen={seen}"]
        assert run_command(*command, *SMALL, *QUICK) == (0 if taken else 3)
        document, run = json.loads(capsys.readouterr().out), read_run(tmp_path / "run")
        assert [(step["object"], step["body"]) for step in document["steps"]] == taken
        assert all(step["ok"] and step["disturbed"] == [] for step in document["steps"])
        assert all(0.0 <= step["grasp"]["seen_free"] < 0.99 for step in document["steps"])
        assert (document["success"], document["views"]) == (bool(taken), len(run.views))
        assert ("seen to be free, less than 99%" if not taken else "o1 is removed") in document["stop"]
        assert {o.id for o in run.graph.objects} == {"o0", "o1", "o2"} - {i for i, _ in taken}

    def test_it_keeps_looking_while_no_lift_is_safe(self, scene_file, tmp_path, capsys):
        command = ["clear", scene_file, "--views", 3, "--set=active.effort=1", "--json", "--no-report"]
        assert run_command(*command, "--out", tmp_path / "run", *SMALL, "--risk=0", QUICK[0], QUICK[2]) == 3
        document = json.loads(capsys.readouterr().out)
        assert (document["views"], document["steps"]) == (3, [])
        assert document["stop"].startswith("no lift is safe")

    @pytest.mark.parametrize(
        ("name", "segmentation", "why", "views"),
        [("clear", "labels", "is not an object; known objects: o1 (crate), o2 (can)", None),
         ("clear", "auto", "was not found in 2 views; known objects: o1, o2", 2),
         ("explore", "auto", "was not found in 2 views; known objects: o1, o2", 2)],
    )  # fmt: skip
    def test_an_unknown_goal_is_an_error(self, name, segmentation, why, views, scene_file, tmp_path, capsys):
        command = [name, scene_file, "--goal", "o99", "--views", 2, "--segmentation", segmentation]
        command += ["--quiet", "--no-report", "--out", tmp_path / "run", *(QUICK * (name == "clear"))]
        assert run_command(*command, *SMALL) == 4
        assert capsys.readouterr() == ("", f"error: --goal o99: {why}\n")
        assert (tmp_path / "run").exists() == (views is not None)
        if views is not None:
            assert len(read_run(tmp_path / "run").views) == views

    def test_a_body_of_a_scene_can_be_the_goal(self, scene_file, tmp_path, capsys):
        steps = []
        for goal in ("can", "o2"):
            command = ["clear", scene_file, "--goal", goal, "--json", "--no-report", "--out", tmp_path / goal]
            assert run_command(*command, *SMALL, *QUICK) == 0
            steps.append(json.loads(capsys.readouterr().out)["steps"])
        assert steps[0] == steps[1]
        assert steps[0][-1]["body"] == "can"
        assert run_command("explore", scene_file, "--goal", "cam", "--out", tmp_path / "run", *SMALL) == 4
        assert "did you mean can? known objects: o1 (crate), o2 (can)" in capsys.readouterr().err

    @pytest.mark.parametrize(("segmentation", "first"), [("labels", "o4"), ("auto", None)])
    def test_a_goal_that_no_view_shows_is_uncovered_where_labels_can_name_it(self, segmentation, first):
        table = simulate("bridge")
        few = replace(CONFIG, active=replace(CONFIG.active, max_views=2))
        explorer = Explorer(table.camera, table.robot, config=few, segmentation=segmentation)
        steps = clear(explorer, lambda lift: True, goal="o9")
        lift = next((step.lift for step in steps if step.lift is not None), None)
        assert (lift and lift.object_id) == first
        assert first or explorer.step.stop.endswith("o9 was not found")

    def test_a_recording_cannot_be_cleared(self, recording, refused):
        refused("clear", recording, *QUICK, says="cannot be simulated")
