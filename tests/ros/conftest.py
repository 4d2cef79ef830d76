"""The node on real ROS 2, in the environment of `make ros-test`: node, table and client are processes."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import pytest
import rclpy

collect_ignore = ["stand_ins"]

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[1] / "examples"
TABLE = EXAMPLES / "ros_table.py"
NODE = "-c", "from caryatid_ros.node import main; main()"
TOPICS = {
    "depth_topic": "/camera/depth",
    "colour_topic": "/camera/colour",
    "info_topic": "/camera/info",
}


class Process:
    """A process whose output is kept.

    Attributes:
        lines: What it printed so far.
        running: All that were not stopped.
    """

    running: ClassVar[list[Process]] = []

    def __init__(self, *arguments: object, **parameters: object) -> None:
        command = [sys.executable, *map(str, arguments), *(["--ros-args"] if parameters else [])]
        for name, value in parameters.items():
            command += ["-p", f"{name}:={_yaml(value)}"]
        self.process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env=os.environ,
        )  # fmt: skip
        self.command, self.lines = " ".join(command[1:]), list[str]()
        self.running.append(self)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines += iter(self.process.stdout.readline, "")

    @property
    def text(self) -> str:
        """All that it printed."""
        return "".join(self.lines)

    def stop(self, how: int = signal.SIGINT, wait: float = 10.0) -> tuple[int, float]:
        """Send a signal; return the exit status, and the seconds until it ended."""
        since = time.monotonic()
        self.running.remove(self)
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            status = self.process.wait(wait)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        return status, time.monotonic() - since


def _yaml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def wait_for(condition, seconds: float = 10.0, what: str = "it"):
    """Return what a function returns once that is true; fail after a time [s]."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, f"{what} did not happen within {seconds:g} s"
        time.sleep(0.02)
    return found


def within(seconds, call):
    """Return the result of a call that must return within a time [s]."""
    since = time.monotonic()
    found = call()
    assert (took := time.monotonic() - since) <= seconds, f"took {took:.2f} s"
    return found


def at_stage(client, text, seconds: float = 30.0):
    """Wait until the node tells a stage, in this goal and after the one that was waited for before."""

    def later():
        found = (n for n, stage in enumerate(client.stages) if n >= client.stages_seen and text in stage)
        return next(found, -1) + 1

    client.stages_seen = wait_for(later, seconds, text)


@pytest.fixture(scope="session", autouse=True)
def domain(worker_id):
    """A ROS domain of its own on this machine, and this process as a client in it."""
    worker = int(worker_id.removeprefix("gw")) if worker_id != "master" else 0
    os.environ |= {
        "ROS_DOMAIN_ID": str(10 * random.SystemRandom().randint(1, 9) + worker),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_PYTHON_CHECK_FIELDS": "1",
        "PYTHONUNBUFFERED": "1",
    }
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture(scope="session")
def table(domain):
    """The table's process; `client.set_table` changes its parameters."""
    process = Process(TABLE)
    yield process
    process.stop()


@pytest.fixture
def start_node():
    """Start the node with parameters; it is stopped at the end of the test."""
    started = []

    def start(*arguments: object, **parameters: object) -> Process:
        node = Process(*NODE, *arguments, **TOPICS | parameters)
        started.append(node)
        return node

    yield start
    for node in started:
        if node in Process.running:
            node.stop()


@pytest.fixture
def start_ready(start_node):
    """Start the node, and wait until it is ready."""

    def start(**parameters: object) -> Process:
        node = start_node(**parameters)
        wait_for(lambda: "ready: " in node.text, 60.0, "that the node is ready")
        return node

    return start


@pytest.fixture(scope="module")
def node(table, client):
    """A node with default parameters, which the tests of a module share."""
    process = Process(*NODE, **TOPICS, image_timeout=2.0, move_timeout=2.0, robot="breaking:make")
    wait_for(lambda: client.call("go_home").success, 20.0, "that the node hears the table")
    assert client.action.wait_for_server(20.0)
    yield process
    process.stop()


@pytest.fixture(scope="session")
def client(domain):
    """A client of node and table."""
    from client import Client

    with Client() as found:
        yield found


@pytest.fixture
def new_client(monkeypatch):
    """Make clients in another domain, with a table of its own.

    A node that is killed stays in DDS for 20 s, and those who knew it may send requests to nobody.
    """
    from client import Client

    number = int(os.environ["ROS_DOMAIN_ID"]) + 5
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    table = Process(TABLE)

    @contextmanager
    def make():
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=number)
        with Client(context) as client:
            yield client
        context.try_shutdown()

    yield make
    table.stop()


@pytest.fixture(autouse=True)
def defaults(client, table):
    """The table as it is by default, with its camera where it was first."""
    client.set_table()
    client.call("go_home")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Show what processes printed beside a failure."""
    report = yield
    if report.failed:
        report.sections += [(process.command, process.text) for process in Process.running]
    return report
