from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import box, cylinder, edges, hausdorff, sphere, table_object, thing, vertices

from caryatid.config import FusionConfig
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.graph import Support, SupportGraph
from caryatid.objects.fusion import Evidence, absorbed, fuse, fused_graph, match

SG, PC, BOTH = (FusionConfig(method=m) for m in ("sg", "pc", "pc+sg"))
CRATE = box((0.0, 0.0, 0.8), (0.1, 0.12, 0.1))
CAN = cylinder((0.0, 0.0, 0.9), 0.03, 0.1)
BALL = sphere((0.2, 0.2, 0.79), 0.04)


def graph(*pairs, shapes=None, certain=True):
    """The crate o1 and the can o2 (and whatever is given) over the table, with these edges."""
    shapes = shapes or {1: CRATE, 2: CAN}
    objects = (table_object(), *(thing(k, s) for k, s in shapes.items()))
    return SupportGraph(objects, tuple(Support(a, b, certain=certain, why=f"{a}>{b}") for a, b in pairs))


FULL = graph(("o0", "o1"), ("o1", "o2"))


def evidence_of(*graphs, config=SG, same_labels=True):
    evidence = Evidence()
    for g in graphs:
        evidence, _ = fuse(evidence, g, config, same_labels=same_labels)
    return evidence


def matched(known, seen, config=SG):
    return match([thing(1, known)], [thing(9, seen)], config, same_labels=False) == {"o9": "o1"}


# Matching


@pytest.mark.parametrize("shape", [CRATE, CAN, BALL], ids=lambda s: s.kind)
def test_an_object_that_moved_a_little_is_the_same_and_one_further_off_another(shape):
    assert matched(shape, shape)
    assert matched(shape, shape.moved(shift(0.03)))
    assert not matched(shape, shape.moved(shift(0.07)))


def test_one_of_another_size_is_another():
    assert matched(CRATE, box((0.0, 0.0, 0.8), (0.1, 0.12, 0.15)))
    assert not matched(CRATE, box((0.0, 0.0, 0.8), (0.1, 0.12, 0.25)))
    assert not matched(BALL, sphere((0.2, 0.2, 0.79), 0.07))


def test_a_sighting_that_is_unsure_of_a_hidden_side_may_differ_by_it():
    deep, cut = box((0.055, 0.0, 0.8), (0.24, 0.12, 0.1)), box((0.0, 0.0, 0.8), (0.13, 0.12, 0.1))
    unsure = Uncertainty(np.array([0.04, 0.0, 0.0]), np.zeros(3), np.array([0.08, 0.0, 0.0]), np.zeros(6))
    shallow = replace(thing(9, cut), uncertainty=unsure)
    assert not matched(deep, cut)
    assert match([thing(1, deep)], [shallow], SG, same_labels=False) == {"o9": "o1"}


def test_one_that_lies_otherwise_is_another():
    assert matched(CRATE, box((0.0, 0.0, 0.8), (0.1, 0.12, 0.1), turn_deg=15.0))
    assert not matched(CRATE, box((0.0, 0.0, 0.8), (0.1, 0.12, 0.1), turn_deg=45.0))


def test_a_quarter_turn_of_a_box_is_only_another_name_for_its_axes():
    assert matched(CRATE, box((0.0, 0.0, 0.8), (0.12, 0.1, 0.1), turn_deg=90.0))


def test_a_can_taken_for_a_box_of_its_size_is_still_the_can():
    assert matched(CAN, box((0.0, 0.0, 0.9), (0.06, 0.06, 0.1), turn_deg=45.0))


def test_of_two_in_the_same_place_the_one_of_the_same_kind():
    boxed = box((0.0, 0.0, 0.9), (0.06, 0.06, 0.1))
    for known in ([thing(1, boxed), thing(2, CAN)], [thing(1, CAN), thing(2, boxed)]):
        found = match(known, [thing(9, CAN)], SG, same_labels=False)["o9"]
        assert {o.id: o.shape.kind for o in known}[found] == "cylinder"


def test_orientation_says_nothing_of_round_things():
    squat = cylinder((0.0, 0.0, 0.8), 0.05, 0.1)
    on_its_side = replace(squat, T_world_object=squat.T_world_object[:, [2, 0, 1, 3]])
    assert on_its_side.T_world_object[2, 2] == pytest.approx(0.0)
    assert matched(squat, on_its_side)
    tall = cylinder((0.0, 0.0, 0.8), 0.03, 0.1)
    assert not matched(tall, replace(tall, T_world_object=on_its_side.T_world_object))


def test_each_is_matched_to_one_and_all_together_as_well_as_can_be():
    first, second = CRATE, CRATE.moved(shift(0.04))
    known = [thing(1, first), thing(2, second)]
    seen = [thing(7, first.moved(shift(0.018))), thing(8, second.moved(shift(0.018)))]
    assert match(known, seen, SG, same_labels=False) == {"o7": "o1", "o8": "o2"}
    assert len(match(known[:1], seen, SG, same_labels=False)) == 1


def test_the_table_is_the_table_and_no_object():
    known = [table_object(0.75), thing(1, CRATE)]
    seen = [table_object(0.9)]
    assert match(known, seen, SG, same_labels=False) == {"o0": "o0"}
    assert match([thing(1, table_object().shape)], seen, SG, same_labels=False) == {}


def test_labels_alone_decide_where_they_mean_the_same_in_every_view():
    far = thing(1, CRATE.moved(shift(0.5)))
    assert match([thing(1, CRATE)], [far], SG, same_labels=True) == {"o1": "o1"}
    assert match([thing(1, CRATE)], [thing(2, CRATE)], SG, same_labels=True) == {}
    for known, seen in (([], [far]), ([far], [])):
        assert match(known, seen, SG, same_labels=False) == {}


# Fusing


def test_what_a_new_view_calls_otherwise_gets_its_old_name():
    evidence = evidence_of(FULL)
    other_names = graph(("o0", "o2"), ("o2", "o1"), shapes={1: CAN, 2: CRATE})
    evidence, names = fuse(evidence, other_names, SG, same_labels=False)
    assert names == {"o0": "o0", "o1": "o2", "o2": "o1"}
    fused = fused_graph(evidence, SG)
    assert edges(fused) == edges(FULL)
    assert [o.occurrences for o in fused.objects] == [2, 2, 2]
    assert fused["o1"].shape.kind == "box"
    assert {o.id: o.label for o in fused.objects} == {"o0": table_object().label, "o1": 1, "o2": 2}


def test_a_new_object_gets_a_name_that_was_never_used():
    before = evidence_of(FULL)
    stranger = graph(("o0", "o1"), shapes={1: BALL})
    evidence, names = fuse(before, stranger, SG, same_labels=False)
    assert before.views == 1
    assert {i: len(seen) for i, seen in before.sightings.items()} == {"o0": 1, "o1": 1, "o2": 1}
    assert names["o1"] == "o3"
    fused = fused_graph(evidence, SG)
    assert vertices(fused) == {"o0", "o1", "o2", "o3"}
    assert ("o0", "o3") in edges(fused)
    assert fused["o3"].label == 3


def test_occurrences_and_opportunities_are_counted():
    without_can = graph(("o0", "o1"), shapes={1: CRATE})
    both_apart = graph(("o0", "o1"))
    fused = fused_graph(evidence_of(FULL, without_can, both_apart, FULL), SG)
    found = {s.pair: (s.occurrences, s.opportunities) for s in fused.supports}
    # The can was seen three times and found on the crate twice.
    assert found == {("o0", "o1"): (4, 4), ("o1", "o2"): (2, 3)}
    assert {o.id: (o.occurrences, o.opportunities) for o in fused.objects} == {
        "o0": (4, 4),
        "o1": (4, 4),
        "o2": (3, 3),
    }


def kept(config, *found):
    """Whether the edge from crate to can is kept, found in views True and not in views False."""
    graphs = [FULL if f else graph(("o0", "o1")) for f in found]
    return ("o1", "o2") in edges(fused_graph(evidence_of(*graphs, config=config), config))


@pytest.mark.parametrize(
    ("found", "pc", "sg", "both"),
    [
        ((True,), True, True, True),
        ((True, False), False, True, False),
        ((False, True), True, True, True),
        ((True, True, False), False, True, True),
        ((True, False, False), False, False, False),
        ((False, False, True), True, False, True),
        ((False, False), False, False, False),
    ],
)
def test_which_edges_each_method_keeps(found, pc, sg, both):
    assert (kept(PC, *found), kept(SG, *found), kept(BOTH, *found)) == (pc, sg, both)


def test_the_share_an_edge_must_keep_is_a_setting():
    strict, mild = replace(SG, keep_share=0.8), replace(SG, keep_share=0.3)
    assert not kept(strict, True, True, False)
    assert kept(mild, True, False, False)


def test_pc_holds_what_the_newest_graph_holds():
    gone = graph(("o0", "o1"), shapes={1: CRATE})
    for config, there in ((PC, False), (SG, True), (BOTH, True)):
        assert ("o2" in vertices(fused_graph(evidence_of(FULL, gone, config=config), config))) == there


@pytest.mark.parametrize("config", [SG, BOTH], ids=lambda c: c.method)
def test_a_vertex_that_views_contradict_vanishes_with_its_edges(config):
    gone = graph(("o0", "o1"), shapes={1: CRATE})
    evidence = evidence_of(FULL, gone, gone, config=config)
    assert "o2" in vertices(fused_graph(evidence, config))
    assert "o2" in vertices(fused_graph(evidence, config, contradicted={"o2": 1}))
    fused = fused_graph(evidence, config, contradicted={"o2": 2})
    assert vertices(fused) == {"o0", "o1"}
    assert edges(fused) == {("o0", "o1")}


def test_what_a_view_did_not_contradict_counts_as_hidden():
    gone = graph(("o0", "o1"), shapes={1: CRATE})
    fused = fused_graph(evidence_of(FULL, gone, gone), SG, contradicted={"o2": 1})
    assert (fused["o2"].occurrences, fused["o2"].opportunities) == (1, 2)


def test_sg_merges_the_shapes_and_the_others_take_the_newest():
    shifted = graph(shapes={1: CRATE.moved(shift(0.01)), 2: CAN})
    for config, x in ((SG, 0.005), (PC, 0.01), (BOTH, 0.01)):
        fused = fused_graph(evidence_of(FULL, shifted, config=config), config)
        assert fused["o1"].centre_world[0] == pytest.approx(x)


def test_an_edge_is_certain_where_a_view_was_certain_of_it():
    unsure = graph(("o0", "o1"), ("o1", "o2"), certain=False)
    for order in ((FULL, unsure), (unsure, FULL)):
        assert fused_graph(evidence_of(*order), SG).support("o1", "o2").certain
    assert not fused_graph(evidence_of(unsure, unsure), SG).support("o1", "o2").certain
    assert not fused_graph(evidence_of(FULL, unsure, config=BOTH), BOTH).support("o1", "o2").certain


@pytest.mark.parametrize("config", [PC, SG, BOTH], ids=lambda c: c.method)
@pytest.mark.parametrize("same_labels", [True, False])
def test_a_graph_fused_with_itself_stays_as_it_is(config, same_labels):
    once = fused_graph(evidence_of(FULL, config=config, same_labels=same_labels), config)
    often = fused_graph(evidence_of(*[FULL] * 4, config=config, same_labels=same_labels), config)
    assert vertices(often) == vertices(once)
    assert edges(often) == edges(once)
    for o in once.objects:
        assert hausdorff(often[o.id].shape, o.shape) < 1e-12
    assert {s.occurrences for s in often.supports} == {4}


def test_the_table_comes_first_and_edges_in_the_order_of_their_ends():
    shapes = {5: BALL, 2: CAN, 1: CRATE}
    fused = fused_graph(evidence_of(graph(("o1", "o2"), ("o0", "o5"), ("o0", "o1"), shapes=shapes)), SG)
    assert [o.id for o in fused.objects] == ["o0", "o1", "o2", "o5"]
    assert [s.pair for s in fused.supports] == [("o0", "o1"), ("o0", "o5"), ("o1", "o2")]


def test_what_was_said_of_an_object_taken_for_another_counts_for_that():
    twice = graph(("o0", "o1"), ("o1", "o2"), ("o0", "o3"), ("o3", "o1"), shapes={1: CRATE, 2: CAN, 3: CRATE})
    evidence = absorbed(evidence_of(graph(("o3", "o2"), shapes={2: CAN, 3: CRATE}), twice), {"o3": "o1"})
    assert set(evidence.sightings) == {"o0", "o1", "o2"}
    assert sorted(evidence.sightings["o1"]) == [0, 1]
    assert all(o.id == "o1" and o.label == 1 for o in evidence.sightings["o1"].values())
    assert {p: sorted(f) for p, f in evidence.supports.items()} == {("o1", "o2"): [0, 1], ("o0", "o1"): [1]}


def shift(x):
    motion = np.eye(4)
    motion[0, 3] = x
    return motion
