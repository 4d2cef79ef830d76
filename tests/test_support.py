"""Contacts, support relations with their reasons, what a removal does, and shapes made plausible."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from synthetic import motion_about_vertical

from caryatid.config import PlausibilityConfig, SupportConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere, Uncertainty
from caryatid.geometry.solids import Polytope, Solid
from caryatid.geometry.transforms import rigid
from caryatid.graph import SceneObject, Support
from caryatid.paper import infer_by_area
from caryatid.support.contacts import find_contacts, find_gap
from caryatid.support.plausibility import reconcile
from caryatid.support.relations import explain, infer, predict_removal, removal_of

CONFIG = SupportConfig()
PAPER = replace(CONFIG, stability="area")
PLAUSIBLE = PlausibilityConfig()
TABLE = Box(rigid(np.eye(3), (0.0, 0.0, -0.02)), np.array([1.0, 1.0, 0.04]))
SURFACE = SceneObject("o0", 0, TABLE, "support_surface")


def at(x, y, z, turn=(0.0, 0.0, 0.0)):
    return rigid(transforms.rotation_from_vector(np.radians(turn)), (x, y, z))


def block(x, y, z, size, turn=(0, 0, 0)):
    """A box whose centre is at x, y and whose bottom, if level, is at z."""
    return Box(at(x, y, z + size[2] / 2.0, turn), np.array(size))


def cube(x, y, z, side=0.1):
    return Box(at(x, y, z), np.full(3, side))


def unsure(sigma=0.001, turn=0.001, **sides):
    """All sides this unsure [m], but for those named (`low_z` is −z, `high_z` +z)."""
    names = ("low_x", "high_x", "low_y", "high_y", "low_z", "high_z")
    each = np.array([sides.get(name, sigma) for name in names])
    position = np.sqrt((each.reshape(3, 2) ** 2).sum(axis=1)) / 2.0
    return Uncertainty(position, np.full(3, turn), 2.0 * position, each)


def scene(*shapes, uncertainty=None):
    objects = [SceneObject(f"o{k}", k, shape, uncertainty=uncertainty) for k, shape in enumerate(shapes, 1)]
    return [SURFACE, *objects]


def edges(graph):
    return {s.pair: s.kind for s in graph.supports}


def random_shapes(count, rng, side):
    shapes = []
    for k in range(count):
        T = rigid(transforms.random_rotation(rng), rng.uniform(-side, side, 3))
        a, b, c = rng.uniform(0.04, 0.15, 3)
        shapes.append([Box(T, np.array([a, b, c])), Cylinder(T, a / 2.0, b), Sphere(T, a / 2.0)][k % 3])
    return shapes


def tower():
    return scene(
        block(0, 0, 0, (0.1, 0.1, 0.08)),
        Cylinder(at(0.01, 0, 0.13), 0.04, 0.1),
        Sphere(at(0.01, 0, 0.21), 0.03),
        block(0.2, 0, 0, (0.08, 0.08, 0.08)),
    )


def bridge(left=0.0, right=0.0):
    return scene(
        block(-0.12, 0, 0, (0.06, 0.06, 0.1 + left)),
        block(0.12, 0, 0, (0.06, 0.06, 0.1 + right)),
        block(0, 0, 0.1, (0.32, 0.06, 0.02)),
    )


def counterweight(load_x=0.0, **fields):
    return scene(
        block(0, 0, 0, (0.1, 0.1, 0.1)),
        block(0.14, 0, 0.1, (0.36, 0.06, 0.02)),
        Cylinder(at(load_x, 0, 0.165), 0.04, 0.09),
        **fields,
    )


def leaning_plank(gap=0.0):
    """A thin board that stands 12° off the upright with its upper part against the edge of a block."""
    board = Box(at(0, 0, 0, (0, 12, 0)), np.array([0.01, 0.08, 0.24]))
    board = board.moved(at(0, 0, board.support(np.array([[0.0, 0.0, -1.0]]))[0]))
    top = board.T_world_object[:3] @ np.array([0.005, 0.0, 0.1, 1.0])
    return scene(board, block(top[0] + gap + 0.03, 0, 0, (0.06, 0.1, top[2])))


class TestContacts:
    @pytest.mark.parametrize("margin", [0.001, 0.005, 0.02])
    def test_margin_is_the_largest_gap(self, margin):
        near, far = cube(0, 0, 0.1 + 0.95 * margin), cube(0, 0, 0.1 + 1.05 * margin)
        assert [(c.a, c.b) for c in find_contacts([cube(0, 0, 0), near], margin)] == [(0, 1)]
        assert find_contacts([cube(0, 0, 0), far], margin) == []

    def test_distances_agree_with_the_signed_distance_whatever_was_asked_before(self):
        rng = np.random.default_rng(3)
        seen = 0
        for count in (9, 30, 3, 17, 2, 70, 16):
            shapes = random_shapes(count, rng, 0.05 * count ** (1.0 / 3.0))
            found = find_contacts(shapes, 0.02)
            assert [(c.a, c.b) for c in found] == sorted((c.a, c.b) for c in found if c.a < c.b)
            for c in found:
                assert np.linalg.norm(c.normal_world) == pytest.approx(1.0)
                if c.distance > 0.0:
                    seen += 1
                    apart = [shapes[k].signed_distance(c.points_world) for k in (c.a, c.b)]
                    assert sum(apart).min() == pytest.approx(c.distance, abs=5e-4)
        assert seen > 30

    def test_threads_do_not_disturb_each_other(self):
        rng = np.random.default_rng(12)
        scenes = [random_shapes(25, rng, 0.15) for _ in range(20)]

        def gaps(shapes):
            return [(c.a, c.b, c.distance) for c in find_contacts(shapes, 0.01)]

        alone = [gaps(shapes) for shapes in scenes]
        with ThreadPoolExecutor(4) as pool:
            assert list(pool.map(gaps, scenes)) == alone


def let_down(right):
    """A board 20 mm over a pillar of 100 mm and one of another height."""
    pillars = [block(x, 0, 0, (0.06, 0.06, z)) for x, z in ((-0.12, 0.1), (0.12, right))]
    return scene(*pillars, block(0, 0, 0.12, (0.32, 0.06, 0.02)))


def beside(overlap):
    return scene(
        block(0, 0, 0, (0.1, 0.1, 0.1)),
        block(0.1 - overlap, 0.01, 0, (0.1, 0.1, 0.14)),
        Cylinder(at(0, 0.09 - overlap, 0.06), 0.04, 0.12),
    )


def let_down_at_a_wall(gap):
    return scene(
        block(0, 0, 0, (0.1, 0.1, 0.05)),
        block(0.04 + gap, 0, 0.08, (0.05, 0.05, 0.05)),
        block(0.09 + 2 * gap, 0, 0, (0.05, 0.05, 0.12)),
    )


def plank_between():
    """A block that the plank touches, and others 8 mm ahead and beside."""
    board, ahead = (o.shape for o in leaning_plank()[1:])
    near, aside = (ahead.moved(at(*by)) for by in ((0.008, 0.06, 0), (0.0, -0.06, 0)))
    return scene(board, near, aside)


def falling_plank():
    """What stands behind and beside it holds no plank; it falls onto what is behind."""
    board = leaning_plank()[1].shape
    foot = board.T_world_object[:3] @ np.array([-0.005, 0.0, -0.1, 1.0])
    behind = block(foot[0] - 0.032, 0, 0, (0.06, 0.1, 0.06))
    return scene(board, behind, block(board.T_world_object[0, 3], 0.072, 0, (0.1, 0.06, 0.2)))


STEADY = scene(
    block(-0.04, 0, 0, (0.14, 0.06, 0.1)),
    block(0.1, 0, 0, (0.06, 0.06, 0.091)),
    block(0.0, 0, 0.1, (0.24, 0.06, 0.02)),
)
"""Bridges need a contact as far away as the second one here."""
STEEP = scene(
    Box(at(-0.0263, -0.0127, 0.0534, (6.74, 121.27, 126.69)), np.array([0.0958, 0.1048, 0.0627])),
    Box(at(-0.0698, 0.1592, 0.0322, (-168.09, -64.4, 0.0)), np.array([0.1224, 0.072, 0.0648])),
    Box(at(-0.0371, 0.0598, 0.0932, (40.59, 0.11, 86.58)), np.array([0.0648, 0.1042, 0.1174])),
)
HELD = {
    "a tower": (tower(), "o0-o1 o1-o2 o2-o3 o0-o4"),
    "a tower without a table": (tower()[1:], "o1-o2 o2-o3"),
    "nothing": ([], ""),
    "a table": ([SURFACE], ""),
    **{
        f"a bridge, {left} {right}": (bridge(left, right), "o0-o1 o0-o2 o1-o3 o2-o3")
        for left, right in ((0.0, 0.0), (-0.009, 0.0), (0.0, -0.009), (0.008, -0.004))
    },
    "a far contact where none is needed": (STEADY, "o0-o1 o0-o2 o1-o3"),
    **{f"side by side, {by}": (beside(by), "o0-o1 o0-o2 o0-o3") for by in (-0.004, 0.0, 0.004, 0.01)},
    "a counterweight": (counterweight(), "o0-o1 o1-o2 o2-o3 o3>o2"),
    **{f"a leaning plank, {gap}": (leaning_plank(gap), "o0-o1 o0-o2 o2/o1") for gap in (0.0, 0.004)},
    "a plank near and at a block": (plank_between(), "o0-o1 o0-o2 o0-o3 o3/o1"),
    "a plank that falls": (falling_plank(), "o0-o1 o0-o2 o0-o3 o1/o2"),
    "let down on both pillars": (let_down(0.099), "o0-o1 o0-o2 o1-o3 o2-o3"),
    "let down on one pillar": (let_down(0.06), "o0-o1 o0-o2 o1-o3"),
    **{f"a wall beside, {gap}": (let_down_at_a_wall(gap), "o0-o1 o1-o2 o0-o3") for gap in (1.5e-3, 4e-3)},
    "steep faces and friction": (STEEP, "o0-o1 o0-o2 o1-o3 o2-o3"),
    "in the air": (scene(Sphere(at(0, 0, 0.4), 0.03)), ""),
    "on something unseen": (scene(*(o.shape.moved(at(0, 0, 0.2)) for o in bridge()[1:])), "o1-o3 o2-o3"),
    "beside what is on something unseen": (
        scene(*(o.shape.moved(at(0, 0, 0.1)) for o in tower()[1:4]), block(0.08, 0, 0, (0.05, 0.2, 0.15))),
        "o1-o2 o2-o3 o0-o4",
    ),
    "sunk in the table": (scene(block(0, 0, -0.025, (0.06, 0.06, 0.05))), "o0-o1"),
}
"""Objects, and what holds what: `-` bottom-up, `/` leaning, `>` from the top down."""
KINDS = {"-": "bottom-up", "/": "lean", ">": "top-down"}


class TestInfer:
    @pytest.mark.parametrize("name", HELD)
    def test_what_holds_what_wherever_it_stands_and_in_whatever_order(self, name):
        objects, said = HELD[name]
        expected = {(word[:2], word[3:]): KINDS[word[2]] for word in said.split()}
        T = motion_about_vertical(np.random.default_rng(11))
        moved = [replace(o, shape=o.shape.moved(T)) for o in objects]
        for same in (objects, objects[::-1], moved):
            assert edges(infer(same, CONFIG)) == expected

    def test_a_graph_says_how_sure_and_how_steady_all_is(self):
        graph = infer(tower(), CONFIG)
        assert all(s.certain and s.occurrences == s.opportunities == 1 for s in graph.supports)
        assert {k.probability for k in (*graph.objects, *graph.supports)} == {1.0}
        assert {s.probability for s in infer_by_area(tower(), PAPER).supports} == {None}
        assert [o.id for o in graph.objects] == ["o0", "o1", "o2", "o3", "o4"]
        assert {k for k, s in graph.stability.items() if s.stable} == {"o1", "o2", "o3", "o4"}
        for support in graph.supports:
            np.testing.assert_allclose(support.normal_world, (0.0, 0.0, 1.0), atol=0.01)
        np.testing.assert_allclose(graph.support("o1", "o2").contact_world, (0.01, 0.0, 0.08), atol=2e-3)
        assert infer(falling_plank(), CONFIG).stability["o1"].tips
        assert edges(infer(leaning_plank(0.008), CONFIG))["o2", "o1"] == "lean"

    def test_a_counterweight_holds_top_down(self):
        graph = infer(counterweight(), replace(CONFIG, draws=60))
        assert graph.support("o3", "o2").doubtful
        assert graph.stability["o2"].tips
        assert graph.stability["o2"].overhang == pytest.approx(0.09, abs=0.002)
        assert graph.support("o3", "o2").why.startswith("o3 holds o2 down (")

    def test_on_paper_only_the_support_area_ratio_counts(self):
        """The plank, 36 cm × 6 cm, touches its block over 9 cm × 6 cm: r_s = 9/36 = 0.25, eq. 1."""
        objects = counterweight(load_x=0.2)
        assert ("o3", "o2") not in edges(infer(objects, CONFIG))
        stable = infer_by_area(objects, PAPER)
        assert stable.stability["o2"].ratio == pytest.approx(0.25)
        assert stable.stability["o2"].stable
        assert ("o3", "o2") not in edges(stable)
        unstable = infer_by_area(objects, replace(PAPER, min_area_ratio=0.26))
        assert edges(unstable)["o3", "o2"] == "top-down"
        assert not unstable.support("o3", "o2").certain

    @pytest.mark.parametrize("gap", [0.015, -0.02])
    def test_what_no_uncertainty_explains_is_doubtful(self, gap):
        """A gap, and an overlap, of five standard deviations and more."""
        known = unsure(0.002, 0.0)
        objects = [SURFACE, thing(1, (0, 0, 0.05), known), thing(2, (0, 0, 0.15 + gap), known)]
        support = infer(objects, CONFIG).support("o1", "o2")
        assert support.doubtful
        assert support.kind == "bottom-up"

    def test_a_doubt_about_two_solids_is_said_once(self):
        """Whatever the number of their parts that overlap, with the depth of the deepest."""

        def halves(x, gap):
            outlines = [block(x, y, 0, (0.2, 0.1, 0.1)).outline() for y in (-0.05, 0.05)]
            return Solid.of([Polytope.around(outline + (gap, 0.0, 0.0)) for outline in outlines])

        solids = scene(halves(0.0, 0.0), halves(0.2, -0.03))[1:]
        one, two = reconcile(solids, PlausibilityConfig())
        assert one.doubt == "overlaps o2 by 30 mm, more than both fits explain"
        assert two.doubt == "overlaps o1 by 30 mm, more than both fits explain"

    @pytest.mark.parametrize(
        ("objects", "pair", "said"),
        [
            (tower(), ("o0", "o1"), "o1 rests on o0 with "),
            (tower(), ("o0", "o2"), "they do not touch, gap 80.0 mm"),
            (tower(), ("o2", "o1"), "o2 does not support o1: o1 rests without it ("),
            (
                [*tower(), SceneObject("o5", 5, block(0.281, 0, 0, (0.08, 0.08, 0.08)))],
                ("o4", "o5"),
                "o5 rests without it (gap 1.0 mm, normal 90° from the vertical). Probability 0.00.",
            ),
            (leaning_plank(), ("o2", "o1"), "o1 leans on o2 with"),
            (HELD["sunk in the table"][0], ("o1", "o0"), "nothing supports it"),
        ],
    )
    def test_why_and_why_not(self, objects, pair, said):
        graph = infer(objects, CONFIG)
        assert said in explain(graph, *pair, CONFIG)
        known = graph.support(*pair)
        assert known is None or explain(graph, *pair, CONFIG) == f"{known.why} Probability 1.00."

    def test_why_on_paper_and_of_whom_it_cannot_be_asked(self):
        graph = infer_by_area(tower(), PAPER)
        assert explain(graph, "o2", "o1", PAPER).startswith("o2 does not support o1: o2 is not")


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda graph: explain(graph, "o1", "o9", CONFIG), "not an object of the graph"),
        (lambda graph: explain(graph, "o1", "o1", CONFIG), "itself"),
        (lambda graph: predict_removal(graph, "o9", CONFIG), "not an object of the graph"),
        (lambda graph: predict_removal(graph, "o0", CONFIG), "support surface"),
        (lambda graph: infer([*tower(), tower()[1]], CONFIG), "same id"),
        (lambda graph: infer_by_area([*tower(), tower()[1]], PAPER), "same id"),
        (lambda graph: infer(tower(), PAPER), "infer_by_area"),
        (lambda graph: find_contacts([cube(0, 0, 0), cube(0, 0, 0.1)], -0.001), "margin"),
        (lambda graph: find_contacts([cube(0, 0, 0), cube(0, 0, 0.1)], float("nan")), "margin"),
    ],
)
def test_what_makes_no_sense_is_refused(ask, said):
    with pytest.raises(InputError, match=said):
        ask(infer(tower(), CONFIG))


class TestProbabilities:
    def likely(self, objects, config=CONFIG, seed=0):
        return {s.pair: s.probability for s in infer(objects, config, np.random.default_rng(seed)).supports}

    def test_a_counterweight_of_unknown_weight_holds_as_often_as_it_is_heavy_enough(self):
        """The plank's moment is 4.32·10⁻⁴·0.09 m⁴, the weight's 4.52·10⁻⁴·0.05 m⁴.

        So the weight must be 1.72 times as dense. Of two densities from 100 to 8000 kg/m³ that is so in 28 %
        of all draws, and these count ten times the others.
        """
        many = replace(CONFIG, draws=300)
        heavy = 0.28 / (0.28 + 0.72 * many.unexplained)
        assert self.likely(counterweight(), many)["o3", "o2"] == pytest.approx(heavy, abs=0.06)

    def test_a_contact_that_would_open_by_the_uncertainty_is_less_likely(self):
        """A slab that one block carries alone lies 2 mm over a second one: it may rest on that, or not."""

        def shown(sigma):
            known = unsure(sigma, 0.0)
            first = thing(1, (0, 0, 0.05), known, (0.16, 0.2, 0.1))
            second = thing(2, (0.12, 0, 0.0485), known, (0.06, 0.2, 0.097))
            slab = thing(3, (0.05, 0, 0.11), known, (0.24, 0.1, 0.02))
            return self.likely([SURFACE, first, second, slab], replace(CONFIG, draws=60)).get(("o2", "o3"))

        assert shown(0.0002) is None
        assert 0.5 < shown(0.003) < 0.98

    def test_an_object_whose_size_is_a_guess_is_less_likely_the_one_it_is_taken_for(self):
        sides = scene(cube(0, 0, 0.05), uncertainty=unsure(0.001, high_x=0.1))
        _, guessed = infer(sides, replace(CONFIG, draws=60)).objects
        _, sure = infer(scene(cube(0, 0, 0.05), uncertainty=unsure(0.001)), CONFIG).objects
        assert sure.probability == 1.0
        assert 0.3 < guessed.probability < 0.9


LEGS = [block(x, y, 0, (0.05, 0.05, 0.1)) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
ON_LEGS = scene(*LEGS, block(0, 0, 0, (0.08, 0.08, 0.1)), block(0, 0, 0.1, (0.3, 0.3, 0.02)))
RIDDEN = [*counterweight(), SceneObject("o4", 4, Sphere(at(0.24, 0.0, 0.14), 0.02))]


class TestRemoval:
    @pytest.mark.parametrize(
        ("objects", "taken", "falling"),
        [
            *((tower(), taken, falling) for taken, falling in (("o1", "o2 o3"), ("o2", "o3"), ("o4", ""))),
            (bridge(), "o1", "o3"),
            (ON_LEGS, "o5", ""),
            (counterweight(), "o3", "o2"),
            (RIDDEN, "o3", "o2 o4"),
        ],
        ids=["tower o1", "tower o2", "tower o4", "bridge", "four legs", "counterweight", "rider"],
    )
    def test_what_stands_on_it_or_is_held_down_by_it_falls_for_certain(self, objects, taken, falling):
        effects = predict_removal(infer(objects, CONFIG), taken, CONFIG)
        assert {e.object_id for e in effects if e.probability > 0.95} == set(falling.split())
        assert all(e.why for e in effects)

    def test_what_the_fits_do_not_tell_for_sure_may_fall(self):
        """Without o2 the slab's centre is 5 mm outside what is left, and unsure by 10 mm: 69 % tip at all."""
        pillars = [thing(k, (x, 0, 0.05), None, (0.06, 0.06, 0.1)) for k, x in ((1, -0.035), (2, 0.1))]
        slab = thing(3, (0, 0, 0.11), unsure(0.0, 0.0, low_x=0.02), (0.3, 0.06, 0.02))
        graph, many = infer([SURFACE, *pillars, slab], CONFIG), replace(CONFIG, draws=300)
        (effect,) = predict_removal(graph, "o2", many)
        assert effect.object_id == "o3"
        assert 0.4 < effect.probability < norm.cdf(0.5)

    def test_that_nothing_else_moves_is_less_likely_than_that_each_stays(self):
        """Without o2, each of two slabs has its centre 12 mm inside what is left, and unsure by 10 mm."""
        objects = [SURFACE, thing(2, (0.1, 0, 0.05), None, (0.06, 0.4, 0.1))]
        for k, y in ((3, -0.15), (5, 0.15)):
            objects.append(thing(k, (-0.018, y, 0.05), None, (0.06, 0.06, 0.1)))
            objects.append(thing(k + 1, (0, y, 0.11), unsure(0.0, 0.0, low_x=0.02), (0.3, 0.06, 0.02)))
        many = replace(CONFIG, draws=300)
        removal = removal_of(infer(objects, many), "o2", many)
        assert {e.object_id for e in removal.effects} == {"o4", "o6"}
        assert removal.moving == ()
        stay = [1.0 - e.probability for e in removal.effects]
        assert removal.rest == pytest.approx(np.prod(stay), abs=0.02)
        assert removal.rest < min(stay) - 0.02
        few = removal_of(infer(tower(), CONFIG), "o2", CONFIG)
        assert [e.object_id for e in few.moving] == ["o3"]
        assert 0.9 < few.rest < 1.0, "a few draws make nothing certain"

    def test_what_an_earlier_view_was_surer_of_still_counts(self):
        graph = infer(scene(*(o.shape for o in tower()[1:])), CONFIG)
        assert predict_removal(graph, "o4", CONFIG) == ()
        earlier = Support("o4", "o3", probability=0.6)
        (effect,) = predict_removal(replace(graph, supports=(*graph.supports, earlier)), "o4", CONFIG)
        assert (effect.object_id, effect.probability) == ("o3", pytest.approx(0.6))


def thing(label, centre, known, size=(0.1, 0.1, 0.1)):
    return SceneObject(f"o{label}", label, Box(rigid(np.eye(3), centre), np.array(size)), uncertainty=known)


CAN = Cylinder(at(0, 0, 0.05), 0.04, 0.1)


class TestReconcile:
    @pytest.mark.parametrize(
        "shape", [cube(0, 0, 0.055), Cylinder(at(0, 0, 0.055), 0.03, 0.1), Sphere(at(0, 0, 0.055), 0.05)]
    )
    def test_what_hovers_is_let_down_onto_what_carries_it(self, shape):
        hovering = SceneObject("o1", 1, shape, uncertainty=unsure(0.004))
        _, after = reconcile([SURFACE, hovering], PLAUSIBLE)
        assert -0.0012 < find_gap(TABLE, after.shape) < 0.0012
        assert after.shape.kind == shape.kind
        beyond = replace(hovering, shape=hovering.shape.moved(at(0, 0, 0.007)))
        assert reconcile([SURFACE, beyond], PLAUSIBLE)[1] is beyond

    @pytest.mark.parametrize("shape", [cube(0, 0, 0.04, 0.08), CAN, Sphere(at(0, 0, 0.04), 0.04)])
    @pytest.mark.parametrize("degrees", [0, 30, 90])
    def test_an_overlap_is_taken_from_what_is_unsure(self, shape, degrees):
        towards = transforms.rotation_from_vector((0, 0, np.radians(degrees)))[:, 0]
        reach = shape.support(towards[None])[0]
        wall = Box(at(*((reach + 0.096) * towards[:2]), 0.1, (0, 0, degrees)), np.array([0.2, 0.4, 0.2]))
        walled = SceneObject("o2", 2, wall, uncertainty=unsure(0.0, 0.0))
        own = SceneObject("o1", 1, shape, uncertainty=unsure(0.004, 0.0, low_z=0.0, high_z=0.0))
        _, after, same = reconcile([SURFACE, own, walled], PLAUSIBLE)
        np.testing.assert_allclose(same.centre_world, walled.centre_world, atol=1e-6)
        assert find_gap(shape, wall) == pytest.approx(-0.004, abs=1e-4)
        assert -0.0012 < find_gap(after.shape, wall) < 0.0012
        assert towards @ (own.centre_world - after.centre_world) > 0.001

    def test_what_uncertainty_cannot_explain_stays_and_is_reported(self):
        first, second = (thing(k, (x, 0, 0.05), unsure(0.0005)) for k, x in ((1, 0.0), (2, 0.06)))
        for before, after in zip(
            [first, second], reconcile([SURFACE, first, second], PLAUSIBLE)[1:], strict=True
        ):
            np.testing.assert_array_equal(before.shape.T_world_object, after.shape.T_world_object)
            other = "o2" if after.id == "o1" else "o1"
            assert after.doubt == f"overlaps {other} by 40 mm, more than both fits explain"
        floating = thing(1, (0.0, 0, 0.058), unsure(0.0005))
        table, after = reconcile([SURFACE, floating], PLAUSIBLE)
        assert after.doubt == "floats over o0 by 8 mm, more than both fits explain"
        assert table.doubt == ""
