"""The environment for learning planners: Gymnasium's own checks, and what its rewards add up to."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from conftest import SMALL_SENSOR
from gymnasium.utils.env_checker import check_env

from caryatid.config import Config
from caryatid.learning import COLUMNS, ViewEnv


def make(views=4, **options):
    config = replace(Config(), sensor=SMALL_SENSOR)
    return ViewEnv(config=replace(config, active=replace(config.active, max_views=views)), **options)


@pytest.mark.filterwarnings("ignore:.*infinity:UserWarning")
def test_gymnasium_accepts_it_and_a_seed_determines_every_byte():
    check_env(make(), skip_render_check=True)
    first, again = (play(make(), seed=5) for _ in range(2))
    assert [o.tobytes() for o in first[0]] == [o.tobytes() for o in again[0]]
    assert first[1:] == again[1:]
    assert first[2]["scene"] != play(make(), seed=6)[2]["scene"]


def play(env, seed):
    """Observations, rewards and last info of an episode that looks where most is to be seen."""
    observation, info = env.reset(seed=seed)
    observations, rewards, ended = [observation], [], False
    while not ended:
        reachable, saliency = (observation[:, COLUMNS.index(name)] for name in ("reachable", "saliency"))
        action = np.argmax(np.where(reachable, saliency, -np.inf))
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        ended = terminated or truncated
        assert truncated == (len(observations) == 4)
        assert terminated == ("stop" in info)
    return observations, rewards, info


def test_rewards_add_up_to_the_gain_in_f1_less_the_path():
    env = make(effort=0.1)
    observation, info = env.reset(seed=0, options={"scene": "hidden_stack"})
    assert info["scene"] == "hidden_stack"
    reachable = np.flatnonzero(observation[:, COLUMNS.index("reachable")])
    assert 5 < len(reachable) < 40
    action = reachable[np.argmax(observation[reachable, COLUMNS.index("saliency")])]
    led = observation[action, 1:4]
    assert led @ env.directions[action] > np.cos(0.25)
    _, reward, _, _, after = env.step(action)
    np.testing.assert_allclose(env.explorer.step.visited[-1], led, atol=0.05)
    cost = observation[action, COLUMNS.index("cost")]
    assert after["path"] == pytest.approx(2.0 * env.explorer.step.sphere.radius * cost, rel=1e-3)
    assert after["f1"] > info["f1"]
    assert reward == pytest.approx(after["f1"] - info["f1"] - 0.1 * cost, abs=1e-6)


def test_an_unreachable_direction_leads_to_the_nearest_view():
    env = gymnasium.wrappers.PassiveEnvChecker(make())
    observation, _ = env.reset(seed=1)
    below = int(np.argmin(env.unwrapped.directions[:, 2]))
    assert observation[below, 0] == 0.0
    led = observation[below, 1:4]
    env.step(below)
    np.testing.assert_allclose(env.unwrapped.explorer.step.visited[-1], led, atol=0.05)
