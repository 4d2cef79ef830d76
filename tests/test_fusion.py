from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from synthetic import (
    box,
    cylinder,
    edges,
    hausdorff,
    random_motion,
    sphere,
    table_object,
    thing,
)

from caryatid.config import FusionConfig
from caryatid.geometry.shapes import Box
from caryatid.graph import Support, SupportGraph
from caryatid.objects.fusion import changed, fuse, fused_graph, renamed, without
from caryatid.paper import match_by_shape, merge_sightings, unite_graphs

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


def together(*graphs, config=SG):
    """All graphs with the ids of the fused objects."""
    found = ()
    for g in graphs:
        found, _ = fuse(found, g, whole=config.method == "sg")
    return found


def fused_of(*graphs, config=SG, **counts):
    derive = unite_graphs if config.method == "sg" else fused_graph
    return derive(together(*graphs, config=config), config, **counts)


def shift(x):
    motion = np.eye(4)
    motion[0, 3] = x
    return motion


def test_texts_name_the_objects_that_the_graph_has():
    """Two swap their names in one step, one merges with another, and one goes."""
    found = graph(("o1", "o2"), ("o2", "o11"), shapes={1: CRATE, 2: CAN, 11: BALL})
    doubts = {"o1": "overlaps o2 by 3 mm; floats over o11 by 4 mm", "o11": "overlaps o2 by 5 mm"}
    found = replace(found, objects=tuple(replace(o, doubt=doubts.get(o.id, "")) for o in found.objects))
    swapped = renamed(found, {"o1": "o2", "o2": "o1"})
    assert [(s.pair, s.why) for s in swapped.supports] == [(("o2", "o1"), "o2>o1"), (("o1", "o11"), "o1>o11")]
    assert swapped["o2"].doubt == "overlaps o1 by 3 mm; floats over o11 by 4 mm"
    assert renamed(found, {"o2": "o1"})["o1"].doubt == "floats over o11 by 4 mm"
    assert without(found, {"o2"})["o1"].doubt == "floats over o11 by 4 mm"
    assert without(found, {"o2"})["o11"].doubt == ""


# Matching

BOXED = box((0.0, 0.0, 0.9), (0.06, 0.06, 0.1))
SQUAT, TALL = cylinder((0.0, 0.0, 0.8), 0.05, 0.1), cylinder((0.0, 0.0, 0.8), 0.03, 0.1)


def on_its_side(shape):
    return replace(shape, T_world_object=shape.T_world_object[:, [2, 0, 1, 3]])


@pytest.mark.parametrize(
    ("known", "seen", "same"),
    [
        *(
            (shape, shape.moved(shift(x)), x < 0.05)
            for shape in (CRATE, CAN, BALL)
            for x in (0.0, 0.03, 0.07)
        ),
        (CRATE, box((0.0, 0.0, 0.8), (0.1, 0.12, 0.15)), True),
        (CRATE, box((0.0, 0.0, 0.8), (0.1, 0.12, 0.25)), False),
        (BALL, sphere((0.2, 0.2, 0.79), 0.07), False),
        (CRATE, box((0.0, 0.0, 0.8), (0.1, 0.12, 0.1), turn_deg=15.0), True),
        (CRATE, box((0.0, 0.0, 0.8), (0.1, 0.12, 0.1), turn_deg=45.0), False),
        (CRATE, box((0.0, 0.0, 0.8), (0.12, 0.1, 0.1), turn_deg=90.0), True),
        (CAN, BOXED, True),
        (SQUAT, on_its_side(SQUAT), True),
        (TALL, on_its_side(TALL), False),
    ],
)
def test_place_size_and_orientation_tell_whether_two_are_the_same(known, seen, same):
    assert match_by_shape([thing(1, known)], [thing(9, seen)], SG) == ({"o9": "o1"} if same else {})


def test_each_is_matched_to_one_and_all_together_as_well_as_can_be():
    first, second = CRATE, CRATE.moved(shift(0.04))
    known = [thing(1, first), thing(2, second)]
    seen = [thing(7, first.moved(shift(0.018))), thing(8, second.moved(shift(0.018)))]
    assert match_by_shape(known, seen, SG) == {"o7": "o1", "o8": "o2"}
    assert len(match_by_shape(known[:1], seen, SG)) == 1
    for places in ([thing(1, BOXED), thing(2, CAN)], [thing(1, CAN), thing(2, BOXED)]):
        found = match_by_shape(places, [thing(9, CAN)], SG)["o9"]
        assert {o.id: o.shape.kind for o in places}[found] == "cylinder"


# Fusing


def test_what_a_new_view_calls_otherwise_gets_its_old_name():
    other_names = graph(("o0", "o2"), ("o2", "o1"), shapes={1: CAN, 2: CRATE})
    names = match_by_shape(FULL.objects, other_names.objects, SG)
    graphs, names = fuse(together(FULL), other_names, names, whole=True)
    assert names == {"o0": "o0", "o1": "o2", "o2": "o1"}
    fused = unite_graphs(graphs, SG)
    assert edges(fused) == edges(FULL)
    assert [o.occurrences for o in fused.objects] == [2, 2, 2]
    assert fused["o1"].shape.kind == "box"
    assert {o.id: o.label for o in fused.objects} == {"o0": table_object().label, "o1": 1, "o2": 2}


def test_a_new_object_gets_a_name_that_was_never_used():
    stranger = graph(("o0", "o1"), shapes={1: BALL})
    names = match_by_shape(FULL.objects, stranger.objects, SG)
    graphs, names = fuse(together(FULL), stranger, names, whole=True)
    assert names["o1"] == "o3"
    fused = unite_graphs(graphs, SG)
    assert [(o.id, o.label) for o in fused.objects[1:]] == [("o1", 1), ("o2", 2), ("o3", 3)]
    assert [s.pair for s in fused.supports] == [("o0", "o1"), ("o0", "o3"), ("o1", "o2")]


GONE = graph(("o0", "o1"), shapes={1: CRATE})


def test_a_view_that_shows_one_end_alone_says_nothing_of_an_edge():
    """The cloud so far still touches in view 2, which shows the lower object only, and no more in view 3."""
    all_ids, lower = frozenset({"o0", "o1", "o2"}), frozenset({"o0", "o1"})
    apart = graph(("o0", "o1"), ("o0", "o2"))
    fused = fused_of(FULL, FULL, apart, config=BOTH, shown=(all_ids, lower, all_ids))
    found = {s.pair: (s.occurrences, s.opportunities) for s in fused.supports}
    assert found == {("o0", "o1"): (3, 3), ("o0", "o2"): (1, 2)}
    assert [o.occurrences for o in fused.objects] == [3, 3, 2]


def test_occurrences_and_opportunities_are_counted():
    fused = fused_of(FULL, GONE, graph(("o0", "o1")), FULL)
    found = {s.pair: (s.occurrences, s.opportunities) for s in fused.supports}
    # The can was seen three times and found on the crate twice.
    assert found == {("o0", "o1"): (4, 4), ("o1", "o2"): (2, 3)}
    counts = {o.id: (o.occurrences, o.opportunities) for o in fused.objects}
    assert counts == {"o0": (4, 4), "o1": (4, 4), "o2": (3, 3)}


@pytest.mark.parametrize(
    ("found", "kept"),
    [
        ((True,), (True, True, True)),
        ((True, False), (False, True, False)),
        ((False, True), (True, True, True)),
        ((True, True, False), (False, True, True)),
        ((True, False, False), (False, False, False)),
        ((False, False, True), (True, False, True)),
        ((False, False), (False, False, False)),
    ],
)
def test_which_edges_each_method_keeps_found_in_views_true_and_not_in_views_false(found, kept):
    graphs = [FULL if f else graph(("o0", "o1")) for f in found]
    assert tuple(("o1", "o2") in edges(fused_of(*graphs, config=c)) for c in (PC, SG, BOTH)) == kept
    strict, mild = replace(SG, keep_share=0.8), replace(SG, keep_share=0.3)
    assert (("o1", "o2") in edges(fused_of(*graphs, config=strict))) == (sum(found) / len(found) > 0.8)
    assert (("o1", "o2") in edges(fused_of(*graphs, config=mild))) == any(found)


def test_an_edge_is_certain_where_a_view_was_certain_of_it():
    unsure = graph(("o0", "o1"), ("o1", "o2"), certain=False)
    for views, certain in (((FULL, unsure), True), ((unsure, FULL), True), ((unsure, unsure), False)):
        assert fused_of(*views).support("o1", "o2").certain == certain
    assert not fused_of(FULL, unsure, config=BOTH).support("o1", "o2").certain


@pytest.mark.parametrize("earlier", [0.95, 0.6])
def test_a_view_that_denies_a_sure_support_is_less_sure_of_the_others(earlier):
    def said(*supports):
        known = [Support(*pair, probability=p) for *pair, p in supports]
        return replace(FULL, supports=tuple(known))

    views = said(("o0", "o1", 1.0), ("o1", "o2", earlier)), said(("o0", "o1", 1.0), ("o0", "o2", 1.0))
    fused = fused_graph(views, BOTH)
    assert edges(fused) == {("o0", "o1"), ("o0", "o2")}
    assert fused.support("o0", "o2").doubtful == (earlier > 0.9)
    assert fused.support("o0", "o1").belief == 1.0


# What is a change

LITTLE, MUCH = 0.8 * SG.settled, 1.2 * SG.settled


def with_crate(shape):
    return graph(("o0", "o1"), ("o1", "o2"), shapes={1: shape, 2: CAN})


def grown(by):
    return Box(CRATE.T_world_object, CRATE.extents + (0.0, 0.0, by))


@pytest.mark.parametrize(
    ("other", "different"),
    [
        *((with_crate(CRATE.moved(shift(by))), by == MUCH) for by in (LITTLE, MUCH)),
        *((with_crate(grown(by)), by == MUCH) for by in (LITTLE, MUCH)),
        (replace(FULL, objects=FULL.objects[:2], supports=FULL.supports[:1]), True),
        (graph(("o0", "o1"), ("o2", "o1")), True),
    ],
)
def test_shapes_beyond_the_tolerance_objects_and_edges_are_a_change(other, different):
    assert changed(FULL, other, SG) == changed(other, FULL, SG) == different


# Shapes of several sightings, with `sg`

NONE = (False,) * 6


def test_the_kind_with_most_evidence_wins():
    ball, crate = sphere((0.0, 0.0, 0.0), 0.05), box((0.0, 0.0, 0.0), (0.09, 0.09, 0.09))
    assert merge_sightings([thing(1, ball), thing(1, crate), thing(1, crate)]).shape.kind == "box"
    assert merge_sightings([thing(1, ball), thing(1, crate, seen=NONE)]).shape.kind == "sphere"
    balls = [thing(1, sphere((x, 0.0, 0.0), radius)) for x, radius in ((0.0, 0.04), (0.02, 0.05))]
    assert hausdorff(merge_sightings(balls).shape, sphere((0.01, 0.0, 0.0), 0.045)) < 1e-12


def test_merging_commutes_with_any_motion_and_any_order():
    sightings = [
        thing(1, box((0.0, 0.0, 0.0), (0.08, 0.12, 0.1), turn_deg=3.0 * k), seen=(True, k == 0) * 3)
        for k in range(3)
    ]
    T, merged = random_motion(np.random.default_rng(2)), merge_sightings(sightings)
    for order in permutations(sightings):
        there = [replace(o, shape=o.shape.moved(T)) for o in order]
        assert hausdorff(merge_sightings(there).shape, merged.shape.moved(T)) < 1e-12
