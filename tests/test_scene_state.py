"""A scene that is written and read goes on as if nothing had been."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from conftest import SMALL_SENSOR

from caryatid.config import Config
from caryatid.geometry import transforms
from caryatid.scene import Scene
from caryatid.sessions.scene_state import MODELS, SceneWriter, read_scene
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.scenes import load_scene


@pytest.fixture(scope="module")
def noisy_views():
    """Six views of a heap as a real camera gives them: noise in depth, and poses a little off."""
    noise = Config().noise
    camera = SimulatedCamera(
        load_scene("clutter"), "carmine", noise, np.random.default_rng(4), sensor=SMALL_SENSOR
    )
    centre_world = np.array([0.0, 0.0, 0.75])
    views = []
    for azimuth, up in ((180, 40), (100, 60), (30, 35), (-40, 50), (-110, 30), (150, 55)):
        a, e = np.radians((azimuth, up))
        out = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        views.append(camera.capture(transforms.look_at(centre_world + 1.2 * out, centre_world)))
    return [replace(view, normals_camera=None) for view in views]


def written(scene):
    """All that is known, but for how long it took."""
    scene.timings = {}
    text, arrays = SceneWriter().write(scene)
    return text, {kind: flat.tobytes() for kind, flat in arrays.items()}


def read(text, arrays, scene):
    return read_scene(text, arrays, scene.config, scene.segmentation, scene.seed)


@pytest.mark.parametrize("fusion", ["pc", "sg", "pc+sg"])
@pytest.mark.parametrize("segmentation", ["labels", "auto"])
def test_what_was_read_goes_on_exactly_as_what_was_written(noisy_views, fusion, segmentation):
    config = replace(Config(), fusion=replace(Config().fusion, method=fusion))
    whole = Scene(config, segmentation=segmentation, seed=3)
    resumed, writer = Scene(config, segmentation=segmentation, seed=3), SceneWriter()
    for view in noisy_views:
        whole.update(view)
        resumed = read(*writer.write(resumed), resumed)
        resumed.update(view)
        assert written(resumed) == written(whole)
    assert len(whole.graph.objects) > 3
    assert len(whole.graph.supports) > 3


def test_nothing_that_a_scene_remembers_is_left_out(noisy_views):
    """Attributes that are neither written nor given again would be missing."""
    scene = Scene(segmentation="auto")
    scene.update(noisy_views[0])
    again = read(*SceneWriter().write(scene), scene)
    pairs = [(scene, again), (scene._models, again._models), (scene._models.points, again._models.points)]
    pairs.append((scene._registration, again._registration))
    assert {type(a).__name__ for a, _ in pairs} == set(MODELS)
    for a, b in pairs:
        assert vars(a).keys() == vars(b).keys()
    assert again.config is scene.config
    assert np.array_equal(again.labels, scene.labels)
    assert np.array_equal(again.sphere.directions, scene.sphere.directions)


def test_the_text_of_what_stays_is_not_made_again(noisy_views):
    scene, writer = Scene(segmentation="labels"), SceneWriter()
    for view in noisy_views[:3]:
        scene.update(view)
        remembered = writer.write(scene)
        anew = SceneWriter().write(scene)
        assert remembered[0] == anew[0]
        assert remembered[1].keys() == anew[1].keys()


def test_what_cannot_be_written_is_an_error(noisy_views):
    @dataclass
    class Stranger:
        name: str

    scene = Scene()
    scene.stranger = Stranger("who")
    with pytest.raises(TypeError, match="Stranger"):
        SceneWriter().write(scene)


NO_SCENES = ["{}", "[]", "null", '{"scene": 3, "shared": []}', '{"scene": ["z"], "shared": []}']


@pytest.mark.parametrize("text", NO_SCENES)
def test_what_is_no_scene_is_an_error(text):
    with pytest.raises((ValueError, KeyError, TypeError, IndexError)):
        read_scene(text, {}, Config(), None, 0)


def test_numbers_come_back_to_the_last_bit(noisy_views):
    scene = Scene()
    scene.update(noisy_views[0])
    scene.timings = {"a": 0.1 + 0.2, "b": float("inf"), "c": np.float64(1e-300)}
    again = read(*SceneWriter().write(scene), scene)
    assert again.timings == scene.timings
    assert type(again.timings["c"]) is np.float64
    document = json.loads(SceneWriter().write(scene)[0])
    assert document["scene"][:2] == ["m", "Scene"]
