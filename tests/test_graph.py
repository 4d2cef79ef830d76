from __future__ import annotations

import numpy as np
import pytest
from synthetic import box, cylinder, table_object, thing

from caryatid.graph import SUPPORT_SURFACE_ID, Stability, Support, SupportGraph, object_id

CONTACT = np.array([0.01, 0.02, 0.85])
GRAPH = SupportGraph(
    (
        table_object(),
        thing(1, box((0.0, 0.0, 0.8), (0.1, 0.1, 0.1))),
        thing(2, cylinder((0.0, 0.0, 0.9), 0.03, 0.1)),
    ),
    (
        Support("o0", "o1"),
        Support("o1", "o2", contact_world=CONTACT, normal_world=np.array([0.0, 0.0, 1.0])),
        Support("o2", "o1", "top-down", certain=False),
    ),
    {"o1": Stability(0.05, -0.01, True, False)},
)


def test_objects_and_edges_are_found_by_ids_and_the_support_surface_by_its_role():
    assert GRAPH[object_id(2)].label == 2
    with pytest.raises(KeyError, match="unknown object 'o9'; known objects: o0, o1, o2"):
        GRAPH["o9"]
    assert GRAPH.support_surface.id == SUPPORT_SURFACE_ID
    assert SupportGraph(GRAPH.objects[1:]).support_surface is None
    assert GRAPH.support("o1", "o2").kind == "bottom-up"
    assert GRAPH.support("o2", "o1").kind == "top-down"
    assert GRAPH.support("o0", "o2") is None
    assert [s.supporter for s in GRAPH.supporters("o1")] == ["o0", "o2"]
    assert GRAPH.supporters("o0") == []


def test_as_a_networkx_graph_it_points_from_supporter_to_supported():
    directed = GRAPH.to_networkx()
    assert directed.nodes["o2"] == {"data": GRAPH["o2"], "role": "object", "shape": "cylinder"}
    assert directed.nodes["o0"]["role"] == "support_surface"
    assert set(directed.edges) == {s.pair for s in GRAPH.supports}
    expected = {"data": GRAPH.supports[2], "kind": "top-down", "certain": False}
    assert directed.edges["o2", "o1"] == expected
