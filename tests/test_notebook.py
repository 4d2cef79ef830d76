"""What scenes, steps, graphs and shapes show in a notebook."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

import caryatid as ct
from caryatid.geometry.shapes import KINDS
from caryatid.geometry.solids import Polytope, Solid
from caryatid.geometry.transforms import look_at
from caryatid.graph import SupportGraph, TakeStep
from caryatid.manipulation.order import Order
from caryatid.planning.decision import Decision
from caryatid.runtime import Pictured
from caryatid.sensing.views import Cloud, View
from caryatid.simulation import load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.viz.colours import object_colour
from caryatid.viz.notebook import draw_cell

HOSTILE = "<script>alert(1)</script> & \"quoted\" 'too'"


@pytest.fixture(scope="module")
def scene(views):
    scene = ct.Scene()
    for view in views:
        scene.update(view)
    return scene


@pytest.fixture(scope="module")
def steps(scene_file, settings):
    stage = make_simulation(load_scene(scene_file), settings, noise="none", seed=0)
    explored = ct.explore(stage.camera, stage.robot, config=settings, early_stop=False)
    return [next(explored), next(explored)]


@pytest.fixture(scope="module")
def shown(scene, steps, views):
    """One of each kind, and the ends of what they may be."""
    pose = look_at(np.array([-1.0, 0.0, 1.5]), np.zeros(3))
    safe = TakeStep("o2", (), True, 0.0, "disturbed nothing in 24 rehearsals")
    return {
        "scene": scene,
        "scene of nothing": ct.Scene(),
        "first step": steps[0],
        "last step": replace(steps[1], decision=None, candidates=None, stop="maximum of 2 views reached"),
        "graph": scene.graph,
        "graph of nothing": ct.SupportGraph(),
        "object": scene.graph["o1"],
        "surface": scene.graph["o0"],
        "box": ct.Box(pose, np.array([0.1, 0.2, 0.0004])),
        "cylinder": ct.Cylinder(pose, 0.04, 0.2),
        "sphere": ct.Sphere(pose, 0.05),
        "solid": Solid.of([Polytope.around(ct.Box(pose, np.array([0.1, 0.2, 0.05])).outline())]),
        "view": views[0],
        "view of depth": View(np.zeros((4, 6)), views[0].K),
        "cloud": scene.cloud,
        "cloud of nothing": Cloud(np.empty((0, 3)), np.empty((0, 3))),
        "decision": steps[0].decision,
        "decision without points": Decision(pose, 3, 0.5, 0.1, 0.4, "because"),
        "order": Order((safe, TakeStep("o1", ("o3",), False, 0.25, "it disturbs o3")), "no safe order", 0.25),
        "order of nothing": Order(()),
    }


def parsed(html):
    """The cell as a tree; it fails where a tag is not closed or a text not escaped."""
    return ElementTree.fromstring(html)


def words(html):
    return " ".join("".join(part.itertext()) for part in parsed(html) if part.tag != "style")


def test_every_kind_that_shows_itself_is_tried_here(shown):
    # By name: a class with slots is made twice.
    kinds = {kind.__qualname__ for kind in (*Pictured.__subclasses__(), *KINDS.values())} - {"Shape"}
    assert kinds == {type(thing).__qualname__ for thing in shown.values()}


@pytest.mark.slow
def test_each_is_one_piece_of_markup_that_loads_and_runs_nothing(shown):
    for name, thing in shown.items():
        html = thing._repr_html_()
        assert html == thing._repr_html_(), name
        assert parsed(html).tag == "div", name
        assert not re.search(r"<script|javascript:|@import|url\([^#]|\son\w+=|<link|<iframe", html), name
        linked = re.findall(r'(?:href|src)="([^"]*)"', html)
        assert all(link.startswith(("data:image/", "#")) for link in linked), name
        assert len(html) < 100_000, name


def test_names_from_outside_are_escaped(scene, steps, views):
    o = replace(scene.graph["o1"], why=HOSTILE, doubt=HOSTILE)
    support = replace(scene.graph.supports[0], why=HOSTILE)
    graph = SupportGraph((scene.graph["o0"], o), (support,))
    decision = replace(steps[0].decision, sphere_saliency=None, why=HOSTILE)
    view = replace(views[0], name=HOSTILE)
    step = replace(steps[0], graph=graph, view=view, decision=decision)
    refused = Order((TakeStep("o1", (HOSTILE,), False, 1.0, HOSTILE),), HOSTILE)
    for thing in (o, graph, decision, view, step, refused, replace(scene.cloud, name=HOSTILE)):
        html = thing._repr_html_()
        assert "<script" not in html
        assert "alert(1)" in words(html), type(thing)


def test_the_cell_shows_the_facts(shown, scene, steps):
    said = {
        "scene": "3 views",
        "graph": "2 objects, 2 supports",
        "box": "100 × 200 × 0 mm",
        "cylinder": "⌀ 80 × 200 mm",
        "sphere": "⌀ 100 mm",
        "order": "then the least risky (nothing else moves: 75%): o1 (hold o3)",
        "view": "160 × 120 px",
        "view of depth": "unknown pose",
        "scene of nothing": "no views yet",
        "first step": steps[0].decision.why,
        "last step": "maximum of 2 views reached",
    }
    for name, fact in said.items():
        assert fact in words(shown[name]._repr_html_()), name
    assert "0.75, too low" in words(shown["order"]._repr_html_())
    html = scene._repr_html_()
    assert html.count("<svg") == 2
    assert all(object_colour(label) in html for label in (1, 2))
    with pytest.raises(TypeError, match="int"):
        draw_cell(3)


def test_a_plain_line_says_what_it_is_without_its_arrays(shown, scene, steps):
    things = [*shown.values(), scene.graph.supports[0], steps[0].candidates]
    for thing in things:
        assert "array(" not in repr(thing)
        assert "\n" not in repr(thing)
        assert len(repr(thing)) < 300
        assert repr(thing).startswith(type(thing).__name__)
