from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import TABLE_TOP, simulated_cloud, simulated_views

from caryatid.config import Config
from caryatid.errors import InputError, PerceptionError
from caryatid.geometry import transforms
from caryatid.segmentation.observation import level_transform, observe
from caryatid.sensing.views import Cloud, View

CONFIG = Config()
VIEW = simulated_views("tower")[0]


def observation_of(source, segmentation=None, known=None, config=CONFIG):
    return observe(source, config, segmentation=segmentation, known=known, rng=np.random.default_rng(0))


@pytest.mark.parametrize("source", [VIEW, simulated_cloud("tower")], ids=["view", "cloud"])
def test_labels_that_are_demanded_and_missing_are_an_error(source):
    with pytest.raises(InputError, match="has no labels") as caught:
        observation_of(replace(source, labels=None), "labels")
    assert source.name in str(caught.value)
    assert "auto" in caught.value.remedy


@pytest.mark.parametrize("pose", [VIEW.T_world_camera, None], ids=["posed", "not posed"])
def test_nothing_is_an_error_that_names_it(pose):
    with pytest.raises(PerceptionError, match="frame 7: has no depth readings"):
        observation_of(View(np.zeros((60, 80)), VIEW.K, pose, name="frame 7"))
    nothing = Cloud(np.zeros((0, 3)), np.zeros((0, 3)), name="cloud 7")
    with pytest.raises(PerceptionError, match="cloud 7: has no points"):
        observation_of(nothing)
    rng = np.random.default_rng(0)
    noise = Cloud(rng.normal(size=(500, 3)), transforms.unit(rng.normal(size=(500, 3))), name="noise")
    for cloud in (nothing, noise):
        with pytest.raises(PerceptionError, match=f"{cloud.name}: "):
            level_transform(cloud, CONFIG, rng)


def test_a_cloud_in_its_sensors_frame_is_levelled():
    observation = observation_of(VIEW, "labels")
    T_camera_world = transforms.invert(VIEW.pose)
    world = replace(observation.cloud, labels=VIEW.labels.ravel()[observation.pixels])
    stored = world.moved(T_camera_world)
    level = stored.moved(level_transform(stored, CONFIG, np.random.default_rng(0), use_labels=True))
    above = world.points_world[:, 2] - TABLE_TOP
    np.testing.assert_allclose(level.points_world[:, 2], above, atol=0.003)
    np.testing.assert_allclose(level.normals_world[:, 2], world.normals_world[:, 2], atol=0.005)
    assert level.viewpoint_world[2] == pytest.approx(VIEW.pose[2, 3] - TABLE_TOP, abs=0.003)
    assert np.array_equal(level.labels, stored.labels)
