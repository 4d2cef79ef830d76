from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from caryatid.errors import InputError
from caryatid.simulation import GroundTruth, ground_truth, load_scene, read_truth, write_truth
from caryatid.simulation.truth import mean_contact_forces

SHARED = Path(__file__).parents[2] / "shared" / "scenes"
EASY = {"vertices": ["table", "a"], "edges": [{"supporter": "table", "supported": "a"}]}


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared is absent: no ground truth to compare with")
@pytest.mark.slow
def test_agrees_with_the_given_ground_truth():
    given, found, common, same_kind = 0, 0, 0, 0
    for folder in sorted(SHARED.iterdir()):
        reference, computed = read_truth(folder / "gt.json"), ground_truth(load_scene(folder))
        assert computed.vertices == reference.vertices
        kinds = {(e["supporter"], e["supported"]): e["kind"] for e in reference.edges}
        given += len(reference.pairs)
        found += len(computed.pairs)
        common += len(reference.pairs & computed.pairs)
        same_kind += sum(kinds.get((e["supporter"], e["supported"])) == e["kind"] for e in computed.edges)
    assert given > 100
    assert common >= 0.98 * given
    assert found - common <= 0.02 * given
    assert same_kind >= 0.98 * given


def test_forces_carry_the_weight():
    scene = load_scene("bridge")
    forces = mean_contact_forces(scene)
    for label in scene.object_bodies:
        held = sum(force[2] for (_, b), force in forces.items() if b == label)
        weight = scene.model.body_mass[scene.body_id(label)] * 9.81
        assert held == pytest.approx(weight, rel=0.02)
    for (a, b), force in forces.items():
        np.testing.assert_allclose(force, -forces[b, a])


def test_looking_changes_nothing():
    scene = load_scene("counterweight")
    before = scene.data.qpos.copy()
    assert ground_truth(scene) == ground_truth(scene)
    np.testing.assert_array_equal(scene.data.qpos, before)


def test_removal_names_what_comes_down():
    truth = ground_truth(load_scene("tower"))
    assert truth.removal["object0"] == ("object1", "object2", "object3")
    assert truth.removal["object2"] == ("object3",)
    assert truth.removal["object4"] == ()


def test_files_come_back(tmp_path: Path):
    truth = ground_truth(load_scene("counterweight"))
    path = tmp_path / "gt.json"
    write_truth(truth, path)
    assert read_truth(path) == truth
    assert json.loads(path.read_text())["edges"][0] == {
        "supporter": "table", "supported": "object0", "kind": "bottom-up",
    }  # fmt: skip


def test_kind_and_removal_may_be_missing(tmp_path: Path):
    path = tmp_path / "gt.json"
    path.write_text(json.dumps(EASY))
    truth = read_truth(path)
    assert truth == GroundTruth(
        ("table", "a"), ({"supporter": "table", "supported": "a", "kind": "bottom-up"},), {}
    )
    assert truth.pairs == {("table", "a")}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"vertices": [', "broken JSON"),
        ("[]", "not an object"),
        (json.dumps({**EASY, "vertices": "table"}), "'vertices'"),
        (json.dumps({**EASY, "vertices": ["table", "a", "a"]}), "twice"),
        (json.dumps({"vertices": ["table"]}), "'edges'"),
        (json.dumps({**EASY, "edges": [3]}), "edges: '0' is 3"),
        (
            json.dumps({**EASY, "edges": [{"supporter": "table", "supported": "b"}]}),
            "'b', which is no vertex",
        ),
        (json.dumps({**EASY, "edges": [{"supported": "a"}]}), "edges.0: the key 'supporter' is missing"),
        (json.dumps({**EASY, "edges": [{**EASY["edges"][0], "kind": "glue"}]}), "glue.*bottom-up"),
        (json.dumps({**EASY, "removal": {"a": ["ghost"]}}), "'ghost', which is no vertex"),
        (json.dumps({**EASY, "removal": {"a": [{}]}}), "removal"),
    ],
)
def test_broken_files_are_refused_by_name(tmp_path: Path, text: str, reason: str):
    path = tmp_path / "gt.json"
    path.write_text(text)
    with pytest.raises(InputError, match=reason) as error:
        read_truth(path)
    assert str(path) in str(error.value)


def test_missing_file(tmp_path: Path):
    with pytest.raises(InputError, match="missing"):
        read_truth(tmp_path / "gt.json")
    with pytest.raises(InputError, match="cannot be written"):
        write_truth(GroundTruth(("table",), ()), tmp_path / "absent" / "gt.json")
