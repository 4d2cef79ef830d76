"""Killed at any moment, or asked by many at once: what was acknowledged is there, and is what it would be."""

from __future__ import annotations

import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import durability
from durability import address_of, sent, start, views_around
from robot_client import RobotClient

from caryatid.sessions import Session

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def around():
    return views_around("tower", 8)


def test_however_adding_or_taking_is_killed_nothing_is_lost(tmp_path, around):
    tally = durability.kill_session(tmp_path, around[:6], kills=16, seed=2)
    assert tally["kept"] + tally["not kept"] == 16
    assert tally["acknowledged"]


def test_however_a_service_is_killed_no_view_is_lost(tmp_path, around):
    tally = durability.kill_serving(tmp_path, around, kills=8, seed=1)
    assert tally["kills"] == 8
    assert tally["acknowledged"] >= 2


def test_many_clients_at_once_lose_nothing(tmp_path, around):
    options = ("--open-sessions", 1)
    orders, *_ = durability.put_load(tmp_path, around * 2, clients=4, sessions=2, hostile=2, options=options)
    assert sorted(n for order in orders.values() for n in order) == list(range(16))
    assert all(len(order) == 8 for order in orders.values())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_service_asked_to_stop_finishes_the_current_view(tmp_path, around, number):
    process = start(["serve", tmp_path / "s", "--port", 0, "--json"], tmp_path / "said")
    robot = RobotClient(address_of(tmp_path / "said"))
    robot.begin("table", segmentation="labels")
    with ThreadPoolExecutor() as pool:
        answer = pool.submit(robot.add, "table", **sent(around[0]), number=0)
        # The first view takes long: kernels are loaded. Told to stop as soon as the request is under way.
        time.sleep(0.15)
        os.kill(process.pid, number)
        process.join()
    assert process.exitcode == 0
    assert answer.result()["view"] == 0
    with Session.open(tmp_path / "s/table") as session:
        assert session.views == 1
    assert "Traceback" not in (tmp_path / "said").read_text()
