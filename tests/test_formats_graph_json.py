"""graph.json: what is written is read back, the same graph gives the same bytes, bad files are refused."""

from __future__ import annotations

import copy
import json
from dataclasses import asdict

import numpy as np
import pytest
from conftest import refusal

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere, Uncertainty
from caryatid.graph import SceneObject, Stability, Support, SupportGraph
from caryatid.io import graph_from_json, graph_text, graph_to_json, read_graph
from caryatid.io.json_files import json_text


def make_graph(rng):
    """Every kind of shape and support, with all that is known of each, or as little as possible."""
    T = [transforms.rigid(transforms.random_rotation(rng), rng.normal(size=3)) for _ in range(3)]
    table = Box(transforms.rigid(np.eye(3), (0.0, 0.0, 0.7)), np.array([1.0, 0.8, 0.04]))
    known = {"occurrences": 3, "opportunities": 9, "residual": 0.004, "poor_fit": True, "why": "σ ≤ 5 mm"}
    known |= {"seen": (True, False) * 3, "doubt": "hovers"}
    known["uncertainty"] = Uncertainty(*rng.uniform(size=(3, 3)), rng.uniform(size=6))
    objects = (
        SceneObject("o0", 65535, table, role="support_surface"),
        SceneObject("o1", 1, Box(T[0], rng.uniform(0.02, 0.3, 3)), **known),
        SceneObject("o2", 2, Cylinder(T[1], 0.04, 0.1)),
        SceneObject("o3", 3, Sphere(T[2], 0.05)),
    )
    supports = (
        Support("o0", "o1"),
        Support("o1", "o2", "lean", False, 2, 4, rng.normal(size=3), np.array([0.0, 0.6, 0.8]), "contact"),
        Support("o3", "o2", "top-down", contact_world=rng.normal(size=3)),
    )
    stability = {"o2": Stability(0.3, -0.01, True, False), "o3": Stability(0.0, float("inf"), True, True)}
    return SupportGraph(objects, supports, stability)


def test_what_is_written_is_read_back():
    graph = make_graph(np.random.default_rng(0))
    document = json.loads(graph_text(graph))
    assert document["stability"]["o3"]["overhang"] is None
    again = graph_from_json(document, "graph.json")
    assert graph_text(again) == graph_text(graph)
    assert again.stability == graph.stability
    assert everything(again) == everything(graph)


def everything(graph):
    return json_text({"all": [asdict(item) for item in (*graph.objects, *graph.supports)]})


def test_the_document_is_as_documented():
    T = transforms.rigid(np.eye(3), (0.0, 0.0, 0.8))
    graph = SupportGraph(
        (SceneObject("o1", 1, Sphere(T, 0.05)), SceneObject("o3", 3, Cylinder(T, 0.04, 0.12), occurrences=4)),
        (Support("o1", "o3", "bottom-up", True, 3, 4),),
    )
    document = graph_to_json(graph)
    about = {"format": "caryatid/graph", "version": 1, "frame": "world, z up, metres"}
    assert {key: document[key] for key in about} == about
    cylinder = document["objects"][1]
    assert cylinder["size"] == {"radius": 0.04, "height": 0.12}
    assert cylinder["T_world_object"] == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1]]
    edge = {"supporter": "o1", "supported": "o3", "kind": "bottom-up", "certain": True}
    edge |= {"occurrences": 3, "opportunities": 4, "why": ""}
    assert document["supports"] == [edge]


def test_noise_below_a_nanometre_and_negative_zero_change_no_byte():
    texts = []
    for offset in (0.0, -1e-12, 1e-6):
        sphere = Sphere(transforms.rigid(np.eye(3), (offset, 0, 1)), 0.05)
        texts.append(graph_text(SupportGraph((SceneObject("o1", 1, sphere),))))
    assert texts[0] == texts[1] != texts[2]


def test_a_minimal_file_of_another_program_is_read(tmp_path):
    path = tmp_path / "graph.json"
    thing = {"role": "object", "T_world_object": np.eye(4).tolist(), "mood": "good"}
    box = thing | {"id": "a", "label": 1, "shape": "box", "size": [0.1, 0.1, 0.1]}
    ball = thing | {"id": "b", "label": 2, "shape": "sphere", "size": {"radius": 1}}
    edges = [{"supporter": "a", "supported": "b", "kind": "lean"}]
    about = {"format": "caryatid/graph", "version": 1, "colour": "red"}
    path.write_text(json.dumps(about | {"objects": [box, ball], "supports": edges}))
    graph = read_graph(path)
    assert graph.supports[0].certain
    assert graph["a"].shape.volume == pytest.approx(1e-3)


SUPPORT = {"supporter": "o0", "supported": "o1", "kind": "bottom-up"}


def change(document, *path_and_value):
    *path, last, value = path_and_value
    at = document
    for key in path:
        at = at[key]
    if value is ...:
        del at[last]
    else:
        at[last] = value


@pytest.mark.parametrize(
    ("where", "said"),
    [
        (("format", "other"), "caryatid/graph"),
        (("version", 2), "'version' is 2: must be 1"),
        (("objects", ...), "'objects' is missing"),
        (("objects", 1, "id", "o0"), "two objects have the id 'o0'"),
        (("objects", 1, "role", "hero"), "hero"),
        (("objects", 1, "role", "support_surface"), "two support surfaces"),
        (("objects", 1, "label", 70000), "70000"),
        (("objects", 1, "T_world_object", np.diag([2.0, 2, 2, 1]).tolist()), "not a rotation"),
        (("objects", 1, "shape", "banana"), "banana"),
        (("objects", 1, "size", [0.1, -0.1, 0.1]), "not positive"),
        (("objects", 1, "occurrences", -3), "occurrences"),
        (("objects", 1, "seen", [True]), "seen"),
        (("objects", 1, "uncertainty", {"position": [0.1, 0.1, 0.1]}), "'rotation' is missing"),
        (("objects", 1, 7), "must be an object"),
        (("supports", 0, "supporter", "o99"), "o99"),
        (("supports", 0, "kind", "glue"), "glue"),
        (("supports", 0, "contact", [1, 2]), "3 finite numbers"),
        (("stability", {"o99": {}}), "o99"),
        (("supports", [SUPPORT, SUPPORT]), "duplicate edge o0 → o1"),
        (("supports", 0, "supporter", "o1"), "'o1' supports itself"),
    ],
)
def test_a_bad_file_is_refused_with_its_name_and_the_reason(where, said):
    table = SceneObject("o0", 65535, Box(np.eye(4), np.ones(3)), role="support_surface")
    box = SceneObject("o1", 1, Box(np.eye(4), np.ones(3)))
    document = graph_to_json(SupportGraph((table, box), (Support("o0", "o1", contact_world=np.ones(3)),)))
    graph_from_json(copy.deepcopy(document), "right.json")
    change(document, *where)
    with refusal("wrong.json", said):
        graph_from_json(document, "wrong.json")


def test_a_file_too_large_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "graph.json").open("w") as file:
        file.truncate(700_000_000)
    with refusal(tmp_path / "graph.json", "700 MB is too large, at most 100 MB are read"):
        read_graph(tmp_path / "graph.json")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"format": ', "broken JSON"),
        (b"[1, 2]", "list"),
        (b'{"a": NaN}', "broken JSON"),
        (b"[" * 200_000, "graph.json"),
        (b'{"format": "caryatid/graph", "version": ' + b"9" * 5000 + b"}", "graph.json"),
    ],
)
def test_broken_json_is_refused_in_one_line(tmp_path, content, said):
    path = tmp_path / "graph.json"
    path.write_bytes(content)
    with refusal(path, said):
        read_graph(path)


def test_values_that_json_cannot_hold_are_not_written():
    with pytest.raises(ValueError, match="JSON"):
        json_text({"a": float("nan")})


def test_no_number_of_a_file_is_too_large_to_be_squared(tmp_path):
    path = tmp_path / "graph.json"
    for number in ("1e300", "1e999", "1" * 400):
        graph = graph_to_json(SupportGraph()) | {"stability": {}}
        path.write_text(json.dumps(graph)[:-1] + f', "objects": [{{"residual": {number}}}]}}')
        with pytest.raises(InputError, match=r"a number is larger than 9.2e\+18|out of range"):
            read_graph(path)
